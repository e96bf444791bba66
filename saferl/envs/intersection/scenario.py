"""The settings of the intersection, the same for every backend."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from saferl.envs.intersection.collision_cost import CollisionCost
from saferl.envs.intersection.costs import COSTS
from saferl.envs.intersection.drivers import DRIVERS
from saferl.envs.intersection.dynamics import ACTION_SCALE
from saferl.envs.intersection.from_state import FromState
from saferl.envs.intersection.geometry import ROUTES, ROUTES_OF_TASK, TASK_OF_ROUTE
from saferl.envs.intersection.observation import FORMS, ROWS, Form, reading
from saferl.envs.intersection.reward import Reward
from saferl.envs.intersection.spawning import SCENARIOS, Traffic, draw_route
from saferl.envs.intersection.yielding import PERIOD
from saferl.envs.ports import Feature
from saferl.envs.task import Task

SUBSTEPS = 3
STANDING = 0.3  # m/s, slower counts as standing still


def build(name: str, default: Any, value: Any) -> Any:
    """Settings from a dataclass ``default`` and the mapping of what differs.

    Raises:
        ValueError: an unknown key, with those that there are; what the dataclass refuses.

    >>> build("reward", Reward(), {"raeding": "raw"})
    Traceback (most recent call last):
    ...
    ValueError: reward.raeding is unknown; choose from reading, risk_shaping, collision, arrival, \
speed, destination_scale, weights, energy, smoothness.
    """
    if isinstance(value, type(default)):
        return value
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} must be a {type(default).__name__} or a mapping, got {value!r}.")
    known = [field.name for field in dataclasses.fields(default)]
    for key in value:
        if key not in known:
            raise ValueError(f"{name}.{key} is unknown; choose from {', '.join(known)}.")
    return dataclasses.replace(default, **value)


@dataclass(frozen=True)
class Scenario(Task):
    """Settings of the driving task, the same for every backend.

    Attributes:
        task: ``lt``, ``gs``, ``rt``, or ``mixed`` (one drawn at each reset).
        vehicles: surrounding vehicles drawn at reset; None: as many as the scenario says.
        rows: M, rows of the ``vehicles`` observation; one is always padding.
        observation: a name in :data:`FORMS`: ``route``, along the ego's route, or ``world`` (paper).
        scenario: the traffic: a name in :data:`SCENARIOS`.
        traffic: a :class:`Traffic`, or a mapping of what differs from the scenario's.
        policy_frequency: decisions per second; each is integrated in 3 substeps.
        test_frequency: decisions per second in a test.
        duration: seconds until ``truncated``.
        route_starts: fraction of the starts drawn uniformly along the route instead of 40 m before
            the box (training only).
        standstill: seconds after which a car that stands still is ``terminated`` (training only, ours):
            nothing more can be earned, so that the value of standing does not rest on itself. None:
            never.
        reward, cost: see :class:`Reward` and :class:`CollisionCost`.
        costs: what ``cost`` holds, names in :data:`COSTS`: ``cost``, collisions and the road in one; or several of
            ``collision``, ``road``, ``comfort``, ``speed``.

    >>> Scenario(task="uturn")
    Traceback (most recent call last):
    ...
    ValueError: task must be one of lt, gs, rt, mixed, got 'uturn'.
    """

    task: str = "mixed"
    vehicles: int | None = None
    scenario: str = "nominal"
    traffic: Traffic = field(default_factory=dict)  # pyright: ignore  (a mapping becomes a Traffic)
    rows: int = ROWS
    observation: str = "route"
    policy_frequency: int = 5
    test_frequency: int = 10
    duration: float = 25.0
    route_starts: float = 0.0
    standstill: float | None = None
    reward: Reward = field(default_factory=Reward)
    cost: CollisionCost = field(default_factory=CollisionCost)
    costs: tuple[str, ...] = ("cost",)

    def __post_init__(self):
        if self.task not in ROUTES_OF_TASK:
            raise ValueError(f"task must be one of {', '.join(ROUTES_OF_TASK)}, got {self.task!r}.")
        if self.vehicles is not None and self.vehicles < 0:
            raise ValueError(f"vehicles must be >= 0, got {self.vehicles}.")
        if self.rows < 1:
            raise ValueError(f"rows must be >= 1, got {self.rows}.")
        if self.observation not in FORMS:
            raise ValueError(
                f"observation must be one of {', '.join(FORMS)}, got {self.observation!r}."
            )
        for name in ("policy_frequency", "test_frequency"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be > 0, got {getattr(self, name)}.")
        if not 0 < self.duration < float("inf") or self.horizon < 1:
            raise ValueError(
                f"duration must be at least a decision, {1 / self.policy_frequency} seconds, "
                f"got {self.duration}."
            )
        if not 0.0 <= self.route_starts <= 1.0:
            raise ValueError(f"route_starts must be in [0, 1], got {self.route_starts}.")

        if self.scenario not in SCENARIOS:
            raise ValueError(
                f"scenario must be one of {', '.join(SCENARIOS)}, got {self.scenario!r}."
            )
        object.__setattr__(self, "costs", tuple(self.costs))
        if not set(self.costs) <= set(COSTS) or not 0 < len(set(self.costs)) == len(self.costs):
            raise ValueError(
                f"costs must be different names among {', '.join(COSTS)}, got {', '.join(self.costs) or 'none'}."
            )
        traffic = build("traffic", SCENARIOS[self.scenario], self.traffic)
        if self.vehicles is not None:
            traffic = dataclasses.replace(traffic, vehicles=(self.vehicles, self.vehicles))
        if self.rows < 2 and traffic.vehicles[1] > 0:
            raise ValueError(
                f"rows must be >= 2 with traffic, got {self.rows}: one row is always padding."
            )
        object.__setattr__(self, "traffic", traffic)
        if self.standstill is not None and self.standstill <= 0:
            raise ValueError(f"standstill must be null or > 0 seconds, got {self.standstill}.")

    def episodes(self, seed: int, count: int) -> Tensor:
        """The seeds [count] of a test's episodes; of ``mixed``, left, straight and right take turns."""
        if self.task != "mixed":
            return super().episodes(seed, count)
        drawn = super().episodes(
            seed, 8 * count + 100
        )  # in which a third of count is there of each
        task = torch.tensor(TASK_OF_ROUTE)[draw_route(self.task, drawn)]
        turns = [drawn[task == each][: -(-count // 3)] for each in range(3)]
        return torch.stack(turns, -1).flatten()[:count]

    drivers: ClassVar[Mapping[str, Callable[[int], TensorDictModuleBase]]] = DRIVERS
    demonstrators: ClassVar[Sequence[str]] = ("scripted", "blind")
    pictures: ClassVar[bool] = True
    vector: ClassVar[str] = "ego"
    action_dim: ClassVar[int] = 2

    @property
    def in_tests(self) -> Mapping[str, Any]:
        """Every start before the box, cars that stand left to themselves, the reward without r_safe, which is the
        same for every algorithm, and decisions at ``test_frequency``."""
        changes = {"route_starts": 0.0, "standstill": None, "reward": {"risk_shaping": False}}
        return changes | {"policy_frequency": self.test_frequency}

    @property
    def observed(self) -> Mapping[str, tuple[int, ...]]:
        vehicles = (self.rows, len(self.form.vehicle))
        return {"ego": (len(self.form.ego),), "vehicles": vehicles, "route": (1,)}

    @property
    def features(self) -> Mapping[str, Mapping[str, Feature]]:
        acceleration, steering = ACTION_SCALE
        return {
            "ego": self.form.ego,
            "vehicles": self.form.vehicle,
            "action": {
                "acceleration": Feature(1.0, f"{acceleration:g} m/s^2", -1.0, 1.0),
                "steering": Feature(
                    1.0, f"{steering:g} rad", -1.0, 1.0, "front wheels, to the right"
                ),
            },
        }

    def from_state(self) -> FromState:
        return FromState(self.rows, self.observation)

    @property
    def network(self) -> Mapping[str, Any]:
        return {"action_dim": self.action_dim, "rows": self.rows, **self.form.scales}

    def widened(self, count: int) -> Mapping[str, Any]:
        network = self.network
        return {**network, "ego_scale": (*network["ego_scale"], *[1.0] * count)}

    @property
    def title(self) -> str:
        low, high = self.traffic.vehicles
        return f"{self.task}, {low if low == high else f'{low} to {high}'} vehicles"

    def check_policy_of(self, trained: Scenario) -> None:
        if trained.observation != self.observation:
            raise ValueError(
                f"task.observation must be {trained.observation}, by which this policy was trained, "
                f"got {self.observation}."
            )

    def outcomes(self, last: TensorDictBase) -> Mapping[str, Tensor]:
        """A ``collision`` is with a vehicle or off the road; whoever neither collides nor arrives is ``frozen``."""
        collision = (last["collision"] | last["offroad"]).squeeze(-1).float()
        success = last["success"].squeeze(-1).float()
        return {"collision": collision, "success": success, "frozen": 1.0 - collision - success}

    def figures(self, steps: Sequence[TensorDictBase], counts: Sequence[int]) -> list[dict]:
        """``hit_vehicle`` and ``left_road`` tell collisions apart; ``speed`` (m/s) and ``min_distance`` (m, between the
        circles that cover the ego and those of another vehicle, 0 where they overlap) are over the whole episode."""
        ego = torch.stack([step["next", "ego"] for step in steps]).to("cpu", torch.float64)
        speed = torch.hypot(reading(ego, "v_x"), reading(ego, "v_y"))
        distance = reading(ego, "d_veh")
        ends = {
            key: torch.stack([step["next", key].squeeze(-1) for step in steps]).cpu()
            for key in ("collision", "offroad", "success")
        }
        routes = steps[0].get("route").flatten().tolist()
        rows = []
        for index, count in enumerate(counts):
            hit, left, success = (bool(end[count - 1, index]) for end in ends.values())
            rows.append(
                {
                    "route": ROUTES[routes[index]],
                    "collision": int(hit or left),
                    "success": int(success),
                    "frozen": int(not (hit or left or success)),
                    "hit_vehicle": int(hit),
                    "left_road": int(left),
                    "speed": math.fsum(speed[:count, index].tolist()) / count,
                    "min_distance": max(distance[:count, index].min().item(), 0.0),
                }
            )
        return rows

    def describe(self) -> dict[str, Any]:
        low, high = self.traffic.vehicles
        return {
            "task": self.task,
            "vehicles": low if low == high else [low, high],
            "rows": self.rows,
            "scenario": self.scenario,
            "traffic": dataclasses.asdict(self.traffic),
            "reading": self.reward.reading,
            "policy_frequency": self.policy_frequency,
        }

    def draw(
        self,
        policy: TensorDictModuleBase,
        env: EnvBase,
        rows: Sequence[dict],
        out: Path,
        name: str = "",
        form: str = "gif",
    ) -> Iterator[Path]:
        """``episode_N.png``, and ``episode_N.gif`` or ``episode_N.mp4``."""
        from saferl.envs.intersection.pictures import draw  # late: few want pictures

        return draw(policy, env, rows, out, name, form)

    @property
    def form(self) -> Form:
        """The features of the observation, and their scales for an encoder: ``**form.scales``."""
        return FORMS[self.observation]

    @property
    def rules_every(self) -> int:
        """Decisions of the ego between two of the traffic."""
        return max(1, round(PERIOD * self.policy_frequency))

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
