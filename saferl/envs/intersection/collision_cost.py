"""The cost: predicted collisions (Algorithm 2), and crashes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from saferl.envs.intersection.dynamics import predict_vehicles, step_ego
from saferl.envs.intersection.geometry import frame, separation


@dataclass(frozen=True)
class CollisionCost:
    """Cost of a state and action: Algorithm 2 (paper).

    The ego is predicted with E5_1b under the action it executes, every observed vehicle with
    constant speed and yaw rate (E5_1c). At each step i of the horizon both rectangles grow by
    beta_i; each vehicle and step that overlap add ``initial * v / base_speed * exp(-decay beta_i)``,
    and the sum is divided by the number of observed vehicles (at least 1). The paper prints beta in
    [1.20, 1.50] and the step 1 / f_s; the other constants are ours.

    Attributes:
        steps: T, number of predicted steps.
        dt: length of a step, s.
        growth: beta at the first and the last step.
        decay: w.
        base_speed: m/s.
        initial: C_init.
        crash: what a collision or leaving the road costs (ours), see :meth:`with_crash`; the paper charges predictions
            alone, and an episode that a crash has ended costs no more.

    >>> ego = torch.tensor([0., 0., 9., 0., 0., 0.])
    >>> ahead = torch.tensor([[5.5, 0., 0., 0., 0., 0.]])  # a standing car, half a metre ahead
    >>> cost = CollisionCost()
    >>> cost(ego, torch.zeros(2), ahead, torch.tensor([True])).item() > 0.1
    True
    >>> cost(ego, torch.zeros(2), ahead, torch.tensor([False])).item()
    0.0
    """

    steps: int = 15
    dt: float = 1 / 15
    growth: tuple[float, float] = (1.2, 1.5)
    decay: float = 1.0
    base_speed: float = 9.0
    initial: float = 0.05
    crash: float = 1.0

    def __post_init__(self):
        for name in ("steps", "dt", "base_speed"):
            if getattr(self, name) <= 0:
                raise ValueError(f"cost.{name} must be > 0, got {getattr(self, name)}.")
        for name in ("initial", "crash"):
            if getattr(self, name) < 0:
                raise ValueError(f"cost.{name} must be >= 0, got {getattr(self, name)}.")
        if len(self.growth) != 2 or not 0 < self.growth[0] <= self.growth[1]:
            raise ValueError(
                f"cost.growth must be 2 numbers with 0 < first <= last, got {self.growth}."
            )

    def shares(self, ego: Tensor, control: Tensor, vehicles: Tensor, observed: Tensor) -> Tensor:
        """What each vehicle adds to the cost of a state and action, [..., N]: 0 where none of its predicted places meets
        the ego's.

        Args:
            ego: [..., 6].
            control: [..., 2], physical units.
            vehicles: [..., N, 6].
            observed: bool [..., N].
        """
        speed = torch.hypot(ego[..., 2], ego[..., 3])
        beta = torch.linspace(*self.growth, self.steps, dtype=ego.dtype, device=ego.device)
        own = []
        for _ in range(self.steps):
            ego = step_ego(ego, control, self.dt)
            own.append(ego)
        own = frame(*(torch.stack([e[..., k] for e in own]) for k in (0, 1, 4)))  # [T, ...]
        others = frame(
            *predict_vehicles(vehicles.movedim(-2, 0), self.dt, self.steps)
        )  # [T, N, ...]
        beta = beta.reshape(-1, *[1] * speed.ndim)
        gap = separation(own.at((slice(None), None)), others, scale=beta[:, None])  # [T, N, ...]
        observed = observed.movedim(-1, 0)
        price = (self.initial / self.base_speed) * torch.exp(-self.decay * beta)
        each = torch.where((gap <= 0) & observed, price[:, None], 0.0).sum(0)
        return (each * speed / observed.sum(0).clamp_min(1)).movedim(0, -1)

    def __call__(self, ego: Tensor, control: Tensor, vehicles: Tensor, observed: Tensor) -> Tensor:
        """Cost [...] of a state and action, the sum of its :meth:`shares`."""
        return self.shares(ego, control, vehicles, observed).sum(-1)

    def with_crash(self, predicted: Tensor, crashed: Tensor) -> Tensor:
        """Cost [...] of a decision: its predicted collisions, and whether it ended in a crash, bool [...]."""
        return predicted + self.crash * crashed
