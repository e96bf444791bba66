"""The intersection's road network and the routes of surrounding vehicles on it.

Nodes are named as in highway-env: ``o`` outer, ``ir`` end of an approach, ``il`` start of an exit,
then the arm (0 south, 1 west, 2 north, 3 east). On every road lane 0 is the inner and lane 1 the
outer one. Everything here is numpy, because highway-env's objects are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from highway_env.road.lane import CircularLane, LineType, StraightLane
from highway_env.road.road import LaneIndex, RoadNetwork

from saferl.envs.intersection.geometry import ARM, HALF_BOX, LANE_WIDTH, LENGTH, WIDTH

SPEED_LIMIT = 10.0  # m/s
#: Speed in the box by movement, m/s: 3.8 m/s^2 sideways on the left arc, 4 m/s^2 on the right one.
TURN_SPEED = {"left": 8.0, "straight": SPEED_LIMIT, "right": 6.0}
CORRIDOR = WIDTH / 2 + 0.3  # m to either side of the route that must be free of bodies
#: Points of a vehicle's outline that are looked for in a corridor, m ahead and to the right.
BODY = np.array([(x, y) for x in (-0.5, 0.0, 0.5) for y in (-0.5, 0.5)]) * (LENGTH, WIDTH)
BODY_STEP = 0.25  # m
MOVEMENTS = (("left", 0), ("straight", 0), ("straight", 1), ("right", 1))
_LEFT_RADIUS = HALF_BOX + LANE_WIDTH / 2
_RIGHT_RADIUS = HALF_BOX - 1.5 * LANE_WIDTH


def build_network() -> RoadNetwork:
    """Four arms of two lanes each way, unsignalised, with highway-env's road priorities.

    The horizontal road has the right of way: priority 3 for its straight lanes and right turns, 2
    for its left turns, 1 for vertical straight lanes and right turns, 0 for vertical left turns.

    >>> sorted(build_network().graph["ir0"])  # from the south: to the west, the north, the east
    ['il1', 'il2', 'il3']
    """
    network = RoadNetwork()
    none, line, striped = LineType.NONE, LineType.CONTINUOUS, LineType.STRIPED
    blank: Any = (none, none)
    curb: Any = (none, line)
    end = HALF_BOX + ARM
    for arm in range(4):
        angle = np.pi / 2 * arm
        priority = 3 if arm % 2 else 1
        cos, sin = round(np.cos(angle)), round(np.sin(angle))
        rotation = np.array([[cos, -sin], [sin, cos]])
        node, left, ahead, right = (f"{arm}", *(f"il{(arm + k) % 4}" for k in (1, 2, 3)))

        def straight(start, stop, lines: Any, level=priority, rotation=rotation):
            return StraightLane(
                rotation @ np.array(start), rotation @ np.array(stop), line_types=lines,
                priority=level, speed_limit=SPEED_LIMIT,
            )  # fmt: skip

        for lane, x in enumerate((LANE_WIDTH / 2, 3 * LANE_WIDTH / 2)):
            edge = (line, striped) if lane == 0 else curb
            network.add_lane("o" + node, "ir" + node, straight((x, end), (x, HALF_BOX), edge))
            network.add_lane("ir" + node, ahead, straight((x, HALF_BOX), (x, -HALF_BOX), blank))
            # The exit of the arm itself, on the other side of its middle line.
            network.add_lane("il" + node, "o" + node, straight((-x, HALF_BOX), (-x, end), edge))
        network.add_lane(
            "ir" + node,
            left,
            CircularLane(
                rotation @ np.array([-HALF_BOX, HALF_BOX]), _LEFT_RADIUS, angle, angle - np.pi / 2,
                clockwise=False, line_types=blank, priority=priority - 1,
                speed_limit=TURN_SPEED["left"],
            ),
        )  # fmt: skip
        network.add_lane(
            "ir" + node,
            right,
            CircularLane(
                rotation @ np.array([HALF_BOX, HALF_BOX]), _RIGHT_RADIUS, angle + np.pi,
                angle + 1.5 * np.pi, line_types=curb, priority=priority,
                speed_limit=TURN_SPEED["right"],
            ),
        )  # fmt: skip
    return network


@dataclass(frozen=True)
class Routes:
    """The 16 routes: every arm times (left, straight inner, straight outer, right).

    Route ``4 * arm + k`` runs along its approach lane (arc length 0 to 100 m), a connector of
    constant curvature through the box, and an exit lane of 100 m.

    Attributes:
        lanes: the three lane indexes of each route in the network.
        start, middle, leave: [16, 2] start of the approach, entry of the box, exit of the box, m.
        heading, turned: [16] heading on the approach and on the exit, rad.
        curvature: [16] of the connector, 1/m.
        out: [16] arc length at which the box ends, m.
        priority: [16] road priority of the connector.
        turn_speed: [16] speed limit of the connector, m/s.
        approach: [16] number of the approach lane, 2 * arm + lane.
        zone: [16, 16, 2] arc lengths on route i between which a vehicle on route j can be hit in
            the box; empty (inf, -inf) where two routes never meet or share their approach lane.
        body: [4, 16, S, 2] for a vehicle on route j at arc length ``BODY_STEP * k``: where its body
            first reaches into the corridor of route i of arm 0, as an arc length on i minus its own
            (m; inf where it does not), and the cosine of the angle between the two directions there.
            Other arms are the same, turned.
    """

    lanes: list[tuple[LaneIndex, LaneIndex, LaneIndex]]
    start: np.ndarray
    middle: np.ndarray
    leave: np.ndarray
    heading: np.ndarray
    turned: np.ndarray
    curvature: np.ndarray
    out: np.ndarray
    priority: np.ndarray
    turn_speed: np.ndarray
    approach: np.ndarray
    zone: np.ndarray
    body: np.ndarray

    def pose(self, route: np.ndarray | int, s: np.ndarray | float) -> np.ndarray:
        """Pose [..., 3] (x, y, heading) at arc lengths ``s`` [...] m of ``route`` [...]."""
        before = np.minimum(s, ARM)
        half = np.clip(s - ARM, 0.0, self.out[route] - ARM) / 2
        after = np.maximum(s - self.out[route], 0.0)
        bend = self.curvature[route] * half
        heading = self.heading[route]
        chord = 2 * half * np.sinc(bend / np.pi)
        middle, final = heading + bend, heading + 2 * bend
        pose = np.empty((*np.broadcast_shapes(np.shape(s), np.shape(route)), 3))
        pose[..., 0] = (
            self.start[route, 0]
            + before * np.cos(heading)
            + chord * np.cos(middle)
            + after * np.cos(final)
        )
        pose[..., 1] = (
            self.start[route, 1]
            + before * np.sin(heading)
            + chord * np.sin(middle)
            + after * np.sin(final)
        )
        pose[..., 2] = np.remainder(final + np.pi, 2 * np.pi) - np.pi
        return pose

    def bend(self, route: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Curvature [...] of the routes at arc lengths ``s`` [...], 1/m."""
        return np.where((s > ARM) & (s < self.out[route]), self.curvature[route], 0.0)

    def project(self, route: np.ndarray | int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Arc length and lateral offset [..., P] (m, positive to the right) of points [..., P, 2].

        ``route`` [...] is broadcast against the points' leading dimensions.
        """
        route = np.asarray(route)[..., None]
        x, y = points[..., 0], points[..., 1]
        cos, sin = np.cos(self.heading)[route], np.sin(self.heading)[route]
        dx, dy = x - self.middle[route, 0], y - self.middle[route, 1]
        along, lateral = dx * cos + dy * sin, dy * cos - dx * sin
        s = ARM + along
        k = self.curvature[route]
        arc = self.out[route] - ARM
        straight = k == 0
        radius = 1 / np.where(straight, 1.0, np.abs(k))
        side = np.sign(k)
        inward = radius - side * lateral
        bent = np.arctan2(along, inward) * radius
        off = side * (radius - np.hypot(along, inward))
        cos, sin = np.cos(self.turned)[route], np.sin(self.turned)[route]
        dx, dy = x - self.leave[route, 0], y - self.leave[route, 1]
        beyond, right = dx * cos + dy * sin, dy * cos - dx * sin
        inside = ~straight & (along > 0) & (bent > 0) & (bent < arc) & (beyond < 0)
        past = ~straight & (beyond >= 0)
        s = np.where(past, self.out[route] + beyond, np.where(inside, ARM + bent, s))
        return s, np.where(past, right, np.where(inside, off, lateral))


def rectangles_overlap(
    a: np.ndarray, b: np.ndarray, length: float = LENGTH, width: float = WIDTH
) -> np.ndarray:
    """Whether equal rectangles at poses ``a``, ``b`` [..., 3] overlap: separating axes, bool [...].

    >>> bool(rectangles_overlap(np.array([0, 0, 0.6]), np.array([3.5, 1.5, 0.6])))
    True
    """
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    turn = b[..., 2] - a[..., 2]
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    reach = (length * (1 + cos) + width * sin) / 2
    spread = (width * (1 + cos) + length * sin) / 2
    hit = np.ones(dx.shape, dtype=bool)
    for heading in (a[..., 2], b[..., 2]):
        c, s = np.cos(heading), np.sin(heading)
        hit &= (np.abs(dx * c + dy * s) <= reach) & (np.abs(dy * c - dx * s) <= spread)
    return hit


def _zones(routes: Routes, margin: float = 0.4, step: float = 0.5) -> np.ndarray:
    """Where each route can be hit by a vehicle on another one, [16, 16, 2] arc lengths."""
    zone = np.empty((16, 16, 2))
    zone[..., 0], zone[..., 1] = np.inf, -np.inf
    s = np.arange(ARM - LENGTH, routes.out.max() + LENGTH + step, step)
    pose = routes.pose(np.arange(16)[:, None], s)  # [16, S, 3]
    valid = s <= routes.out[:, None] + LENGTH
    for i in range(4):  # the other arms by symmetry
        for j in range(16):
            if routes.approach[i] == routes.approach[j]:
                continue
            hit = rectangles_overlap(
                pose[i, :, None], pose[j, None], LENGTH + 2 * margin, WIDTH + 2 * margin
            )
            hit = s[(hit & valid[j]).any(1) & valid[i]]
            if len(hit):
                for arm in range(4):
                    zone[i + 4 * arm, (j + 4 * arm) % 16] = hit[0], hit[-1]
    return zone


def _bodies(routes: Routes) -> np.ndarray:
    """What a vehicle on each route puts into the corridor of each of arm 0, [4, 16, S, 2]."""
    s = np.arange(0.0, routes.out.max() + ARM, BODY_STEP)
    pose = routes.pose(np.arange(16)[:, None], s)  # [16, S, 3]
    cos, sin = np.cos(pose[..., 2, None]), np.sin(pose[..., 2, None])
    points = np.stack(
        [pose[..., 0, None] + cos * BODY[:, 0] - sin * BODY[:, 1],
         pose[..., 1, None] + sin * BODY[:, 0] + cos * BODY[:, 1]], -1,
    )  # fmt: skip
    body = np.empty((4, 16, len(s), 2))
    for i in range(4):
        where, lateral = routes.project(np.full((16, len(s)), i), points)
        first = np.where(np.abs(lateral) < CORRIDOR, where, np.inf).min(-1)
        heading = routes.pose(i, np.where(np.isfinite(first), first, 0.0))[..., 2]
        body[i] = np.stack([first - s, np.cos(pose[..., 2] - heading)], -1)
    return body


@lru_cache(maxsize=1)
def routes() -> Routes:
    """The routes of :func:`build_network`, read off its lanes.

    >>> table = routes()
    >>> table.pose(0, 100.0)[:2].round()  # left turn from the south, at the entry of the box
    array([ 2., 15.])
    """
    network = build_network()
    lanes = [
        (
            (f"o{arm}", f"ir{arm}", lane),
            (f"ir{arm}", f"il{(arm + turn) % 4}", lane if turn == 2 else 0),
            (f"il{(arm + turn) % 4}", f"o{(arm + turn) % 4}", lane),
        )
        for arm in range(4)
        for turn, (_, lane) in zip((1, 2, 2, 3), MOVEMENTS, strict=True)
    ]
    first, box, last = ([network.get_lane(indexes[k]) for indexes in lanes] for k in range(3))
    table = {
        "start": np.array([lane.position(0, 0) for lane in first]),
        "middle": np.array([lane.position(0, 0) for lane in box]),
        "leave": np.array([lane.position(0, 0) for lane in last]),
        "heading": np.array([lane.heading_at(0) for lane in first]),
        "turned": np.array([lane.heading_at(0) for lane in last]),
        "curvature": np.array(
            [b.direction / b.radius if isinstance(b, CircularLane) else 0.0 for b in box]
        ),
        "out": np.array([ARM + lane.length for lane in box]),
        "priority": np.array([getattr(lane, "priority") for lane in box]),  # noqa: B009
        "turn_speed": np.array([TURN_SPEED[movement] for movement, _ in MOVEMENTS] * 4),
        "approach": np.array([2 * (k // 4) + MOVEMENTS[k % 4][1] for k in range(16)]),
    }
    bare = Routes(lanes=lanes, zone=np.empty(0), body=np.empty(0), **table)
    return replace(bare, zone=_zones(bare), body=_bodies(bare))
