# TorchRL's specs take tuples that their annotations do not name.
# pyright: reportArgumentType=false
"""A small constrained control task whose optimum is known: a cart under a budget of effort, or of motion besides."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from scipy.linalg import solve_discrete_are
from scipy.optimize import root
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded

from saferl.envs.seeding import SeededEnv, uniform
from saferl.envs.task import Task

_A = np.array([[0.8, 0.3], [0.0, 0.8]])
_B = np.array([[0.0], [0.5]])
_Q = np.diag([1.0, 0.1])
#: By name what a cost weighs: the state, and the action.
_COSTS = {"effort": (np.zeros((2, 2)), 1.0), "motion": (np.diag([0.0, 1.0]), 0.0)}


@dataclass(frozen=True)
class Cart(Task):
    """A cart that a bounded force brings to the middle: a constrained linear-quadratic problem.

    With x = [position, velocity] and u the action: x' = A x + B u + w, reward -x Q x, cost u^2 (``effort``).
    A = [[0.8, 0.3], [0, 0.8]], B = [0, 0.5], Q = diag(1, 0.1). Starts are uniform in [-spread, spread]^2, w is
    uniform in [-noise, noise] on the velocity. An episode is truncated, never terminated.

    Attributes:
        horizon: decisions of an episode.
        spread, noise: see above.
        costs: ``effort``, or that and ``motion``, the velocity squared.
        task: what runs are called.

    Raises:
        ValueError: a setting is out of range.
    """

    horizon: int = 20
    spread: float = 1.0
    noise: float = 0.1
    costs: tuple[str, ...] = ("effort",)
    task: str = "cart"

    size: ClassVar[int] = 2
    action_dim: ClassVar[int] = 1

    def __post_init__(self):
        object.__setattr__(self, "costs", tuple(self.costs))
        if self.costs not in (("effort",), ("effort", "motion")):
            raise ValueError(
                f"task.costs must be [effort] or [effort,motion], got {', '.join(self.costs) or 'none'}."
            )
        for name, least in (("horizon", 1), ("spread", 0), ("noise", 0)):
            if not getattr(self, name) >= least:
                raise ValueError(f"task.{name} must be >= {least}, got {getattr(self, name)}.")

    def sums(
        self,
        gain: np.ndarray,
        gamma: float,
        horizon: float = math.inf,
        moment: np.ndarray | None = None,
    ) -> tuple[float, ...]:
        """Expected discounted reward and costs of the policy u = -gain x, which must not reach the box.

        Args:
            gain: [2].
            gamma: discount; 1 with a finite horizon is a sum.
            horizon: decisions.
            moment: [2, 2], E[x x^T] at the start; that of the task's own starts by default.
        """
        closed = _A - _B @ gain[None]
        moment = np.eye(2) * self.spread**2 / 3 if moment is None else moment
        shock = np.diag([0.0, self.noise**2 / 3])
        reward, costs = 0.0, dict.fromkeys(self.costs, 0.0)
        weight, steps = 1.0, min(horizon, math.ceil(40 / max(1 - gamma, 1e-9)))
        for _ in range(int(steps)):
            reward -= weight * float(np.trace(_Q @ moment))
            for name in costs:
                on_state, on_action = _COSTS[name]
                spent = np.trace(on_state @ moment) + on_action * (gain @ moment @ gain)
                costs[name] += weight * float(spent)
            moment, weight = closed @ moment @ closed.T + shock, weight * gamma
        return reward, *costs.values()

    def gain(self, multipliers: float | Sequence[float], gamma: float) -> np.ndarray:
        """The policy [2] that is best for reward - multipliers * costs, discounted for ever (Riccati)."""
        pairs = [*zip(np.atleast_1d(multipliers), map(_COSTS.__getitem__, self.costs), strict=True)]
        on_state = _Q + sum(weight * each for weight, (each, _) in pairs)
        on_action = np.array([[sum(weight * each for weight, (_, each) in pairs)]])
        decay = gamma**0.5
        value = solve_discrete_are(decay * _A, decay * _B, on_state, on_action)
        inner = on_action + gamma * _B.T @ value @ _B
        return (gamma * np.linalg.solve(inner, _B.T @ value @ _A))[0]

    def optimum(
        self,
        limit: float | Sequence[float],
        gamma: float,
        cost_gamma: float | None = None,
        horizon: float = math.inf,
    ) -> np.ndarray:
        """The best policy [2] whose cost is at most ``limit``.

        Args:
            limit: on the expected sum of each cost.
            gamma: discount of the reward, and of the cost in what a multiplier trades.
            cost_gamma: discount of the cost in the limit; as ``gamma`` by default.
            horizon: decisions of the sum that is limited.

        Raises:
            ValueError: a limit does not bind, or none of its policies keeps all of them.
        """
        cost_gamma = gamma if cost_gamma is None else cost_gamma

        def excess(log_multipliers: np.ndarray) -> np.ndarray:
            gain = self.gain(np.exp(log_multipliers.clip(-12.0, 12.0)), gamma)  # pyright: ignore
            costs = np.array(self.sums(gain, cost_gamma, horizon)[1:])
            return np.log(costs / np.asarray(limit))

        found = root(excess, np.zeros(len(self.costs)), tol=1e-12)
        if not np.abs(excess(found.x)).max() < 1e-6:
            raise ValueError(
                f"limit={limit} does not bind: the best policy costs less, or none that."
            )
        return self.gain(np.exp(found.x), gamma)  # pyright: ignore


class CartEnv(SeededEnv):
    """:class:`Cart` as a batch of tensors.

    Args:
        task: its settings.
        num_envs: B.
        seed: of the sequences of episodes; None: others each time.
        device: of the tensors.

    Reads ``action`` [B, 1] in [-1, 1]. Writes ``observation`` [B, 2], ``reward`` [B, 1] and ``cost`` [B, K].

    >>> CartEnv(Cart(), num_envs=3).rollout(2)["next", "cost"].shape
    torch.Size([3, 2, 1])
    """

    kept = (*SeededEnv.kept, "_seeds", "_steps", "_state")

    def __init__(self, task: Cart, num_envs: int = 1, seed: int | None = None, device=None):
        super().__init__(task, num_envs, device)
        batch = self.batch_size
        self.observation_spec = Composite(observation=Unbounded(shape=(*batch, 2)), shape=batch)
        self.action_spec = Bounded(-1.0, 1.0, shape=(*batch, 1))
        self._make_ends()
        self._state = torch.zeros(*batch, 2, device=self.device)
        self._seeds = torch.zeros(batch, dtype=torch.int64, device=self.device)
        self._steps = torch.zeros_like(self._seeds)
        self._matrices = [torch.tensor(m, dtype=self.real, device=self.device) for m in (_A, _B)]
        self.set_seed(seed)

    def _reset(
        self, tensordict: TensorDictBase | None = None, seeds: Tensor | None = None, **kwargs
    ) -> TensorDictBase:
        reset = self._reset_mask(tensordict)
        self._seeds = torch.where(reset, self._next_seeds(reset, seeds), self._seeds)
        self._steps = torch.where(reset, 0, self._steps)
        drawn = torch.stack([uniform(self._seeds, stream) for stream in (0, 1)], -1)
        start = ((2 * drawn - 1) * self.task.spread).to(self._state)
        self._state = torch.where(reset[:, None], start, self._state)
        return TensorDict(
            {"observation": self._state.clone()}, batch_size=self.batch_size, device=self.device
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        state, (A, B) = self._state, self._matrices
        action = tensordict.get("action").to(state).clamp(-1.0, 1.0)
        reward = -(state.square() @ state.new_tensor(np.diag(_Q)).unsqueeze(-1))
        costs = {"effort": action.square(), "motion": state[:, 1:].square()}
        shock = (2 * uniform(self._seeds + (self._steps << 32), 2) - 1) * self.task.noise
        self._state = state @ A.T + action @ B.T
        self._state[:, 1] += shock.to(state)
        self._steps = self._steps + 1
        done = (self._steps >= self.task.horizon)[:, None]
        return TensorDict(
            {
                "observation": self._state.clone(),
                "reward": reward,
                "cost": torch.cat([costs[name] for name in self.task.costs], -1),
                "terminated": torch.zeros_like(done),
                "truncated": done,
                "done": done.clone(),
            },
            batch_size=self.batch_size,
            device=self.device,
        )
