"""Who yields to whom: the rules of the road, for one batch of surrounding vehicles.

At each pass, every 0.2 s:

1. A vehicle has *entered* once its front is past the entry line or it can no longer stop before it.
   Entered vehicles never yield to vehicles that have not, so the box clears.
2. Of the vehicles that have not entered only the first on each lane decides. It waits at the line
   while an entered vehicle on a crossing route would meet it in the zone that both sweep, and while
   it would hit a vehicle of higher rank that does not wait itself: because their rectangles meet
   within 2 s (paper), or because both are due in their zone at the same time.
3. Rank: entered vehicles in order of entry, then road priority, then time to the line. It is a total
   order, so no two vehicles ever wait for each other.
4. Two entered vehicles bound for the same zone: the later one brakes before it, unless it is already
   there and the other is not.
5. The ego counts as a vehicle of its rank, predicted along its route at constant speed.

Vehicles come first, [N, ...], as in :mod:`~saferl.envs.intersection.traffic`; pairs are [N, T, ...], and
T = N + 1 counts the ego too, last.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from saferl.envs.intersection.geometry import ARM, LENGTH, WIDTH, Frame, separation
from saferl.envs.intersection.roads import Lanes, lane_frames, lane_project
from saferl.envs.intersection.traffic import Vehicles

PERIOD = 0.2  # s between two decisions of the traffic, at any policy frequency
TIMES = tuple(0.25 * k for k in range(1, 9))  # s, of the prediction: 2 s (paper)
STRETCH = 1.5  # predicted rectangles are 1.5 times as long, as in highway-env
GO_SPEED = 4.0  # m/s, least speed at which a vehicle predicts its own crossing
COMMIT = 5.0  # m/s^2; a vehicle that could not stop with it before the box has entered
STOP = ARM - LENGTH / 2 - 1.0  # m, where a yielding vehicle's centre stops
TIME_MARGIN = 0.5 / 1.2  # s a second of headway, kept from others in the zone where routes cross
EGO_ROOM = 2.0  # m more for the ego, which keeps to no line
_LANES = 8  # approach lanes: so many vehicles at most are the first on theirs


def _and(values: Tensor, ego: Tensor) -> Tensor:
    """Values of the vehicles [N, ...] and of the ego [...]: [T, ...]."""
    return torch.cat([values, ego[None]])


class _Order(NamedTuple):
    """Everybody in the order of the rules, each [T, ...] but for the ego's ``pace`` along its route [...], m/s.

    Attributes:
        s: arc length, m. there: on the road. present: not yet out of the box. inside: has entered and is not out.
        entered: when, s, or inf. rank: who is higher goes first.
    """

    s: Tensor
    pace: Tensor
    there: Tensor
    present: Tensor
    inside: Tensor
    entered: Tensor
    rank: Tensor


def _ranked(vehicles: Vehicles, lane: Lanes, own: Lanes, ego: Tensor, time: Tensor) -> _Order:
    ego_s, _ = lane_project(own, ego[..., 0], ego[..., 1])
    turned = ego[..., 4] - lane_frames(own, ego_s)[1]
    ego_pace = (torch.hypot(ego[..., 2], ego[..., 3]) * torch.cos(turned)).clamp_min(0.0)

    all_s, all_speed = _and(vehicles.s, ego_s), _and(vehicles.speed, ego_pace)
    yes = torch.ones_like(ego_s, dtype=torch.bool)
    there = _and(vehicles.present, yes)
    to_line = ARM - LENGTH / 2 - all_s
    unable = ~_and(vehicles.held, ~yes) & (all_speed.square() > 2 * COMMIT * (to_line - 0.5))
    present = there & (all_s < _and(lane.out, own.out) + LENGTH / 2)
    inside = present & ((to_line < 0) | unable)
    entered = torch.where(inside, torch.minimum(vehicles.entered, time), torch.inf)

    # Rank: order of entry, then road priority, then time to the line; ties by distance and number.
    arrival = to_line.clamp_min(0.0) / all_speed.clamp_min(1.0)
    right_of_way = _and(lane.priority, own.priority) * 100.0 - arrival
    rank = torch.where(inside, 1000.0 - entered.clamp_max(600.0), right_of_way)
    return _Order(all_s, ego_pace, there, present, inside, entered, rank)


def has_priority(vehicles: Vehicles, lane: Lanes, own: Lanes, ego: Tensor, time: Tensor) -> Tensor:
    """Which vehicles [N, ...], bool, rank above the ego by the rules of the road; arguments as of :func:`road_rules`."""
    order = _ranked(vehicles, lane, own, ego, time)
    s, rank = order.s, order.rank
    tie = (rank[:-1] == rank[-1:]) & (s[:-1] >= s[-1:])
    return vehicles.present & ((rank[:-1] > rank[-1:]) | tie)


def road_rules(
    vehicles: Vehicles,
    lane: Lanes,
    own: Lanes,
    zone: tuple[Tensor, Tensor],
    ego: Tensor,
    time: Tensor,
) -> Vehicles:
    """Decide who waits at the line or brakes in the box; gives new ``entered``, ``held``, ``stop``.

    Args:
        vehicles: each [N, ...].
        lane, own: their lanes and the ego's.
        zone: begin and end of where each can be hit by the others and the ego, [N, T, ...].
        ego: state [..., 6].
        time: since the start of the episode [...], s.
    """
    s, speed, count = vehicles.s, vehicles.speed, len(vehicles.s)
    order = _ranked(vehicles, lane, own, ego, time)
    all_s, ego_pace, there, present, inside, entered, rank = order
    ego_s = all_s[-1]
    number = torch.arange(count + 1, device=s.device).reshape(-1, *[1] * ego_s.ndim)
    mine, their = (slice(0, count), None), (None,)  # i and j of pairs [N, T, ...]
    farther = all_s[their] > all_s[mine]
    tie = farther | ((all_s[their] == all_s[mine]) & (number[their] < number[mine]))
    above = _number((rank[their] > rank[mine]) | ((rank[their] == rank[mine]) & tie))

    approach = _and(lane.approach, own.approach)
    same = approach[their] == approach[mine]
    waiting = present & ~inside
    first = waiting[:count] & (_number(same & waiting[their] & farther).amax(1) == 0)

    pace = speed.clamp_min(GO_SPEED)
    gap = _gap(lane, s, pace, own, ego_s, ego_pace, ego)
    meet = _number((gap <= 0) & ~same & there[their])
    clash = _clash(vehicles, pace, zone[0][:, :count], zone[1][:, :count])

    entrants = _number(inside)
    blocked = (clash * entrants[None, :count]).amax(1)
    gives_way = torch.cat([torch.maximum(meet[:, :count], clash), meet[:, count:]], 1) * above
    held = _held(first, vehicles.heedless, blocked, gives_way, present[count:])

    # Two that have entered and are bound for the same zone: the later one brakes before it.
    begin = zone[0]
    within = _number(s[:, None] >= begin)
    wait = clash * torch.maximum(within[:, :count].transpose(0, 1), above[:, :count])
    wait = torch.cat([wait, (meet * above)[:, count:]], 1)
    wait = wait * (1 - within) * entrants[mine] * entrants[their]
    room = torch.cat([begin[:, :count], begin[:, count:] - EGO_ROOM], 1)
    stop = torch.where(wait > 0, room - 0.5, torch.inf).amin(1)
    return vehicles._replace(entered=entered, held=held, stop=torch.where(held, STOP, stop))


def _number(truth: Tensor) -> Tensor:
    """1.0 and 0.0 for true and false: among many pairs, vector units are quicker with numbers."""
    return torch.where(truth, 1.0, 0.0)


def _held(
    first: Tensor, heedless: Tensor, blocked: Tensor, gives_way: Tensor, ego_free: Tensor
) -> Tensor:
    """Who waits: a vehicle yields to those above it that do not wait themselves, bool [N, ...].

    ``gives_way`` [N, T, ...] (1.0 or 0.0, as ``blocked`` [N, ...]) follows a total order, so as many rounds as there are approach lanes
    settle it, from any start.
    """
    yields = first & ~heedless
    blocked = torch.maximum(blocked, (gives_way[:, -1:] * _number(ego_free)).amax(1))
    gives_way, yes = gives_way[:, :-1], _number(first)
    held = yields & (blocked > 0)
    for _ in range(_LANES):
        free = torch.where(held, 0.0, yes)
        held = yields & (torch.maximum(blocked, (gives_way * free[None]).amax(1)) > 0)
    return held


def _gap(
    lane: Lanes, s: Tensor, pace: Tensor, own: Lanes, ego_s: Tensor, ego_pace: Tensor, ego: Tensor
) -> Tensor:
    """[N, T, ...]: the smallest separation of i and j within 2 s, m, both along their routes at constant
    speed; the ego keeps its distance and angle to its route."""
    times = torch.tensor(TIMES, dtype=s.dtype, device=s.device).reshape(-1, *[1] * s.ndim)
    # [times, N, ...], stacked so that a compiler keeps them and does not redo them for every pair.
    path = Frame(*torch.stack(lane_frames(lane, s + pace * times)[0]))
    size = (STRETCH * LENGTH, WIDTH)
    # Every pair once, then its number at both of its places; no vehicle meets itself.
    count = len(s)
    i, j = torch.triu_indices(count, count, 1, device=s.device)
    gap = separation(path.at((slice(None), i)), path.at((slice(None), j)), size, size).amin(0)
    number = torch.arange(count, device=s.device)
    low, high = torch.minimum(number[:, None], number), torch.maximum(number[:, None], number)
    place = torch.where(low == high, len(i), low * (2 * count - low - 1) // 2 + high - low - 1)
    gap = torch.cat([gap, torch.full_like(s[:1], torch.inf)])[place]

    here, heading = lane_frames(own, ego_s)
    lateral = (ego[..., 1] - here.y) * here.cos - (ego[..., 0] - here.x) * here.sin
    turned = ego[..., 4] - heading
    c, sn = torch.cos(turned), torch.sin(turned)
    x, y, cos, sin = lane_frames(own, ego_s + ego_pace * times[:, 0])[0]
    beside = Frame(x - lateral * sin, y + lateral * cos, cos * c - sin * sn, sin * c + cos * sn)
    ego_gap = separation(path, beside.at((slice(None), None)), size, size)
    return torch.cat([gap, ego_gap.amin(0)[:, None]], 1)


def _clash(vehicles: Vehicles, pace: Tensor, begin: Tensor, end: Tensor) -> Tensor:
    """[N, N, ...], 1.0 or 0.0: would vehicle i, at ``pace`` [N, ...] m/s, meet j in the zone of their routes, which
    lies at arc lengths ``begin`` to ``end`` [N, N, ...] of i's route?"""
    s, their_s = vehicles.s[:, None], vehicles.s[None]
    pace, slow = pace[:, None], vehicles.speed.clamp_min(0.5)[None]
    margin = TIME_MARGIN * vehicles.headway[:, None]
    their_begin, their_end = begin.transpose(0, 1), end.transpose(0, 1)
    return _number(
        torch.isfinite(begin)
        & (s < end)
        & (their_s < their_end)
        & vehicles.present[None]
        & ((begin - s) / pace < (their_end - their_s) / slow + margin)
        & ((their_begin - their_s).clamp_min(0.0) / slow < (end - s) / pace + margin)
    )
