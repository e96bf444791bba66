"""The intersection as one batch of tensors."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from saferl.envs.intersection.base import OUTCOMES, IntersectionBase
from saferl.envs.intersection.costs import Decision, costs_of
from saferl.envs.intersection.dynamics import step_ego, to_physical
from saferl.envs.intersection.geometry import arrived, columns, frame, offroad, separation
from saferl.envs.intersection.observation import observe
from saferl.envs.intersection.roads import Lanes, lane_frames, lanes, pairs, zones
from saferl.envs.intersection.scenario import STANDING, SUBSTEPS, Scenario
from saferl.envs.intersection.spawning import draw_route, draw_start, draw_traffic, sense
from saferl.envs.intersection.traffic import (
    Vehicles,
    accelerate,
    drive_in,
    move,
    respawn,
    vehicle_states,
)
from saferl.envs.intersection.yielding import road_rules
from saferl.modules.compiled import Compiled

State = dict[str, Tensor]
_VEHICLE, _LANE, _OWN = "vehicle_", "lane_", "own_"


def vehicles_of(state: State) -> Vehicles:
    """The surrounding vehicles in a state of the batched intersection, each [N, B]."""
    return Vehicles(*(state[_VEHICLE + name].movedim(-1, 0) for name in Vehicles._fields))


def _named(prefix: str, values: Vehicles | Lanes) -> State:
    return {prefix + name: value.movedim(0, -1) for name, value in values._asdict().items()}


def scenes_last(state: State) -> State:
    """The same tensors [B, ...], laid out so that the scenes are side by side in memory.

    The strides are always the same, also where a dimension is 1 and any would do: to a compiled
    function other strides are another input.
    """
    turned = {key: value.movedim(0, -1) for key, value in state.items()}
    return {k: v.reshape(-1).reshape(v.shape).movedim(-1, 0) for k, v in turned.items()}


def _lanes(state: State, whose: str) -> Lanes:
    return Lanes(*(state[whose + name].movedim(-1, 0) for name in Lanes._fields))


def states_of(state: State) -> Tensor:
    """States of the surrounding vehicles [B, N, 6] in a state of the batched intersection."""
    return vehicle_states(vehicles_of(state), _lanes(state, _LANE))


def _roads(vehicles: Vehicles, ego_route: Tensor) -> State:
    """What follows from the routes [N, B] and [B] alone, looked up once an episode."""
    route, like = vehicles.route, vehicles.s
    begin, end = zones(route, torch.cat([route, ego_route[None]]), like)
    return {
        **_named(_LANE, lanes(route, like)),
        **_named(_OWN, lanes(ego_route, like)),
        "zone_begin": begin.movedim(-1, 0),
        "zone_end": end.movedim(-1, 0),
        "pair": pairs(route).movedim(-1, 0),
    }


def _choose(mask: Tensor, yes: Vehicles, no: Vehicles) -> Vehicles:
    return Vehicles(*(torch.where(mask, a, b) for a, b in zip(yes, no, strict=True)))


def begin(scenario: Scenario, seed: Tensor) -> State:
    """The first states of the episodes with seeds [B] int64, each tensor [B, ...]."""
    route = draw_route(scenario.task, seed)
    ego = draw_start(route, seed, scenario.route_starts)
    vehicles = drive_in(draw_traffic(scenario.traffic, route, ego, seed), torch.float32)
    state = {
        "seed": seed, "route": route, "ego": ego.float(),
        "steps": torch.zeros_like(seed), "still": torch.zeros_like(seed),
        "control": columns(torch.zeros_like(ego[:, 0]), torch.zeros_like(ego[:, 0])).float(),
        **_named(_VEHICLE, vehicles), **_roads(vehicles, route),
    }  # fmt: skip
    return state | look(scenario, state)[0]


def restart(scenario: Scenario, state: State, seed: Tensor, reset: Tensor, rows: Tensor) -> State:
    """Begin new episodes in those of the environments ``rows`` [K] that are in ``reset`` [B].

    Args:
        state: each [B, ...].
        seed: of the new episodes [B], int64.
        rows: different indices; K may be the same at every call, however many environments reset.
    """
    fresh = begin(scenario, seed[rows])
    mask = reset[rows]

    def merge(old: Tensor, new: Tensor) -> Tensor:
        old, new = old.movedim(0, -1), new.movedim(0, -1)
        new = torch.where(mask, new, old[..., rows])
        return old.index_copy(-1, rows, new).movedim(-1, 0)

    return scenes_last({key: merge(old, fresh[key]) for key, old in state.items()})


def look(scenario: Scenario, state: State) -> tuple[State, Tensor]:
    """What is seen in a state.

    Returns:
        ``seen_ego`` [B, F] and ``seen_vehicles`` [B, M, G], the observation as it is sensed, and
        ``within_view`` [B, N], which vehicles are truly observable; and the true ``ego`` [B, F].
    """
    vehicles, others = vehicles_of(state), states_of(state)
    ego, route, how = state["ego"], state["route"], (scenario.rows, scenario.observation)
    present = state[_VEHICLE + "present"]
    own, table, within_view = observe(ego, others, present, route, *how)
    seen = own, table
    if not scenario.traffic.sensed_exactly:
        slot = torch.arange(len(vehicles.s), device=others.device)
        sensed = sense(scenario.traffic, others, present, slot, state["seed"], state["steps"])
        seen = observe(ego, *sensed, route, *how)
    view = {"seen_ego": seen[0], "seen_vehicles": seen[1], "within_view": within_view}
    return view, own


#: Who moves the surrounding vehicles [N, B]: they and the egos [B, 6] before a substep, and its number, to the vehicles
#: after it.
Movers = Callable[[Vehicles, Tensor, int], Vehicles]


def _by_rules(scenario: Scenario, state: State) -> tuple[Vehicles, Movers]:
    """The vehicles as they heed the rules of the road from this decision on, and how they then move."""
    ego, steps, vehicles = state["ego"], state["steps"], vehicles_of(state)
    lane, own_lane = _lanes(state, _LANE), _lanes(state, _OWN)
    pair = state["pair"].movedim(0, -1)
    zone = state["zone_begin"].movedim(0, -1), state["zone_end"].movedim(0, -1)
    time = steps.to(ego.dtype) / scenario.policy_frequency
    if scenario.traffic.vehicles[1] > 0:
        ruled = road_rules(vehicles, lane, own_lane, zone, ego, time)
        every = scenario.rules_every
        vehicles = ruled if every == 1 else _choose(steps % every == 0, ruled, vehicles)

    def moved(vehicles: Vehicles, ego: Tensor, substep: int) -> Vehicles:
        return move(vehicles, lane, accelerate(vehicles, lane, pair, ego), scenario.dt)

    return vehicles, moved


def drive(
    scenario: Scenario, state: State, control: Tensor, movers: Movers | None = None
) -> tuple[State, Tensor]:
    """All cars one decision on: the physics of :func:`advance`, which ends at a collision.

    Args:
        scenario: settings.
        state: as :func:`begin` gives, each [B, ...]; what is seen may be missing, and stays as it is.
        control: [B, 2], physical units.
        movers: of the other cars; None: they heed the rules of the road.

    Returns:
        The next state; and how near the ego came to another body, m [B] (:func:`separation`; <= 0: a collision, inf:
        nobody is there).
    """
    ego, route, steps, lane = state["ego"], state["route"], state["steps"], _lanes(state, _LANE)
    vehicles, moved = (vehicles_of(state), movers) if movers else _by_rules(scenario, state)
    traffic = scenario.traffic.vehicles[1] > 0
    gap = torch.full_like(ego[:, 0], torch.inf)
    for substep in range(SUBSTEPS):
        collision = gap <= 0
        if traffic:
            vehicles = _choose(collision, vehicles, moved(vehicles, ego, substep))
        ego = torch.where(collision[:, None], ego, step_ego(ego, control, scenario.dt))
        if traffic:
            place, _ = lane_frames(lane, vehicles.s)
            apart = separation(frame(ego[:, 0], ego[:, 1], ego[:, 4]), place)
            apart = torch.where(vehicles.present, apart, torch.inf).amin(0)
            gap = torch.minimum(gap, apart)
    after = state | {
        "ego": ego,
        "control": control,
        "steps": steps + 1,
        "still": torch.where(ego[:, 2] < STANDING, state["still"] + 1, 0),
    }
    if scenario.traffic.respawn:
        vehicles = respawn(scenario.traffic, vehicles, route, state["seed"], steps)
        after |= _roads(vehicles, route)
    return after | _named(_VEHICLE, vehicles), gap


def advance(
    scenario: Scenario, state: State, action: Tensor, movers: Movers | None = None
) -> tuple[State, State]:
    """One decision of every environment: a pure function, without a loop over them or vehicles.

    Args:
        scenario: settings.
        state: as :func:`begin` gives, each [B, ...].
        action: [B, 2] in [-1, 1].
        movers: see :func:`drive`.

    Returns:
        The next state; and outcomes, ``reward`` and ends, each [B], and ``cost`` [B, K].
    """
    # Laid out like the rest: the action that comes in is not.
    control = columns(*to_physical(action).unbind(-1))
    previous = torch.where(state["steps"][:, None] == 0, control, state["control"])
    predicted = scenario.cost(state["ego"], control, states_of(state), state["within_view"])
    after, gap = drive(scenario, state, control, movers)
    ego, route, collision = after["ego"], after["route"], gap <= 0
    seen, own = look(scenario, after)
    after |= seen
    off = offroad(ego)
    seconds = 1.0 / scenario.policy_frequency
    decision = Decision(scenario.cost, predicted, collision, off, ego, control, seconds)
    cost = costs_of(scenario.costs, decision)
    success = arrived(ego, route) & ~off & ~collision
    reward = scenario.reward(
        ego, route, control, previous, own[:, -2], own[:, -1], seen["within_view"].any(-1),
        off | collision, success,
    )  # fmt: skip
    terminated = off | collision | success | (after["still"] >= scenario.patience)
    truncated = after["steps"] >= scenario.horizon
    return scenes_last(after), {
        "collision": collision, "offroad": off, "success": success, "reward": reward, "cost": cost,
        "terminated": terminated, "truncated": truncated, "done": terminated | truncated,
    }  # fmt: skip


class TensorIntersection(IntersectionBase):
    """An intersection whose scenes are one state of tensors, as :func:`begin` gives."""

    _state: State

    def _observation(self) -> State:
        seen = {"ego": "seen_ego", "vehicles": "seen_vehicles", "route": "route"}
        return {key: self._state[name] for key, name in seen.items()}

    @property
    def state(self) -> State:
        """What :func:`advance` takes: the scenes of now, each [B, ...]."""
        return self._state

    def scene(self) -> tuple[Tensor, Vehicles]:
        """The true states of the egos [B, 6], and the surrounding vehicles [N, B], seen or not."""
        return self._state["ego"], vehicles_of(self._state)

    def render(self, index: int) -> np.ndarray:
        """The scene [600, 600, 3] uint8 of one environment, drawn by highway-env's graphics."""
        from saferl.envs.intersection.rendering import draw_state  # late: needs pygame

        state = {key: value[index].cpu() for key, value in self._state.items()}
        return draw_state(state["ego"], int(state["route"]), vehicles_of(state))


class BatchedIntersection(TensorIntersection):
    """The CMDP with traffic, B environments in one set of tensors, on CPU or GPU.

    Args:
        task: its settings.
        num_envs: B.
        seed: of the sequences of episodes; None: others each time.
        device: torch device.
        compile_physics: compile the step and the reset: three times faster, after minutes (or seconds,
            once torch has it in its cache on disk).

    >>> env = BatchedIntersection(Scenario(task="lt"), num_envs=3)
    >>> env.rollout(4)["next", "vehicles"].shape
    torch.Size([3, 4, 11, 12])
    """

    def __init__(
        self,
        task: Scenario,
        num_envs: int = 1,
        seed: int | None = None,
        device=None,
        compile_physics: bool = False,
    ):
        super().__init__(task, num_envs, seed, device)
        self._advance, self._restart = partial(advance, task), partial(restart, task)
        if compile_physics:
            self._advance = Compiled(self._advance, "the simulation's step", cpp=False)
            self._restart = Compiled(self._restart, "the simulation's reset", cpp=False)
        # So many environments are reset at a time that a step in which a few episodes end is not
        # charged for all of them.
        self._chunk = max(min(num_envs, 32), num_envs // 8)
        self._state: State = {}

    def _reset(
        self, tensordict: TensorDictBase | None = None, seeds: Tensor | None = None, **kwargs
    ) -> TensorDictBase:
        reset = self._reset_mask(tensordict)
        seeds = self._next_seeds(reset, seeds)
        if not self._state:
            self._state = scenes_last(begin(self.task, seeds))
        order = reset.to(torch.int8).argsort(descending=True, stable=True)
        for rows in order.split(self._chunk)[: -(-int(reset.sum()) // self._chunk)]:
            self._state = self._restart(self._state, seeds, reset, rows)
        no = torch.zeros_like(reset)
        return self._output(self._observation() | dict.fromkeys(OUTCOMES, no))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"].to(self._state["ego"])
        self._state, output = self._advance(self._state, action)
        return self._output(self._observation() | output)

    def state_dict(self, *args, **kwargs) -> dict[str, Tensor]:
        """Everything that decides what comes next: vehicle states and episode sequences."""
        return {"stream": self._stream, "episode": self._episode, **self._state}

    def load_state_dict(self, state_dict: dict[str, Tensor], *args, **kwargs) -> None:
        """Continue exactly where :meth:`state_dict` was taken."""
        state = {key: value.to(self.device or "cpu").clone() for key, value in state_dict.items()}
        self._stream, self._episode = state.pop("stream"), state.pop("episode")
        self._state = scenes_last(state)
