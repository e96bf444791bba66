"""The routes of surrounding vehicles as tensors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from saferl.envs.intersection.geometry import ARM, Constants, Frame
from saferl.envs.intersection.network import BODY_STEP, routes


class Lanes(NamedTuple):
    """What vehicles [...] need to know of their routes, each [...]; see :class:`network.Routes`.

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


def _build() -> Constants:
    """Lanes [16, 15], zones [16, 16, 2] and bodies [4, 16, S, 2] of the routes."""
    r = routes()
    radius = 1 / np.where(r.curvature == 0, 1.0, np.abs(r.curvature))
    columns = [
        *r.start.T, np.cos(r.heading), np.sin(r.heading), r.heading, np.sign(r.curvature), radius, r.out,
        *r.leave.T, np.cos(r.turned), np.sin(r.turned), r.priority, r.turn_speed, r.approach,
    ]  # fmt: skip
    arrays = (np.stack(columns, -1), r.zone, r.body)
    return Constants(*(torch.from_numpy(a) for a in arrays))


_ROADS = _build()


def lanes(route: Tensor, like: Tensor) -> Lanes:
    """Lanes of ``route`` [...] int64 in [0, 16), in ``like``'s dtype and on its device."""
    return Lanes(*_ROADS.like(like)[0].movedim(1, 0)[:, route])


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
