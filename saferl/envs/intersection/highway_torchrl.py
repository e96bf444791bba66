"""The highway-env intersection as a TorchRL environment."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from saferl.envs.intersection.base import OUTCOMES, ReplayedIntersection
from saferl.envs.intersection.geometry import ROUTES
from saferl.envs.intersection.highway import IntersectionEnv
from saferl.envs.intersection.scenario import Scenario
from saferl.envs.intersection.traffic import Vehicles


class HighwayIntersection(ReplayedIntersection):
    """``num_envs`` highway-env intersections, stepped one after the other in this process.

    Same specs, keys, units and seeds as :class:`BatchedIntersection`. For several processes wrap it in
    TorchRL's ``ParallelEnv``.

    Args:
        task: its settings.
        num_envs: B.
        seed: of the sequences of episodes; None: others each time.
        device: of the tensors; the simulation itself runs on the CPU.

    >>> env = HighwayIntersection(Scenario(task="gs", vehicles=2), num_envs=2)
    >>> env.rollout(2)["next", "cost"].shape
    torch.Size([2, 2, 1])
    """

    def __init__(self, task: Scenario, num_envs: int = 1, seed: int | None = None, device=None):
        super().__init__(task, num_envs, seed, device)
        fields = [f.name for f in dataclasses.fields(task) if f.name != "test_frequency"]
        settings = {name: getattr(task, name) for name in fields}
        self.envs = [IntersectionEnv(**settings, render_mode="rgb_array") for _ in range(num_envs)]
        self._make_memory()

    @staticmethod
    def _entry(observation: dict, info: dict) -> dict:
        outcomes = {key: info[key] for key in (*OUTCOMES, "cost")}
        return {**observation, **outcomes, "route": ROUTES.index(info["route"])}

    def _start(self, index: int, seed: int) -> dict:
        return self._entry(*self.envs[index].reset(seed=seed))

    def _advance(self, index: int, action: np.ndarray) -> dict:
        observation, reward, terminated, truncated, info = self.envs[index].step(action)
        ends = {"terminated": terminated, "truncated": truncated, "done": terminated or truncated}
        return {**self._entry(observation, info), "reward": reward, **ends}

    def scene(self) -> tuple[Tensor, Vehicles]:
        """The true states of the egos [B, 6], and the surrounding vehicles [N, B], seen or not; on the CPU."""
        egos = torch.stack([env.ego.state for env in self.envs])
        fields = zip(*(env.road.surrounding for env in self.envs), strict=True)
        return egos, Vehicles(*(torch.stack(field, -1) for field in fields))

    def render(self, index: int) -> np.ndarray | None:
        return self.envs[index].render()
