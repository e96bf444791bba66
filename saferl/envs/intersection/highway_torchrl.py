"""The highway-env intersection as a TorchRL environment."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from saferl.envs.intersection.base import OUTCOMES, IntersectionBase, Scenario
from saferl.envs.intersection.geometry import ROUTES
from saferl.envs.intersection.highway import IntersectionEnv


class HighwayIntersection(IntersectionBase):
    """``num_envs`` highway-env intersections, stepped one after the other in this process.

    Same specs, keys, units and seeds as :class:`BatchedIntersection`. An episode that has ended
    stands still until its reset, so that playing a batch to its last end costs nothing more. For
    several processes wrap it in TorchRL's ``ParallelEnv``.

    Args:
        scenario: the task.
        num_envs: B.
        seed: of the sequences of episodes.
        device: of the tensors; the simulation itself runs on the CPU.

    >>> env = HighwayIntersection(Scenario(task="gs", vehicles=2), num_envs=2)
    >>> env.rollout(2)["next", "cost"].shape
    torch.Size([2, 2, 1])
    """

    def __init__(self, scenario: Scenario, num_envs: int = 1, seed: int = 0, device=None):
        super().__init__(scenario, num_envs, seed, device)
        settings = {f.name: getattr(scenario, f.name) for f in dataclasses.fields(scenario)}
        self.envs = [IntersectionEnv(**settings, render_mode="rgb_array") for _ in range(num_envs)]
        self._seeds = torch.zeros(num_envs, dtype=torch.int64)
        self._actions: list[list[np.ndarray]] = [[] for _ in range(num_envs)]
        self._last: list[dict] = [{} for _ in range(num_envs)]

    def _stack(self, keys: tuple[str, ...]) -> TensorDictBase:
        values = {
            key: torch.from_numpy(np.stack([np.asarray(last[key]) for last in self._last]))
            for key in keys
        }
        if "reward" in values:
            values |= {key: values[key].float() for key in ("reward", "cost")}
        return self._output({key: value.to(self.device or "cpu") for key, value in values.items()})

    @staticmethod
    def _entry(observation: dict, info: dict) -> dict:
        outcomes = {key: info[key] for key in (*OUTCOMES, "cost")}
        return {**observation, **outcomes, "route": ROUTES.index(info["route"])}

    def _reset_one(self, index: int) -> None:
        self._actions[index] = []
        observation, info = self.envs[index].reset(seed=int(self._seeds[index]))
        self._last[index] = self._entry(observation, info)

    def _step_one(self, index: int, action: np.ndarray) -> None:
        if self._last[index].get("done"):
            return
        self._actions[index].append(action)
        observation, reward, terminated, truncated, info = self.envs[index].step(action)
        self._last[index] = {
            **self._entry(observation, info),
            "reward": reward,
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated or truncated,
        }

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDictBase:
        reset = self._reset_mask(tensordict)
        self._seeds = torch.where(
            reset, self._next_seeds(tensordict, reset), self._seeds.to(reset.device)
        ).cpu()
        for index in reset.nonzero().flatten().tolist():
            self._reset_one(index)
        return self._stack(("ego", "vehicles", "route", *OUTCOMES))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        for index, action in enumerate(tensordict.get("action").cpu().numpy()):
            self._step_one(index, action.copy())
        ends = ("reward", "cost", "terminated", "truncated", "done")
        return self._stack(("ego", "vehicles", "route", *OUTCOMES, *ends))

    def snapshot(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """States of the ego [6] and of the others [N, 6], float64: row k is vehicle k, NaN while it
        is not on the road."""
        ego, there = self.envs[index].snapshot()
        others = np.full((self.scenario.traffic.vehicles[1], 6), np.nan)
        others[self.envs[index].road.slot] = there
        return ego, others

    def render(self, index: int) -> np.ndarray | None:
        return self.envs[index].render()

    def state_dict(self, *args, **kwargs) -> dict[str, Tensor]:
        """Seeds, and the actions of the running episodes: an episode follows from these."""
        state = {"stream": self._stream, "episode": self._episode, "seeds": self._seeds}
        for index, actions in enumerate(self._actions):
            state[f"actions_{index}"] = torch.from_numpy(
                np.stack(actions) if actions else np.zeros((0, 2), np.float32)
            )
        return state

    def load_state_dict(self, state_dict: dict[str, Tensor], *args, **kwargs) -> None:
        """Replay the running episodes up to where :meth:`state_dict` was taken."""
        self._stream = state_dict["stream"].to(self.device or "cpu").clone()
        self._episode = state_dict["episode"].to(self.device or "cpu").clone()
        self._seeds = state_dict["seeds"].cpu().clone()
        for index in range(len(self.envs)):
            self._reset_one(index)
            for action in state_dict[f"actions_{index}"].cpu().numpy():
                self._step_one(index, action)
