"""How a scene is drawn: routes, starts, surrounding vehicles, and what is sensed of them.

Everything is a function of an episode's seed (:func:`uniform`), with any leading batch dimensions,
so that both backends draw the same scenes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from saferl.envs.intersection.geometry import (
    ARM,
    EXIT_DISTANCE,
    LENGTH,
    ROUTES,
    ROUTES_OF_TASK,
    Constants,
    columns,
    line_pose,
    reference_lines,
)
from saferl.envs.intersection.roads import lane_frames, lanes
from saferl.envs.seeding import mix, uniform

_VEHICLES, _ENTRIES, _NOISE = 64, 1_000, 1_000_000  # streams of an episode's seed

#: Weight of each route when a surrounding vehicle is drawn, [ego's route][arm][left, straight
#: inner, straight outer, right], arms from the ego's one clockwise (ours). The more a route crosses
#: or joins the ego's, the likelier it is; every route keeps a positive weight.
_WEIGHTS = {
    "lt": [[1, 1, 1, 1], [2, 3, 3, 1], [1, 3, 3, 1], [2, 2, 2, 1]],
    "gs_inner": [[1, 1, 1, 1], [2, 2, 2, 1], [2, 1, 1, 1], [2, 2, 2, 1]],
    "gs_outer": [[1, 1, 1, 1], [2, 2, 2, 1], [2, 1, 1, 1], [2, 2, 2, 1]],
    "rt": [[1, 1, 3, 3], [1, 1, 30, 1], [1, 1, 1, 1], [1, 1, 1, 1]],
}


@dataclass(frozen=True)
class Traffic:
    """How surrounding vehicles are drawn, drive and are sensed.

    Attributes:
        vehicles: fewest and most vehicles drawn at reset.
        speeds: m/s, drawn at reset; also the speed that a vehicle wants.
        spawn_length: m along the approach on which vehicles are drawn.
        gap: m, a vehicle closer than this to another one is removed at reset (paper).
        ego_gap: m, likewise to the ego (ours).
        bias: 1 draws the routes that conflict with the ego's more often (ours); 0 draws all alike.
        headways: s, time headway, drawn for each driver; half of it, in proportion, is the time that
            a driver leaves between itself and another one where their routes cross.
        heedless: share of drivers that ignore road priority; they still brake for what is ahead.
        respawn: while there are fewer vehicles than were drawn, one a decision enters a free approach.
        noise: standard deviations of the sensed position (m) and velocity (m/s).
        dropout: chance that a vehicle is not sensed at a decision.

    >>> Traffic(heedless=1.5)
    Traceback (most recent call last):
    ...
    ValueError: traffic.heedless must be in [0, 1], got 1.5.
    """

    vehicles: tuple[int, int] = (10, 10)
    speeds: tuple[float, float] = (6.0, 10.0)
    spawn_length: float = 95.0
    gap: float = 15.0
    ego_gap: float = 20.0
    bias: float = 1.0
    headways: tuple[float, float] = (1.2, 1.2)
    heedless: float = 0.0
    respawn: bool = False
    noise: tuple[float, float] = (0.0, 0.0)
    dropout: float = 0.0

    def __post_init__(self):
        for name, low in (("vehicles", 0), ("speeds", 1.0), ("headways", 0.1)):
            pair = getattr(self, name)
            if len(pair) != 2 or not low <= pair[0] <= pair[1]:
                raise ValueError(
                    f"traffic.{name} must be [low, high] with {low} <= low <= high, got {pair}."
                )
        for name in ("bias", "heedless", "dropout"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"traffic.{name} must be in [0, 1], got {getattr(self, name)}.")
        if len(self.noise) != 2 or min(self.noise) < 0:
            raise ValueError(f"traffic.noise must be two numbers >= 0, got {self.noise}.")
        if not 0 < self.spawn_length <= ARM:
            raise ValueError(
                f"traffic.spawn_length must be in (0, {ARM}], got {self.spawn_length}."
            )
        for name in ("gap", "ego_gap"):
            if getattr(self, name) < 0:
                raise ValueError(f"traffic.{name} must be >= 0, got {getattr(self, name)}.")
        if self.vehicles[1] > self.room:
            raise ValueError(
                f"vehicles must be <= {self.room}, as many as there is room for on eight lanes of "
                f"{self.spawn_length:g} m, got {self.vehicles[1]}."
            )

    @property
    def room(self) -> int:
        """How many vehicles can be drawn at once, no two of a lane closer than ``gap`` or their length."""
        return 8 * (1 + int(self.spawn_length / max(self.gap, LENGTH)))

    @property
    def sensed_exactly(self) -> bool:
        """Whether every vehicle is sensed, and without noise."""
        return not (self.dropout or any(self.noise))


#: ``task.scenario``: the paper's traffic, and harder ones for testing how policies generalise.
SCENARIOS = {
    "nominal": Traffic(),
    "dense": Traffic(vehicles=(5, 20), respawn=True),
    "aggressive": Traffic(speeds=(5.0, 12.0), headways=(0.6, 2.0), heedless=0.2),
    "noisy": Traffic(noise=(0.3, 0.5), dropout=0.1),
}


def between(pair: tuple[float, float], seed: Tensor, stream: int) -> Tensor:
    """A number in [low, high), float64 [...]."""
    low, high = pair
    return low + (high - low) * uniform(seed, stream)


def draw_route(task: str, seed: Tensor) -> Tensor:
    """Routes [...] int64 of a task; ``mixed`` draws the task first, then its lane."""
    tasks = [ROUTES_OF_TASK[name] for name in (("lt", "gs", "rt") if task == "mixed" else (task,))]
    table = torch.tensor([[lanes[0], lanes[-1]] for lanes in tasks], device=seed.device)
    row = (uniform(seed, 0) * len(tasks)).long()
    return table[row, (uniform(seed, 1) * 2).long()]


def draw_start(route: Tensor, seed: Tensor, route_starts: float) -> Tensor:
    """Start states [..., 6] float64: 40 +- 5 m before the box at U[6, 10] m/s, or, for the share
    ``route_starts`` of the seeds, anywhere between there and the goal at U[0, 10] m/s: who has always
    driven does not know how to move off."""
    anywhere = uniform(seed, 2) < route_starts
    before = ARM - 40.0 + 10.0 * (uniform(seed, 3) - 0.5)
    lines = reference_lines(route, before)[..., 0, :, :]
    past = lines[..., 3, 5] + EXIT_DISTANCE
    first = ARM - 45.0
    s = torch.where(anywhere, first + (past - first) * uniform(seed, 3), before)
    x, y, phi = line_pose(lines, s).unbind(-1)
    slowest = torch.where(anywhere, 0.0, 6.0)
    speed = slowest + (10.0 - slowest) * uniform(seed, 4)
    zero = torch.zeros_like(x)
    return columns(x, y, speed, zero, phi, zero)


class Drawn(NamedTuple):
    """Surrounding vehicles as drawn, each [..., N].

    Attributes:
        present: whether the vehicle is there, bool.
        route: int64 in [0, 16).
        s: arc length of its centre, m. speed: m/s, also the wanted one.
        headway: s. heedless: ignores road priority, bool.
    """

    present: Tensor
    route: Tensor
    s: Tensor
    speed: Tensor
    headway: Tensor
    heedless: Tensor


_ROUTE_WEIGHTS = Constants(torch.tensor([_WEIGHTS[name] for name in ROUTES]).flatten(1))


def _draw_drivers(traffic: Traffic, ego_route: Tensor, seed: Tensor) -> Drawn:
    """Vehicles at the start of their approach for seeds [..., N]; ``ego_route`` [...]."""
    chance = uniform(seed, 0)
    (weights,) = _ROUTE_WEIGHTS.like(chance)
    total = (1 + traffic.bias * (weights[ego_route] - 1)).cumsum(-1)[..., None, :]
    route = (chance[..., None] >= total[..., :-1] / total[..., -1:]).sum(-1)
    return Drawn(
        present=torch.ones_like(seed, dtype=torch.bool),
        route=route,
        s=torch.zeros_like(seed, dtype=torch.float64),
        speed=between(traffic.speeds, seed, 2),
        headway=between(traffic.headways, seed, 3),
        heedless=uniform(seed, 4) < traffic.heedless,
    )


def _count(traffic: Traffic, seed: Tensor) -> Tensor:
    """The number of vehicles that an episode is drawn with, int64 [...]."""
    fewest, most = traffic.vehicles
    return fewest + (uniform(seed, 5) * (most - fewest + 1)).long()


def draw_traffic(traffic: Traffic, ego_route: Tensor, ego: Tensor, seed: Tensor) -> Drawn:
    """Surrounding vehicles of episodes.

    The most that there may be are drawn, some of them absent; then one closer than ``gap`` to an
    earlier one, or ``ego_gap`` to the ego, is removed.

    Args:
        traffic: settings.
        ego_route: int64 [...].
        ego: start states [..., 6].
        seed: int64 [...].

    >>> from saferl.envs.seeding import episode_seeds
    >>> seed = episode_seeds(0, 3)
    >>> route = draw_route("gs", seed)
    >>> draw_traffic(Traffic(), route, draw_start(route, seed, 0.0), seed).s.shape
    torch.Size([3, 10])
    """
    most = traffic.vehicles[1]
    index = torch.arange(most, device=seed.device)
    seeds = mix(mix(seed, _VEHICLES)[..., None] + index, 0)
    drawn = _draw_drivers(traffic, ego_route, seeds)
    s = traffic.spawn_length * uniform(seeds, 1)
    position = torch.stack(lane_frames(lanes(drawn.route, s), s)[0][:2], -1)
    far = (position - ego[..., None, :2]).norm(dim=-1) >= traffic.ego_gap
    wanted = far & (index < _count(traffic, seed)[..., None])
    apart = (position[..., :, None, :] - position[..., None, :, :]).norm(dim=-1)
    earlier = (apart < traffic.gap) & (index < index[:, None])
    present = wanted
    for _ in range(
        most
    ):  # whether one stays depends on earlier ones alone: settled in so many rounds
        present = wanted & ~(earlier & present[..., None, :]).any(-1)
    return drawn._replace(present=present, s=s)


def enter(
    traffic: Traffic,
    ego_route: Tensor,
    seed: Tensor,
    steps: Tensor,
    present: Tensor,
    route: Tensor,
    s: Tensor,
) -> Drawn:
    """With ``respawn``, lets one vehicle a decision onto the road while there are fewer than the episode
    was drawn with, if its approach is free.

    Args:
        ego_route, seed, steps: int64 [...]; steps counts the decisions of the episode.
        present, route, s: of the vehicles now, [..., N].

    Returns:
        The new drivers where ``present`` is True; meaningless elsewhere.
    """
    fresh = _draw_drivers(traffic, ego_route, mix(seed, _ENTRIES + steps)[..., None])
    same = lanes(route, s).approach == lanes(fresh.route, s).approach
    free = (torch.where(present & same, s, torch.inf) >= traffic.gap).all(-1, keepdim=True)
    fewer = present.sum(-1, keepdim=True) < _count(traffic, seed)[..., None]
    first = ~present & ((~present).cumsum(-1) == 1) & fewer
    return Drawn(first & free, *(value.expand(first.shape) for value in fresh[1:]))


def sense(
    traffic: Traffic, vehicles: Tensor, present: Tensor, slot: Tensor, seed: Tensor, steps: Tensor
) -> tuple[Tensor, Tensor]:
    """States and presence of vehicles as the ego's sensors give them.

    Args:
        vehicles: [..., N, 6].
        present: bool [..., N].
        slot: int64 [N], the number of each vehicle, which its noise follows.
        seed, steps: int64 [...].
    """
    if traffic.sensed_exactly:
        return vehicles, present
    seeds = mix(mix(seed, _NOISE + steps)[..., None] + slot, 0)
    # Box and Muller: normal numbers from uniform ones.
    radius = (
        torch.sqrt(-2 * torch.log1p(-uniform(seeds, 0))),
        torch.sqrt(-2 * torch.log1p(-uniform(seeds, 1))),
    )
    angle = 2 * math.pi * uniform(seeds, 2), 2 * math.pi * uniform(seeds, 3)
    (position, velocity), zero = traffic.noise, torch.zeros_like(radius[0])
    error = columns(
        position * radius[0] * torch.cos(angle[0]),
        position * radius[0] * torch.sin(angle[0]),
        velocity * radius[1] * torch.cos(angle[1]),
        velocity * radius[1] * torch.sin(angle[1]),
        zero,
        zero,
    )
    return vehicles + error.to(vehicles), present & (uniform(seeds, 4) >= traffic.dropout)
