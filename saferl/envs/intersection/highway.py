"""The intersection as a gymnasium environment on highway-env's road and vehicles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from saferl.envs.intersection.collision_cost import CollisionCost
from saferl.envs.intersection.costs import Decision, costs_of
from saferl.envs.intersection.dynamics import to_physical
from saferl.envs.intersection.geometry import (
    ROUTES,
    ROUTES_OF_TASK,
    TASK_OF_ROUTE,
    TASKS,
    arrived,
    offroad,
    overlap,
)
from saferl.envs.intersection.observation import ROWS, observe
from saferl.envs.intersection.regulation import IntersectionRoad
from saferl.envs.intersection.rendering import Renderer
from saferl.envs.intersection.reward import Reward
from saferl.envs.intersection.scenario import STANDING, SUBSTEPS, Scenario, build
from saferl.envs.intersection.spawning import (
    Traffic,
    draw_route,
    draw_start,
    draw_traffic,
    sense,
)
from saferl.envs.intersection.traffic import drive_in, respawn
from saferl.envs.intersection.vehicles import EgoVehicle


class IntersectionEnv(gymnasium.Env):
    """Drive the ego through an unsignalised intersection with up to ten other vehicles.

    The observation is a dict of ``ego`` [F] and ``vehicles`` [rows, G] (:func:`observe`, SI units),
    the action [2] in [-1, 1] is (a_x / 5 m/s^2, delta_f / 0.6 rad). ``info`` holds ``cost``
    (:class:`CollisionCost` of the state before the step and the executed action; 0.0 at reset; an array [K] of several
    ``costs``), the outcomes ``collision``, ``offroad``, ``success``, and ``route`` and ``task``.

    All randomness comes from ``np_random``: the same seed and actions give the same episode, bit
    for bit. ``reset`` takes ``options``: ``task`` (one episode on another task), ``route`` (a name
    in :data:`ROUTES`) and ``start`` (the ego's state [6]).

    Args:
        task, vehicles, scenario, traffic, rows, observation, policy_frequency, duration, route_starts, standstill:
            see :class:`Scenario`.
        reward: a :class:`Reward` or its fields, e.g. ``{"reading": "raw", "risk_shaping": True}``.
        cost: a :class:`CollisionCost` or its fields.
        costs: names, see :class:`Scenario`.
        render_mode: None or ``rgb_array``.

    >>> env = IntersectionEnv(task="lt")
    >>> observation, info = env.reset(seed=0)
    >>> observation["vehicles"].shape, info["success"]
    ((11, 12), False)
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012

    def __init__(
        self,
        task: str = "mixed",
        vehicles: int | None = None,
        scenario: str = "nominal",
        traffic: Traffic | Mapping[str, Any] | None = None,
        rows: int = ROWS,
        observation: str = "route",
        policy_frequency: int = 5,
        duration: float = 25.0,
        route_starts: float = 0.0,
        standstill: float | None = None,
        reward: Reward | Mapping[str, Any] | None = None,
        cost: CollisionCost | Mapping[str, Any] | None = None,
        costs: Sequence[str] = ("cost",),
        render_mode: str | None = None,
    ):
        settings: Any = traffic or {}
        self.scenario = Scenario(
            task=task, vehicles=vehicles, scenario=scenario, traffic=settings, rows=rows,
            observation=observation, policy_frequency=policy_frequency, duration=duration, route_starts=route_starts,
            standstill=standstill, reward=build("reward", Reward(), reward or {}),
            cost=build("cost", CollisionCost(), cost or {}), costs=tuple(costs),
        )  # fmt: skip
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise ValueError(
                f"render_mode must be None or one of {', '.join(modes)}, got {render_mode!r}."
            )
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": policy_frequency}
        form = self.scenario.form
        unbounded = {"low": -np.inf, "high": np.inf, "dtype": np.float32}
        self.observation_space = spaces.Dict(
            {
                "ego": spaces.Box(shape=(len(form.ego),), **unbounded),
                "vehicles": spaces.Box(shape=(rows, len(form.vehicle)), **unbounded),
            }
        )
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.road = IntersectionRoad()
        self._renderer: Renderer | None = None

    @property
    def ego(self) -> EgoVehicle:
        """The ego vehicle of the running episode."""
        if self.road.ego is None:
            raise gymnasium.error.ResetNeeded("reset the environment first.")
        return self.road.ego

    def snapshot(self) -> tuple[np.ndarray, np.ndarray]:
        """States of the ego [6] and of the surrounding vehicles [N, 6], float64, for plots."""
        present = self.road.surrounding.present
        return self.ego.state.numpy().copy(), self.road.states[present].numpy()

    def _choose_route(self, options: Mapping[str, Any], seed: torch.Tensor) -> torch.Tensor:
        if (name := options.get("route")) is not None:
            if name not in ROUTES:
                raise ValueError(f"options.route must be one of {', '.join(ROUTES)}, got {name!r}.")
            return torch.tensor(ROUTES.index(name))
        task = options.get("task", self.scenario.task)
        if task not in ROUTES_OF_TASK:
            raise ValueError(
                f"options.task must be one of {', '.join(ROUTES_OF_TASK)}, got {task!r}."
            )
        return draw_route(task, seed)

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Draw a scene; ``options`` may hold ``task``, ``route`` and ``start``."""
        super().reset(seed=seed)
        options = options or {}
        unknown = set(options) - {"task", "route", "start"}
        if unknown:
            raise ValueError(f"options must be among task, route, start, got {sorted(unknown)}.")
        # A given seed decides route and start by itself, so that both backends start alike.
        draw = torch.tensor(int(self.np_random.integers(2**31)) if seed is None else seed)
        self._route = self._choose_route(options, draw)
        start = options.get("start")
        if start is None:
            start = draw_start(self._route, draw, self.scenario.route_starts)
        start = torch.as_tensor(start, dtype=torch.float64)
        if start.shape != (6,):
            raise ValueError(f"options.start must have shape (6,), got {tuple(start.shape)}.")
        self.road.np_random = self.np_random  # pyright: ignore[reportAttributeAccessIssue]
        ego = EgoVehicle(self.road, start, int(self._route))
        self._seed, self._steps, self._still, self._control = draw, 0, 0, None
        traffic = draw_traffic(self.scenario.traffic, self._route, start, draw)
        self.road.populate(ego, drive_in(traffic, torch.float64))
        return self._observe(), self._info(
            torch.zeros(len(self.scenario.costs)), False, False, False
        )

    def _observe(self) -> dict[str, np.ndarray]:
        scenario, state = self.scenario, self.ego.state
        self._vehicles = others = self.road.states
        present = self.road.surrounding.present
        how = scenario.rows, scenario.observation
        self._own, table, self._observed = observe(state, others, present, self._route, *how)
        own = self._own
        if not scenario.traffic.sensed_exactly:
            slot, steps = torch.arange(len(others)), torch.tensor(self._steps)
            sensed = sense(scenario.traffic, others, present, slot, self._seed, steps)
            own, table, _ = observe(state, *sensed, self._route, *how)
        return {"ego": own.float().numpy(), "vehicles": table.float().numpy()}

    def _respawn(self) -> None:
        """Let one vehicle that has left the road enter it again, if its approach is free."""
        now, steps = self.road.surrounding, torch.tensor(self._steps)
        self.road.replace(respawn(self.scenario.traffic, now, self._route, self._seed, steps))

    def _info(self, cost: Tensor, collision: bool, off: bool, success: bool) -> dict[str, Any]:
        route = int(self._route)
        return {
            "cost": cost.numpy() if len(cost) > 1 else float(cost),
            "collision": collision,
            "offroad": off,
            "success": success,
            "route": ROUTES[route],
            "task": TASKS[TASK_OF_ROUTE[route]],
        }

    def _collides(self) -> bool:
        ego, others = (state[..., [0, 1, 4]] for state in (self.ego.state, self.road.states))
        return bool((overlap(ego, others) & self.road.surrounding.present).any())

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Hold ``action`` [2] for one decision (three substeps; a collision ends it at once)."""
        ego, scenario = self.ego, self.scenario
        control = to_physical(torch.as_tensor(np.asarray(action), dtype=torch.float64))
        previous = control if self._control is None else self._control
        predicted = scenario.cost(ego.state, control, self._vehicles, self._observed)
        ego.act(control)
        collision = False
        for _ in range(SUBSTEPS):
            self.road.act()
            self.road.step(scenario.dt)
            collision = self._collides()
            if collision:
                break
        if scenario.traffic.respawn:
            self._respawn()
        self._control, self._steps = control, self._steps + 1
        observation = self._observe()
        off = bool(offroad(ego.state))
        hit, left, seconds = (
            torch.tensor(collision),
            torch.tensor(off),
            1.0 / scenario.policy_frequency,
        )
        decision = Decision(scenario.cost, predicted, hit, left, ego.state, control, seconds)
        cost = costs_of(scenario.costs, decision)
        success = not (collision or off) and bool(arrived(ego.state, self._route))
        reward = scenario.reward(
            ego.state, self._route, control, previous, self._own[-2], self._own[-1],
            self._observed.any(), torch.tensor(collision or off), torch.tensor(success),
        )  # fmt: skip
        self._still = self._still + 1 if ego.state[2] < STANDING else 0
        terminated = collision or off or success or self._still >= scenario.patience
        truncated = self._steps >= scenario.horizon
        info = self._info(cost, collision, off, success)
        return observation, float(reward), terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """The scene [600, 600, 3] uint8 with ``render_mode="rgb_array"``, else None."""
        if self.render_mode is None:
            return None
        if self.road.ego is None:
            raise gymnasium.error.ResetNeeded("reset the environment before rendering it.")
        if self._renderer is None:
            self._renderer = Renderer()
        return self._renderer.draw(self.road)

    def close(self) -> None:
        """Let go of the drawing surface."""
        self._renderer = None
