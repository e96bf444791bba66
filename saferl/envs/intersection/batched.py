"""The intersection as one batch of tensors."""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from saferl.envs.intersection.base import STANDING, SUBSTEPS, IntersectionBase, Scenario, uniform
from saferl.envs.intersection.dynamics import step_ego, to_physical
from saferl.envs.intersection.geometry import (
    ARM,
    EXIT_DISTANCE,
    ROUTES_OF_TASK,
    arrived,
    line_pose,
    offroad,
    reference_lines,
)
from saferl.envs.intersection.observation import observe


def draw_route(task: str, seed: Tensor) -> Tensor:
    """Routes [...] int64 of a task; ``mixed`` draws the task first, then its lane."""
    tasks = [ROUTES_OF_TASK[name] for name in (("lt", "gs", "rt") if task == "mixed" else (task,))]
    table = torch.tensor([[lanes[0], lanes[-1]] for lanes in tasks], device=seed.device)
    row = (uniform(seed, 0) * len(tasks)).long()
    return table[row, (uniform(seed, 1) * 2).long()]


def draw_start(route: Tensor, seed: Tensor, route_starts: float) -> Tensor:
    """Start states [..., 6] float64: 40 +- 5 m before the box at U[6, 10] m/s, or, for the share
    ``route_starts`` of the seeds, anywhere between there and the goal."""
    anywhere = uniform(seed, 2) < route_starts
    before = ARM - 40.0 + 10.0 * (uniform(seed, 3) - 0.5)
    lines = reference_lines(route, before)[..., 0, :, :]
    past = lines[..., 3, 5] + EXIT_DISTANCE
    first = ARM - 45.0
    s = torch.where(anywhere, first + (past - first) * uniform(seed, 3), before)
    x, y, phi = line_pose(lines, s).unbind(-1)
    speed = 6.0 + 4.0 * uniform(seed, 4)
    zero = torch.zeros_like(x)
    return torch.stack([x, y, speed, zero, phi, zero], -1)


class BatchedIntersection(IntersectionBase):
    """The CMDP on an empty road, B environments in one set of tensors, on CPU or GPU.

    Args:
        scenario: the task; ``vehicles`` must be 0, traffic needs the highway-env backend.
        num_envs: B.
        seed: of the sequences of episodes.
        device: torch device.

    >>> env = BatchedIntersection(Scenario(task="lt", vehicles=0), num_envs=3)
    >>> env.rollout(4)["next", "ego"].shape
    torch.Size([3, 4, 9])
    """

    def __init__(self, scenario: Scenario, num_envs: int = 1, seed: int = 0, device=None):
        if scenario.vehicles:
            raise ValueError(
                f"env=batched drives on an empty road: vehicles must be 0, got {scenario.vehicles}. "
                "Use env=highway for traffic."
            )
        super().__init__(scenario, num_envs, seed, device)
        self._vehicles = torch.zeros(num_envs, 0, 6, device=device)
        self._present = torch.zeros(num_envs, 0, dtype=torch.bool, device=device)
        self._state: dict[str, Tensor] = {}

    def _observe(self) -> tuple[dict[str, Tensor], Tensor]:
        ego, route = self._state["ego"], self._state["route"]
        own, vehicles, observed = observe(
            ego, self._vehicles, self._present, route, self.scenario.rows
        )
        return {"ego": own, "vehicles": vehicles, "route": route}, observed

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDictBase:
        reset = self._reset_mask(tensordict)
        seeds = self._next_seeds(tensordict, reset)
        route = draw_route(self.scenario.task, seeds)
        fresh = {
            "ego": draw_start(route, seeds, self.scenario.route_starts).float(),
            "control": torch.zeros(*self.batch_size, 2, device=self.device),
            "steps": torch.zeros(self.batch_size, dtype=torch.int64, device=self.device),
            "still": torch.zeros(self.batch_size, dtype=torch.int64, device=self.device),
            "route": route,
        }
        old = self._state or fresh
        self._state = {
            key: torch.where(reset.reshape(-1, *[1] * (value.ndim - 1)), value, old[key])
            for key, value in fresh.items()
        }
        observation, _ = self._observe()
        no = torch.zeros_like(reset)
        return self._output(observation | {"collision": no, "offroad": no, "success": no})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        scenario, state = self.scenario, self._state
        control = to_physical(tensordict["action"])
        previous = torch.where(state["steps"][:, None] == 0, control, state["control"])
        _, observed = self._observe()
        cost = scenario.cost(state["ego"], control, self._vehicles, observed)
        ego = state["ego"]
        for _ in range(SUBSTEPS):
            ego = step_ego(ego, control, scenario.dt)
        self._state = state | {
            "ego": ego,
            "control": control,
            "steps": state["steps"] + 1,
            "still": torch.where(ego[:, 2] < STANDING, state["still"] + 1, 0),
        }
        observation, observed = self._observe()
        off = offroad(ego)
        collision = torch.zeros_like(off)
        success = arrived(ego, state["route"]) & ~off & ~collision
        own = observation["ego"]
        reward = scenario.reward(
            ego, state["route"], control, previous, own[:, 7], own[:, 8], observed.any(-1),
            off | collision, success,
        )  # fmt: skip
        terminated = off | collision | success
        truncated = self._state["steps"] >= scenario.horizon
        truncated = truncated | (self._state["still"] >= scenario.patience)
        return self._output(
            observation
            | {
                "collision": collision,
                "offroad": off,
                "success": success,
                "reward": reward,
                "cost": cost,
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            }
        )

    def snapshot(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        others = self._vehicles[index][self._present[index]]
        return self._state["ego"][index].double().cpu().numpy(), others.double().cpu().numpy()

    def state_dict(self, *args, **kwargs) -> dict[str, Tensor]:
        """Everything that decides what comes next: vehicle states and episode sequences."""
        return {"stream": self._stream, "episode": self._episode, **self._state}

    def load_state_dict(self, state_dict: dict[str, Tensor], *args, **kwargs) -> None:
        """Continue exactly where :meth:`state_dict` was taken."""
        state = {key: value.to(self.device or "cpu").clone() for key, value in state_dict.items()}
        self._stream, self._episode = state.pop("stream"), state.pop("episode")
        self._state = state
