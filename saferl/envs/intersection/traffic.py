"""Surrounding traffic as one batch of tensors: IDM and motion along routes, coming and going.

Both backends drive their traffic by these functions. The N vehicles of any number of scenes come first,
[N, ...]: the scenes lie side by side in memory, where vector units find them. Any body in a vehicle's
corridor ahead is a leader, whatever lane it is on. Who yields to whom is in
:mod:`~saferl.envs.intersection.yielding`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from saferl.envs.intersection.geometry import ARM, LENGTH, frame
from saferl.envs.intersection.roads import BODY, CORRIDOR, Lanes, bodies, lane_frames, lane_project
from saferl.envs.intersection.spawning import Drawn, Traffic, enter

BODY_GAP = 3.0  # m kept from a body across the corridor
ACCELERATION, BRAKING = 3.0, 5.0  # m/s^2, comfortable (IDM)
ACC_MAX = 6.0  # m/s^2
GAP = 3.0  # m, bumper to bumper at rest (IDM)


class Vehicles(NamedTuple):
    """Surrounding vehicles, each [N, ...] unless said otherwise.

    Attributes:
        present: bool. route: int64 in [0, 16).
        s, speed, desired: arc length of the centre (m), speed and wanted speed (m/s).
        headway: s. heedless: ignores road priority, bool.
        entered: [T, ...] time at which a vehicle entered the box, s, or inf.
        held: waits at the entry line, bool. stop: arc length where it must stop, m, or inf.
    """

    present: Tensor
    route: Tensor
    s: Tensor
    speed: Tensor
    desired: Tensor
    headway: Tensor
    heedless: Tensor
    entered: Tensor
    held: Tensor
    stop: Tensor


def vehicle_states(vehicles: Vehicles, lane: Lanes) -> Tensor:
    """States [..., N, 6]: x, y, v_x, 0, phi, omega."""
    place, heading = lane_frames(lane, vehicles.s)
    bends = (vehicles.s > ARM) & (vehicles.s < lane.out)
    omega = torch.where(bends, vehicles.speed * lane.side / lane.radius, 0.0)
    states = (place.x, place.y, vehicles.speed, torch.zeros_like(omega), heading, omega)
    return torch.stack(states).movedim((0, 1), (-1, -2))


def drive_in(drawn: Drawn, dtype: torch.dtype) -> Vehicles:
    """Vehicles [N, ...] that have just been drawn, [..., N]; their numbers in ``dtype``."""
    present, route, s, speed, headway, heedless = (v.movedim(-1, 0) for v in drawn)
    s, speed, headway = s.to(dtype), speed.to(dtype), headway.to(dtype)
    never = torch.full_like(s, torch.inf)
    return Vehicles(
        present, route, s, speed, speed, headway, heedless,
        entered=torch.full((len(s) + 1, *s.shape[1:]), torch.inf, dtype=dtype, device=s.device),
        held=torch.zeros_like(present), stop=never,
    )  # fmt: skip


def respawn(
    traffic: Traffic, vehicles: Vehicles, ego_route: Tensor, seed: Tensor, steps: Tensor
) -> Vehicles:
    """The vehicles [N, ...] with who enters the road after this decision, see :func:`enter`.

    Args:
        traffic: settings.
        vehicles: each [N, ...].
        ego_route, seed, steps: int64 [...]; steps counts the decisions of the episode.
    """
    present, route, s = (v.movedim(0, -1) for v in (vehicles.present, vehicles.route, vehicles.s))
    new = drive_in(enter(traffic, ego_route, seed, steps, present, route, s), vehicles.s.dtype)
    joins = new.present
    never = torch.zeros_like(joins[:1])  # the ego
    merged = (
        torch.where(torch.cat([joins, never]) if name == "entered" else joins, ours, old)
        for name, ours, old in zip(Vehicles._fields, new, vehicles, strict=True)
    )
    return Vehicles(*merged)


def accelerate(vehicles: Vehicles, lane: Lanes, pair: Tensor, ego: Tensor) -> Tensor:
    """Accelerations [N, ...], m/s^2: IDM behind whatever is in the corridor, braking before stops.

    Args:
        vehicles: each [N, ...].
        lane: their lanes.
        pair: of their routes, see :func:`pairs`.
        ego: state [..., 6].
    """
    s, v = vehicles.s, vehicles.speed
    # Slow down in time for the box, keep its speed limit, and speed up after it.
    limit = torch.sqrt(lane.turn_speed.square() + 2 * 2.0 * (ARM - s).clamp_min(0.0))
    limit = torch.where(s > lane.out, torch.inf, limit)
    share = (v / torch.minimum(vehicles.desired, limit)).square()
    free = ACCELERATION * (1 - share.square())

    where, aligned = bodies(pair, s)
    other = ~torch.eye(len(s), dtype=torch.bool, device=s.device).reshape(
        *where.shape[:2], *[1] * (s.ndim - 1)
    )
    where = torch.where(vehicles.present[None] & other, where, torch.inf)
    ego_where, ego_aligned = _ego_ahead(s, lane, ego)
    a = torch.minimum(
        _follow(vehicles, free, where, v[None] * aligned, aligned).amin(1),
        _follow(
            vehicles,
            free,
            ego_where[:, None],
            (torch.hypot(ego[..., 2], ego[..., 3]) * ego_aligned)[:, None],
            ego_aligned[:, None],
        ).squeeze(1),
    )
    a = torch.minimum(free, a)
    room = vehicles.stop - s
    need = v.square() / (2 * room.clamp_min(0.1))
    a = torch.where((need > 2.0) | (room < 1.0), torch.minimum(a, -need.clamp_min(0.5)), a)
    return a.clamp(-ACC_MAX, ACC_MAX)


def _follow(
    vehicles: Vehicles, free: Tensor, where: Tensor, pace: Tensor, aligned: Tensor
) -> Tensor:
    """Acceleration [N, M, ...] that each of M bodies allows; inf where it is none of i's business.

    Args:
        free: acceleration without them [N, ...].
        where: arc length on i's route at which a body begins, m or inf.
        pace: its speed along the route, m/s.
        aligned: cosine of the angle between the two.
    """
    s, v = vehicles.s[:, None], vehicles.speed[:, None]
    gap = torch.where(where > s + 1.0, where - s - LENGTH / 2, torch.inf).clamp_min(0.1)
    wanted = (
        GAP + v * vehicles.headway[:, None] + v * (v - pace) / (2 * (ACCELERATION * BRAKING) ** 0.5)
    )
    follow = free[:, None] - ACCELERATION * (wanted.clamp_min(0.5) / gap).square()
    # A body across the corridor is no leader to follow; brake for it once that is needed.
    need = v.square() / (2 * (gap - BODY_GAP).clamp_min(0.1))
    across = torch.where((need > 3.0) | (gap < BODY_GAP + 0.5), -need.clamp_min(1.0), torch.inf)
    return torch.where(aligned > 0.5, follow, across)


def _ego_ahead(s: Tensor, lane: Lanes, ego: Tensor) -> tuple[Tensor, Tensor]:
    """Arc length on the routes [N, ...] at which the ego's body begins (m; inf where it is not in the
    corridor ahead), and the cosine of its angle to the route there."""
    centre = frame(ego[..., 0], ego[..., 1], ego[..., 4])
    body = torch.tensor(BODY, dtype=ego.dtype, device=ego.device).reshape(
        -1, 2, 1, *[1] * (s.ndim - 1)
    )
    x = centre.x + centre.cos * body[:, 0] - centre.sin * body[:, 1]
    y = centre.y + centre.sin * body[:, 0] + centre.cos * body[:, 1]
    at, lateral = lane_project(lane, x, y)  # [6, N, ...]
    ahead = (lateral.abs() < CORRIDOR) & (at > s + 1.0)
    at = torch.where(ahead, at, torch.inf).amin(0)
    near, _ = lane_frames(lane, torch.where(torch.isfinite(at), at, s))
    return at, centre.cos * near.cos + centre.sin * near.sin


def move(vehicles: Vehicles, lane: Lanes, acceleration: Tensor, dt: float) -> Vehicles:
    """Vehicles after ``dt`` seconds; who passes the end of an exit arm is gone."""
    speed = (vehicles.speed + acceleration * dt).clamp_min(0.0)
    s = vehicles.s + (vehicles.speed + speed) / 2 * dt
    present = vehicles.present & (s + LENGTH / 2 <= lane.out + ARM)
    return vehicles._replace(s=s, speed=speed, present=present)
