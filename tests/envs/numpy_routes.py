"""The routes of surrounding vehicles a second time: in NumPy, and read off highway-env's lanes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from highway_env.road.lane import CircularLane
from highway_env.road.road import LaneIndex

from saferl.envs.intersection.geometry import ARM, LENGTH, WIDTH
from saferl.envs.intersection.network import LANE_INDEXES, build_network
from saferl.envs.intersection.roads import BODY, BODY_STEP, CORRIDOR, MOVEMENTS, TURN_SPEED

OUTLINE = np.array(BODY)


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
    """Whether equal rectangles at poses ``a``, ``b`` [..., 3] overlap: separating axes, bool [...]."""
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
        [pose[..., 0, None] + cos * OUTLINE[:, 0] - sin * OUTLINE[:, 1],
         pose[..., 1, None] + sin * OUTLINE[:, 0] + cos * OUTLINE[:, 1]], -1,
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
    """The routes of :func:`build_network`, read off its lanes."""
    network, lanes = build_network(), LANE_INDEXES
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
