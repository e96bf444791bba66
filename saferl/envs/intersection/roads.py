"""The routes of surrounding vehicles as tensors.

There are 16: every arm (0 south, 1 west, 2 north, 3 east) times (left, straight inner, straight outer,
right). Route ``4 * arm + k`` runs along its approach lane (arc length 0 to 100 m), a connector of
constant curvature through the box, and an exit lane of 100 m. Lane 0 is the inner, lane 1 the outer one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from saferl.envs.intersection.geometry import (
    ARM,
    HALF_BOX,
    LANE_WIDTH,
    LENGTH,
    WIDTH,
    Constants,
    Frame,
    separation,
)

SPEED_LIMIT = 10.0  # m/s
#: Speed in the box by movement, m/s: 3.8 m/s^2 sideways on the left arc, 4 m/s^2 on the right one.
TURN_SPEED = {"left": 8.0, "straight": SPEED_LIMIT, "right": 6.0}
MOVEMENTS = (("left", 0), ("straight", 0), ("straight", 1), ("right", 1))
LEFT_RADIUS = HALF_BOX + LANE_WIDTH / 2
RIGHT_RADIUS = HALF_BOX - 1.5 * LANE_WIDTH
PRIORITIES = (1, 3, 1, 3)  # of each arm, as in highway-env; a left turn has one less
CORRIDOR = WIDTH / 2 + 0.3  # m to either side of the route that must be free of bodies
#: Points of a vehicle's outline that are looked for in a corridor, m ahead and to the right.
BODY = tuple((x * LENGTH, y * WIDTH) for x in (-0.5, 0.0, 0.5) for y in (-0.5, 0.5))
BODY_STEP = 0.25  # m
_ZONE_MARGIN, _ZONE_STEP = 0.4, 0.5  # m
#: The heading of each arm's approach, rad, and its direction.
_HEADINGS = (-math.pi / 2, 0.0, math.pi / 2, math.pi)
_DIRECTIONS = ((0.0, -1.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0))
_TURNS = {"left": (-1, LEFT_RADIUS), "straight": (0, 1.0), "right": (1, RIGHT_RADIUS)}


class Lanes(NamedTuple):
    """What vehicles [...] need to know of their routes, each [...].

    Attributes:
        x, y, cos, sin, heading: start of the approach (m), its direction and heading (rad).
        side, radius: of the arc through the box: -1 bends left, 1 right, 0 not; m, 1 if straight.
        out: arc length at which the box ends, m.
        out_x, out_y, out_cos, out_sin: the end of the box and the direction there.
        priority, turn_speed, approach: right of way, speed limit in the box (m/s), approach lane.
    """

    x: Tensor
    y: Tensor
    cos: Tensor
    sin: Tensor
    heading: Tensor
    side: Tensor
    radius: Tensor
    out: Tensor
    out_x: Tensor
    out_y: Tensor
    out_cos: Tensor
    out_sin: Tensor
    priority: Tensor
    turn_speed: Tensor
    approach: Tensor

    def at(self, index) -> Lanes:
        """The lanes of some of the vehicles, or with more dimensions, as by indexing a tensor."""
        return Lanes(*(field[index] for field in tuple(self)))


def lane_frames(lane: Lanes, s: Tensor) -> tuple[Frame, Tensor]:
    """Frames [...] and headings [...] (rad, not folded) at arc lengths s [...].

    Before its start a route goes on straight. Sine and cosine are taken once, of half the angle
    turned; the rest is algebra.

    >>> lane = lanes(torch.tensor(0), torch.zeros(1))  # left turn from the south
    >>> [round(value.item(), 3) for value in lane_frames(lane, torch.tensor(100.0))[0]]
    [2.0, 15.0, 0.0, -1.0]
    """
    before = s.clamp_max(ARM)
    half = torch.minimum((s - ARM).clamp_min(0.0), lane.out - ARM) / 2
    after = (s - lane.out).clamp_min(0.0)
    bend = lane.side * half / lane.radius
    c, sn = torch.cos(bend), torch.sin(bend)
    chord = 2 * torch.where(lane.side == 0, half, lane.side * lane.radius * sn)
    # Directions at the middle of the arc and at its end.
    mid_cos, mid_sin = lane.cos * c - lane.sin * sn, lane.sin * c + lane.cos * sn
    end_cos, end_sin = mid_cos * c - mid_sin * sn, mid_sin * c + mid_cos * sn
    x = lane.x + before * lane.cos + chord * mid_cos + after * end_cos
    y = lane.y + before * lane.sin + chord * mid_sin + after * end_sin
    return Frame(x, y, end_cos, end_sin), lane.heading + 2 * bend


def lane_project(lane: Lanes, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Arc length and lateral offset (m, positive to the right) of points (x, y) [...] on lanes [...]."""
    dx, dy = x - (lane.x + ARM * lane.cos), y - (lane.y + ARM * lane.sin)
    along, lateral = dx * lane.cos + dy * lane.sin, dy * lane.cos - dx * lane.sin
    inward = lane.radius - lane.side * lateral
    arc = torch.atan2(along, inward) * lane.radius
    off = lane.side * (lane.radius - torch.hypot(along, inward))
    dx, dy = x - lane.out_x, y - lane.out_y
    beyond, right = dx * lane.out_cos + dy * lane.out_sin, dy * lane.out_cos - dx * lane.out_sin
    bends = (lane.side != 0) & (along > 0) & (arc < lane.out - ARM)
    past = beyond >= 0
    s = torch.where(past, lane.out + beyond, ARM + torch.where(bends, arc, along))
    return s, torch.where(past, right, torch.where(bends, off, lateral))


def _row(arm: int, movement: str, lane: int) -> list[float]:
    """The lane of one route, in the order of :class:`Lanes`."""
    side, radius = _TURNS[movement]
    out, offset = (arm + side) % 4, LANE_WIDTH * (lane + 0.5)
    (x, y), (out_x, out_y) = _DIRECTIONS[arm], _DIRECTIONS[out]
    far = HALF_BOX + ARM
    heading, turned = _HEADINGS[arm], _HEADINGS[out]
    return [
        -far * x - offset * y, -far * y + offset * x, math.cos(heading), math.sin(heading), heading,
        side, radius, ARM + (radius * math.pi / 2 if side else 2 * HALF_BOX),
        HALF_BOX * out_x - offset * out_y, HALF_BOX * out_y + offset * out_x,
        math.cos(turned), math.sin(turned),
        PRIORITIES[arm] - (movement == "left"), TURN_SPEED[movement], 2 * arm + lane,
    ]  # fmt: skip


def _zones(lane: Lanes) -> Tensor:
    """Arc lengths on each route i between which a vehicle on route j can be hit in the box [16, 16, 2];
    (inf, -inf) where the two never meet or share their approach lane. ``lane`` [16, 1]."""
    s = torch.arange(ARM - LENGTH, float(lane.out.max()) + LENGTH + _ZONE_STEP, _ZONE_STEP).double()
    place, _ = lane_frames(lane, s)
    size = LENGTH + 2 * _ZONE_MARGIN, WIDTH + 2 * _ZONE_MARGIN
    valid, zone = s <= lane.out + LENGTH, torch.empty(16, 16, 2, dtype=s.dtype)
    for i in range(4):  # the other arms by symmetry
        mine = place.at((i, slice(None), None))
        hit = separation(mine, place.at((slice(None), None)), size, size) <= 0  # [16, S, S]
        hit = (hit & valid[:, None]).any(-1) & valid[i] & (lane.approach != lane.approach[i])
        begin = torch.where(hit, s, torch.inf).amin(-1)
        end = torch.where(hit, s, -torch.inf).amax(-1)
        for arm in range(4):
            zone[i + 4 * arm] = torch.stack([begin, end], -1).roll(4 * arm, 0)
    return zone


def _bodies(lane: Lanes) -> Tensor:
    """What a vehicle on each route puts into the corridor of each of arm 0, [4, 16, S, 2], at arc lengths
    ``BODY_STEP * k``: where its body first reaches into it, as an arc length on that route minus its own
    (m; inf where it does not), and the cosine of the angle between the two there. ``lane`` [16, 1]."""
    s = torch.arange(0.0, float(lane.out.max()) + ARM, BODY_STEP).double()
    there, _ = lane_frames(lane, s)  # [16, S]
    ahead, right = torch.tensor(BODY, dtype=s.dtype)[..., None, None].unbind(1)  # [6, 1, 1]
    x = there.x + there.cos * ahead - there.sin * right
    y = there.y + there.sin * ahead + there.cos * right
    body = []
    for i in range(4):
        mine = lane.at((i, None))
        at, lateral = lane_project(mine, x, y)
        first = torch.where(lateral.abs() < CORRIDOR, at, torch.inf).amin(0)
        near, _ = lane_frames(mine, torch.where(torch.isfinite(first), first, 0.0))
        aligned = there.cos * near.cos + there.sin * near.sin
        body.append(torch.stack([first - s, aligned], -1))
    return torch.stack(body)


def _build() -> Constants:
    """Lanes [16, 15], zones [16, 16, 2] and bodies [4, 16, S, 2] of the routes."""
    rows = [_row(arm, *movement) for arm in range(4) for movement in MOVEMENTS]
    table = torch.tensor(rows, dtype=torch.float64)
    lane = Lanes(*table[:, None].unbind(-1))
    return Constants(table, _zones(lane), _bodies(lane))


_ROADS = _build()


def lanes(route: Tensor, like: Tensor) -> Lanes:
    """Lanes of ``route`` [...] int64 in [0, 16), in ``like``'s dtype and on its device."""
    return Lanes(*_ROADS.like(like)[0].movedim(1, 0)[:, route])


def pairs(route: Tensor) -> Tensor:
    """Where :func:`bodies` finds pairs of vehicles with ``route`` [N, ...]: int64 [N, N, ...]."""
    mine = route[:, None]
    other = (route[None] - mine // 4 * 4) % 16  # seen from i's arm
    return (mine % 4 * 16 + other) * _ROADS.tensors[2].shape[2]


def bodies(pair: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
    """What vehicles put into each other's corridors: [N, N, ...] from their pairs and s [N, ...].

    Returns:
        Arc length on i's route at which vehicle j's body begins (m, inf where it is not in the
        corridor), and the cosine of the angle between j's direction and the route's there.
    """
    table = _ROADS.like(s)[2]
    place = pair + (s / BODY_STEP).round().long().clamp(0, table.shape[2] - 1)
    offset, aligned = table.flatten(0, 2).movedim(1, 0)
    return offset[place] + s, aligned[place]


def zones(route: Tensor, other: Tensor, like: Tensor) -> tuple[Tensor, Tensor]:
    """Begin and end, m on i's route, of where i can be hit by j: [N, M, ...] from [N, ...], [M, ...]."""
    table = _ROADS.like(like)[1]
    return table[..., 0][route[:, None], other[None]], table[..., 1][route[:, None], other[None]]
