"""Scenes played forward: what follows if a driver takes over now, by one of two predictions of the other cars."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from saferl.envs.intersection.batched import (
    BatchedIntersection,
    State,
    drive,
    scenes_last,
    states_of,
)
from saferl.envs.intersection.dynamics import step_ego, to_physical
from saferl.envs.intersection.geometry import (
    LENGTH,
    arrived,
    columns,
    frame,
    offroad,
    separation,
    wrap,
)
from saferl.envs.intersection.observation import as_world
from saferl.envs.intersection.roads import (
    MOVEMENTS,
    SPEED_LIMIT,
    lane_frames,
    lane_project,
    lanes,
)
from saferl.envs.intersection.scenario import STANDING, SUBSTEPS, Scenario

_STILL = 1e-3  # m, by which a gap may change between two cars that stand
_REST = 0.05  # m/s; an ego that creeps faster than this is not taken to stand
_TURNS = 0.2  # m by which a turn must fit a car better than straight on
_ALONG = 0.7  # cosine; who turns away from the ego by more does not follow it


class Prediction:
    """What the other cars are believed to do. A scene is a dict of tensors [R, ...], with ``ego`` [R, 6] and ``route`` [R]."""

    def begin(self, seen: TensorDictBase, env: Any, scenario: Scenario) -> State:
        """The scenes of now.

        Args:
            seen: what the policy sees, [R].
            env: the environment itself.
            scenario: its settings.
        """
        raise NotImplementedError

    def played(self, scenario: Scenario) -> Scenario:
        """The settings by which drivers are played forward: how often they decide."""
        return scenario

    def others(self, scene: State) -> tuple[Tensor, Tensor]:
        """The others: states [R, N, 6], and whether they are there, bool [R, N]."""
        raise NotImplementedError

    def step(self, scenario: Scenario, scene: State, control: Tensor) -> tuple[State, Tensor]:
        """The scenes one decision later, and how near the ego came to another body until then, m [R].

        Args:
            scenario: settings.
            scene: now.
            control: of the ego, [R, 2], physical units.
        """
        raise NotImplementedError

    def settled(self, scenario: Scenario, scene: State, gap: Tensor) -> Tensor:
        """Where the ego stands and nobody will hit it any more, bool [R].

        Args:
            scenario: settings.
            scene: after a decision.
            gap: to the nearest body, as :meth:`step` gives it.
        """
        raise NotImplementedError


class ConstantVelocity(Prediction):
    """Everybody observed goes straight on as fast as now, but for who drives ahead of the ego its way: he brakes to a stand from
    now on, as he may. It knows what the policy sees, and no more.

    Nobody would go on like that into a car that stands in the way or brakes ahead, so two kinds of contact are taken to be
    avoided by the other: with a car that is behind the ego and drives its way, and of an ego at rest with a car that has time
    to stop until then.

    Args:
        braking: with how much such a car is trusted to stop, m/s^2.
        ahead: with how much a car ahead is taken to brake, m/s^2; 0: it does not.
    """

    def __init__(self, braking: float = 3.0, ahead: float = 5.0):
        self.braking, self.ahead = braking, ahead

    def begin(self, seen: TensorDictBase, env: Any, scenario: Scenario) -> State:
        own, table = as_world(seen["ego"], seen["vehicles"])
        ego = own[..., 1:7]
        cos, sin = torch.cos(ego[:, 4]), torch.sin(ego[:, 4])
        v_x, v_y = ego[:, 2] * cos - ego[:, 3] * sin, ego[:, 2] * sin + ego[:, 3] * cos
        there, dx, dy, dv_x, dv_y, heading = table.unbind(-1)
        along = dx * cos[:, None] + dy * sin[:, None]
        same_way = torch.cos(heading - ego[:, None, 4]) > _ALONG
        follows, leads = (same_way & (side * along > LENGTH / 2) for side in (-1, 1))
        return {
            "ego": ego,
            "route": seen["route"].squeeze(-1),
            "there": (there > 0.5) & ~follows,
            "x": ego[:, None, 0] + dx,
            "y": ego[:, None, 1] + dy,
            "v_x": v_x[:, None] + dv_x,
            "v_y": v_y[:, None] + dv_y,
            "heading": heading,
            "slows": self.ahead * leads,
            "time": torch.zeros_like(v_x),
        }

    def others(self, scene: State) -> tuple[Tensor, Tensor]:
        speed = torch.hypot(scene["v_x"], scene["v_y"])
        zero = torch.zeros_like(speed)
        parts = scene["x"], scene["y"], speed, zero, scene["heading"], zero
        return torch.stack(parts, -1), scene["there"]

    def played(self, scenario: Scenario) -> Scenario:
        return dataclasses.replace(scenario, policy_frequency=min(scenario.policy_frequency, 5))

    def step(self, scenario: Scenario, scene: State, control: Tensor) -> tuple[State, Tensor]:
        ego, moments, dt = scene["ego"], [], scenario.dt
        for _ in range(SUBSTEPS):
            ego = step_ego(ego, control, dt)
            moments.append(ego)
        passed = dt * torch.arange(1, SUBSTEPS + 1, dtype=ego.dtype, device=ego.device)
        speed, slows = torch.hypot(scene["v_x"], scene["v_y"]), scene["slows"]
        until = torch.where(slows > 0, speed / slows, torch.inf).clamp(min=_STILL)  # s, it stands
        moves = torch.minimum(passed[:, None, None], until)  # [3, R, N]
        moves = moves * (1 - moves / (2 * until))  # s at this speed, of the same way
        way = self.moved(scene, moves)
        left = (1 - passed[-1] / until).clamp(min=0.0)
        at = torch.stack(moments)[:, :, None]
        mine = frame(*at[..., [0, 1, 4]].unbind(-1))
        theirs = frame(way["x"], way["y"], way["heading"])
        time = scene["time"] + passed[:, None]
        sees = (at[..., 2] < _REST) & (speed > STANDING)
        stops = sees & (speed <= 2 * self.braking * time[..., None])
        counts = scene["there"] & ~stops
        gaps = torch.where(counts, separation(mine, theirs), torch.inf)
        gap = _least(gaps.movedim(0, 1).flatten(1))
        after = {key: value[-1] for key, value in way.items()}
        turn = after["heading"] - scene["heading"]
        c, s = left * torch.cos(turn), left * torch.sin(turn)
        after["v_x"] = c * scene["v_x"] - s * scene["v_y"]
        after["v_y"] = s * scene["v_x"] + c * scene["v_y"]
        return scene | after | {"ego": ego, "time": time[-1]}, gap

    def moved(self, scene: State, seconds: Tensor) -> State:
        """The others after ``seconds`` [T, R, N] at their speed of now: ``x``, ``y`` (m), ``heading`` (rad), each [T, R, N]."""
        x, y = scene["x"] + scene["v_x"] * seconds, scene["y"] + scene["v_y"] * seconds
        return {"x": x, "y": y, "heading": scene["heading"].expand_as(x)}

    def settled(self, scenario: Scenario, scene: State, gap: Tensor) -> Tensor:
        speed = torch.hypot(scene["v_x"], scene["v_y"])
        fastest = -_least(torch.where(scene["there"], -speed, 0.0))
        stop = fastest <= 2 * self.braking * scene["time"]
        return (scene["ego"][:, 2] < STANDING) & stop


class AlongLanes(ConstantVelocity):
    """As :class:`ConstantVelocity`, but everybody follows the lane that he is in: who has begun to turn turns on.

    Which lane that is follows from where a car is and where it points; as long as that tells no turn, it goes straight on. Who
    fits no lane goes on as he points.

    Args:
        braking, ahead: as there.
        reach: m, by how much a car may be beside a lane that it is taken to follow; a radian beside its heading counts as 5 m.
    """

    def __init__(self, braking: float = 3.0, ahead: float = 5.0, reach: float = 1.0):
        super().__init__(braking, ahead)
        self.reach = reach

    def begin(self, seen: TensorDictBase, env: Any, scenario: Scenario) -> State:
        scene = super().begin(seen, env, scenario)
        x, y, heading = (scene[key][..., None] for key in ("x", "y", "heading"))
        every = lanes(torch.arange(4 * len(MOVEMENTS), device=x.device), x)
        s, lateral = lane_project(every, x, y)
        apart = wrap(heading - lane_frames(every, s)[1])
        miss = lateral.abs() + 5 * apart.abs() + _TURNS * (every.side != 0)
        least, lane = miss.min(-1, keepdim=True)
        kept = {"lane": lane, "s": s.gather(-1, lane), "lateral": lateral.gather(-1, lane)}
        kept["apart"], kept["keeps"] = apart.gather(-1, lane), least <= self.reach
        return scene | {key: value[..., 0] for key, value in kept.items()}

    def moved(self, scene: State, seconds: Tensor) -> State:
        straight, lateral = super().moved(scene, seconds), scene["lateral"]
        s = scene["s"] + torch.hypot(scene["v_x"], scene["v_y"]) * seconds
        place, heading = lane_frames(lanes(scene["lane"], s), s)
        along = {"x": place.x - lateral * place.sin, "y": place.y + lateral * place.cos}
        along["heading"] = heading + scene["apart"]
        keeps = scene["keeps"]
        return {k: torch.where(keeps, along[k], straight[k]) for k in along} | {"s": s}


class Simulator(Prediction):
    """The batched simulator's own future of the others: how each drives, whether it heeds priority, who is still to enter.

    No car knows that, so that this is privileged knowledge: a bound on what foresight is worth, not something to ship.

    Args:
        patience: s; who has not hit an ego that stands for so long will not.
    """

    def __init__(self, patience: float = 1.5):
        self.patience = patience

    def begin(self, seen: TensorDictBase, env: Any, scenario: Scenario) -> State:
        if not isinstance(env, BatchedIntersection):
            raise ValueError(
                "the simulator's prediction plays the batched road forward, which "
                f"{type(env).__name__} is not: take env=batched, or ConstantVelocity, which needs only what is seen."
            )
        return env.state | {"still": torch.zeros_like(env.state["still"])}

    def others(self, scene: State) -> tuple[Tensor, Tensor]:
        return states_of(scene), scene["vehicle_present"]

    def step(self, scenario: Scenario, scene: State, control: Tensor) -> tuple[State, Tensor]:
        return drive(scenario, scene, columns(*control.unbind(-1)))

    def settled(self, scenario: Scenario, scene: State, gap: Tensor) -> Tensor:
        stood = scene["still"] / scenario.policy_frequency
        return (stood > 0) & (gap >= SPEED_LIMIT * (self.patience - stood))


def pick(scene: State, index: Tensor) -> State:
    """Some of the scenes."""
    return scenes_last({key: value[index] for key, value in scene.items()})


def watched(prediction: Prediction, scene: State) -> TensorDict:
    """What a driver sees in scenes [R]: all cars, in the form ``world`` of an observation."""
    ego = scene["ego"]
    others, there = prediction.others(scene)
    x, y, v_x, v_y, phi, _ = ego.unbind(-1)
    cos, sin = torch.cos(phi), torch.sin(phi)
    own = torch.stack([torch.ones_like(x), *ego.unbind(-1), x, x], -1)
    along, heading = others[..., 2], others[..., 4]
    table = [
        there.to(x),
        others[..., 0] - x[:, None],
        others[..., 1] - y[:, None],
        along * torch.cos(heading) - (v_x * cos - v_y * sin)[:, None],
        along * torch.sin(heading) - (v_x * sin + v_y * cos)[:, None],
        heading,
    ]
    seen = {"ego": own, "vehicles": torch.stack(table, -1), "route": scene["route"][:, None]}
    return TensorDict(seen, [len(x)])  # pyright: ignore[reportArgumentType]


def _least(values: Tensor) -> Tensor:
    """The least of each row [R, K], inf where K is 0."""
    return torch.cat([values, torch.full_like(values[:, :0].sum(-1, True), torch.inf)], -1).amin(-1)


def nearest(prediction: Prediction, scene: State) -> Tensor:
    """How near the ego is to another body, m [R] (:func:`separation`); inf where there is none."""
    (others, there), ego = prediction.others(scene), scene["ego"][:, None]
    mine, theirs = (frame(*each[..., [0, 1, 4]].unbind(-1)) for each in (ego, others))
    return _least(torch.where(there, separation(mine, theirs), torch.inf))


def over(prediction: Prediction, scene: State) -> Tensor:
    """Where there is nothing more to foresee, bool [R]: the ego has arrived, left the road or hit somebody."""
    ego = scene["ego"]
    return arrived(ego, scene["route"]) | offroad(ego) | (nearest(prediction, scene) <= 0)


@torch.no_grad()
def safe_for(
    prediction: Prediction,
    scenario: Scenario,
    scene: State,
    driver: TensorDictModuleBase,
    horizon: float,
    first: Tensor | None = None,
    margin: float = 0.0,
) -> Tensor:
    """For how long nothing happens if a driver takes over.

    Args:
        prediction: of the others.
        scenario: settings.
        scene: R of them.
        driver: takes over.
        horizon: s, how far is looked.
        first: actions [R, 2] in [-1, 1], held for one decision before the driver takes over; None: it takes over at once.
        margin: m, a body that comes nearer than this, and nearer than it is now, counts as hit.

    Returns:
        Seconds [R] until the ego hits another body or leaves the road; inf where until ``horizon`` neither happens, or it
        arrives or stands safe before.

    Raises:
        ValueError: the driver's action is not finite.
    """
    ego = scene["ego"]
    until = torch.full_like(ego[:, 0], torch.inf)
    room = (nearest(prediction, scene) - _STILL).clamp(0.0, margin)
    index, going, time = torch.arange(len(ego), device=ego.device), until > 0, 0.0
    after = prediction.played(scenario)
    while len(index) and time < horizon - 1e-6:
        action, how = first, scenario
        if time or action is None:
            action, how = driver(watched(prediction, scene))["action"], after
            if not action.isfinite().all():  # every comparison below would call it safe
                raise ValueError("an action is not finite.")
        time += 1 / how.policy_frequency
        scene, gap = prediction.step(how, scene, to_physical(action))
        ego = scene["ego"]
        bad = (gap <= room) | offroad(ego)
        until[index[going & bad]] = time
        ended = bad | arrived(ego, scene["route"]) | prediction.settled(how, scene, gap)
        going = going & ~ended
        if going.sum() <= 0.7 * len(going):  # the others are not worth their time
            scene, index, room = pick(scene, going), index[going], room[going]
            going = going[going]
    return until
