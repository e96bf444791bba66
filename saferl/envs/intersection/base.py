# TorchRL's specs take tuples that their annotations do not name.
# pyright: reportArgumentType=false
"""What both backends of the intersection share: settings, specs, seeds."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from saferl.envs.intersection.cost import CollisionCost
from saferl.envs.intersection.geometry import ROUTES, ROUTES_OF_TASK
from saferl.envs.intersection.observation import ROWS
from saferl.envs.intersection.reward import Reward

SUBSTEPS = 3
STANDING = 0.3  # m/s, slower counts as standing still
OUTCOMES = ("collision", "offroad", "success")


@dataclass(frozen=True)
class Scenario:
    """Settings of the driving task, the same for every backend.

    Attributes:
        task: ``lt``, ``gs``, ``rt``, or ``mixed`` (one drawn at each reset).
        vehicles: surrounding vehicles drawn at reset.
        rows: M, rows of the ``vehicles`` observation; one is always padding.
        policy_frequency: decisions per second; each is integrated in 3 substeps.
        duration: seconds until ``truncated``.
        route_starts: fraction of the starts drawn uniformly along the route instead of 40 m before
            the box (training only).
        standstill: seconds after which a car that stands still is ``truncated`` (training only, ours):
            learners bootstrap through it, so that the task is the same and fewer of the stored frames
            show a parked car. None: never.
        reward, cost: see :class:`Reward` and :class:`CollisionCost`.

    >>> Scenario(task="uturn")
    Traceback (most recent call last):
    ...
    ValueError: task must be one of lt, gs, rt, mixed, got 'uturn'.
    """

    task: str = "mixed"
    vehicles: int = 10
    rows: int = ROWS
    policy_frequency: int = 5
    duration: float = 25.0
    route_starts: float = 0.0
    standstill: float | None = None
    reward: Reward = field(default_factory=Reward)
    cost: CollisionCost = field(default_factory=CollisionCost)

    def __post_init__(self):
        if self.task not in ROUTES_OF_TASK:
            raise ValueError(f"task must be one of {', '.join(ROUTES_OF_TASK)}, got {self.task!r}.")
        if self.vehicles < 0:
            raise ValueError(f"vehicles must be >= 0, got {self.vehicles}.")
        if self.rows < 1:
            raise ValueError(f"rows must be >= 1, got {self.rows}.")
        if self.policy_frequency <= 0:
            raise ValueError(f"policy_frequency must be > 0, got {self.policy_frequency}.")
        if self.duration <= 0:
            raise ValueError(f"duration must be > 0 seconds, got {self.duration}.")
        if not 0.0 <= self.route_starts <= 1.0:
            raise ValueError(f"route_starts must be in [0, 1], got {self.route_starts}.")

        if self.standstill is not None and self.standstill <= 0:
            raise ValueError(f"standstill must be null or > 0 seconds, got {self.standstill}.")

    @property
    def patience(self) -> float:
        """Decisions in a row that a car may stand still."""
        return float("inf") if self.standstill is None else self.standstill * self.policy_frequency

    @property
    def horizon(self) -> int:
        """Decisions in an episode."""
        return round(self.duration * self.policy_frequency)

    @property
    def dt(self) -> float:
        """Length of a substep, seconds."""
        return 1.0 / (SUBSTEPS * self.policy_frequency)


_MIX = (-7046029254386353131, -4658895280553007687, -7723592293110705685)
_U31 = 0x7FFFFFFF


def _shift(x: Tensor, bits: int) -> Tensor:
    return (x >> bits) & ((1 << (64 - bits)) - 1)


def mix(seed: Tensor, stream: int | Tensor) -> Tensor:
    """Hash int64 seeds [...] and a stream number into new int64 seeds (SplitMix64's finaliser).

    A draw is a function of its seed alone, so an episode does not feel its neighbours.
    """
    x = seed + torch.as_tensor(stream + 1, device=seed.device) * _MIX[0]
    x = (x ^ _shift(x, 30)) * _MIX[1]
    x = (x ^ _shift(x, 27)) * _MIX[2]
    return x ^ _shift(x, 31)


def uniform(seed: Tensor, stream: int) -> Tensor:
    """A number in [0, 1), float64 [...], from int64 seeds [...] and a stream number."""
    return _shift(mix(seed, stream), 11).to(torch.float64) * 2.0**-53


def episode_seeds(seed: int, count: int) -> Tensor:
    """Seeds [count] of the episodes of a test with this seed."""
    return mix(torch.arange(count, dtype=torch.int64), seed) & _U31


class IntersectionBase(EnvBase):
    """Specs and seeding of the intersection; subclasses drive it.

    Reads ``action`` [B, 2] in [-1, 1]: a_x / 5 m/s^2, delta_f / 0.6 rad. Writes ``ego`` [B, 9] and
    ``vehicles`` [B, M, 6] (:func:`observe`), ``route`` [B, 1] int64, the outcomes ``collision``,
    ``offroad``, ``success`` [B, 1] bool, and ``reward`` and ``cost`` [B, 1].

    A reset may be told which episodes to play by an int64 key ``seed`` [B] or [B, 1]; without it
    every environment goes on in its own sequence of episodes, which follows from ``set_seed``.
    """

    def __init__(self, scenario: Scenario, num_envs: int, seed: int, device=None):
        if num_envs < 1:
            raise ValueError(f"num_envs must be >= 1, got {num_envs}.")
        super().__init__(device=device, batch_size=[num_envs])
        self.scenario = scenario
        self._make_specs()
        self.set_seed(seed)

    def _make_specs(self) -> None:
        batch = self.batch_size
        flag = Binary(n=1, shape=(*batch, 1), dtype=torch.bool)
        scalar = Unbounded(shape=(*batch, 1))
        self.observation_spec = Composite(
            ego=Unbounded(shape=(*batch, 9)),
            vehicles=Unbounded(shape=(*batch, self.scenario.rows, 6)),
            route=Categorical(len(ROUTES), shape=(*batch, 1), dtype=torch.int64),
            **{name: flag.clone() for name in OUTCOMES},
            shape=batch,
        )
        self.action_spec = Bounded(-1.0, 1.0, shape=(*batch, 2))
        self.reward_spec = Composite(reward=scalar.clone(), cost=scalar.clone(), shape=batch)
        self.full_done_spec = Composite(
            done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=batch
        )
        self.to(self.device) if self.device is not None else None

    def _set_seed(self, seed: int | None) -> None:
        index = torch.arange(self.batch_size[0], dtype=torch.int64, device=self.device)
        self._stream = mix(index + int(seed or 0) * self.batch_size[0], 0)
        self._episode = torch.zeros_like(self._stream)

    def _next_seeds(self, tensordict: TensorDictBase | None, reset: Tensor) -> Tensor:
        """Episode seeds [B] (31 bits) for the environments in ``reset`` [B]; advances those alone."""
        given = None if tensordict is None else tensordict.get("seed", None)
        if given is not None:
            return given.reshape(self.batch_size).to(torch.int64)
        seeds = mix(self._stream, self._episode) & _U31
        self._episode = self._episode + reset
        return seeds

    def _reset_mask(self, tensordict: TensorDictBase | None) -> Tensor:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            return torch.ones(self.batch_size, dtype=torch.bool, device=self.device)
        return mask.reshape(self.batch_size)

    def _output(self, values: dict[str, Tensor]) -> TensorDict:
        """Shape [B] tensors to the specs' [B, 1]."""
        out = {
            key: value if key in ("ego", "vehicles") else value.reshape(*self.batch_size, 1)
            for key, value in values.items()
        }
        return TensorDict(out, batch_size=self.batch_size, device=self.device)

    def snapshot(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """States of the ego [6] and of the others [N, 6] of one environment, float64."""
        raise NotImplementedError

    def render(self, index: int) -> np.ndarray | None:
        """A picture [H, W, 3] uint8 of one environment, or None where a backend draws none."""
        return None
