"""The rules of the road a second time: in NumPy, for one scene, written apart from the tensors."""

from __future__ import annotations

import numpy as np
from numpy_routes import OUTLINE, rectangles_overlap, routes
from torch import Tensor

from saferl.envs.intersection.geometry import ARM, LENGTH, WIDTH
from saferl.envs.intersection.roads import BODY_STEP, CORRIDOR
from saferl.envs.intersection.spawning import Drawn
from saferl.envs.intersection.traffic import ACC_MAX, ACCELERATION, BODY_GAP, BRAKING, GAP
from saferl.envs.intersection.yielding import (
    COMMIT,
    EGO_ROOM,
    GO_SPEED,
    PERIOD,
    STOP,
    STRETCH,
    TIME_MARGIN,
    TIMES,
)

DELTA = 4.0  # exponent (IDM, as in highway-env)
_ARRAYS = (
    "number", "route", "s", "speed", "desired", "headway", "heedless", "acceleration", "held", "stop",
)  # fmt: skip


class NumpyRoad:
    """Surrounding vehicles [N] and the ego, last among all [N + 1]; who leaves the road is removed.

    Args:
        drawn: the vehicles; those that are present.
        ego: state [6], which a test may change.
        ego_route: in [0, 4).
    """

    number: np.ndarray
    route: np.ndarray
    s: np.ndarray
    speed: np.ndarray
    desired: np.ndarray
    headway: np.ndarray
    heedless: np.ndarray
    acceleration: np.ndarray
    held: np.ndarray
    stop: np.ndarray

    def __init__(self, drawn: Drawn, ego: Tensor, ego_route: int):
        self.table, self.ego, self.ego_route = routes(), ego, ego_route
        there = drawn.present.numpy()
        self.number, count = there.nonzero()[0], int(there.sum())
        self.route, self.s, self.speed, self.headway, self.heedless = (
            value.numpy()[there] for value in drawn[1:]
        )
        self.desired, self.acceleration = self.speed, np.zeros(count)
        self.held, self.stop = np.zeros(count, bool), np.full(count, np.inf)
        self.entered = np.full(count + 1, np.inf)  # s, the ego last
        self.time, self.next_pass = 0.0, 0.0

    @property
    def pose(self) -> np.ndarray:
        """[N, 3]"""
        return self.table.pose(self.route, self.s)

    def states(self) -> np.ndarray:
        """States [N, 6] of the surrounding vehicles: x, y, v_x, 0, phi, omega."""
        out, pose = np.zeros((len(self.s), 6)), self.pose
        out[:, :2], out[:, 4] = pose[:, :2], pose[:, 2]
        out[:, 2] = self.speed
        out[:, 5] = self.speed * self.table.bend(self.route, self.s)
        return out

    def ego_pose(self) -> tuple[np.ndarray, float, float]:
        """Position [2], heading (rad) and speed (m/s)."""
        x, y, v_x, v_y, phi, _ = self.ego.tolist()
        return np.array([x, y]), phi, float(np.hypot(v_x, v_y))

    def _everyone(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Routes, arc lengths (m) and speeds along them (m/s), each [N + 1] with the ego last."""
        position, heading, speed = self.ego_pose()
        s, _ = self.table.project(self.ego_route, position[None])
        turned = heading - self.table.pose(self.ego_route, s)[0, 2]
        return (
            np.append(self.route, self.ego_route),
            np.append(self.s, s),
            np.append(self.speed, max(speed * np.cos(turned), 0.0)),
        )

    def _predict(self, route: np.ndarray, s: np.ndarray, pace: np.ndarray) -> np.ndarray:
        """Poses [N + 1, T, 3] along the routes at constant speed, every vehicle once.

        The ego keeps its distance and angle to its route.
        """
        path = self.table.pose(route[:, None], s[:, None] + pace[:, None] * np.array(TIMES))
        x, y, heading = self.table.pose(route[-1], s[-1])
        (own_x, own_y), own_heading, _ = self.ego_pose()
        lateral = (own_y - y) * np.cos(heading) - (own_x - x) * np.sin(heading)
        path[-1, :, 0] -= lateral * np.sin(path[-1, :, 2])
        path[-1, :, 1] += lateral * np.cos(path[-1, :, 2])
        path[-1, :, 2] += own_heading - heading
        return path

    def _entries(self, s: np.ndarray, speed: np.ndarray, present: np.ndarray) -> np.ndarray:
        """Times [N + 1] at which vehicles entered, s; inf for those that have not or have left."""
        to_line = ARM - LENGTH / 2 - s
        unable = ~np.append(self.held, False) & (speed**2 > 2 * COMMIT * (to_line - 0.5))
        inside = present & ((to_line < 0) | unable)
        self.entered = np.where(inside, np.minimum(self.entered, self.time), np.inf)
        return self.entered

    def enforce_road_rules(self) -> None:
        """Decide which vehicles wait at the line or brake in the box; writes ``held``, ``stop``."""
        table, count = self.table, len(self.s)
        route, s, speed = self._everyone()
        total = len(s)
        present = s < table.out[route] + LENGTH / 2  # not yet out of the box
        entered = self._entries(s, speed, present)
        inside = np.isfinite(entered)

        arrival = np.maximum(ARM - LENGTH / 2 - s, 0.0) / np.maximum(speed, 1.0)
        right_of_way = table.priority[route] * 100.0 - arrival
        rank = np.where(inside, 1000.0 - np.where(inside, entered, 0.0), right_of_way)
        # Places in the order of rank, ties by distance and number.
        order = np.lexsort((-np.arange(total), s, rank))
        rank = np.empty(total)
        rank[order] = np.arange(total)

        # The first vehicle on each approach lane that has not entered.
        waiting = present & ~inside
        same = table.approach[route][:, None] == table.approach[route]
        head = waiting & ~(same & waiting & (s > s[:, None])).any(1)

        pace = np.maximum(speed, GO_SPEED)
        pace[count:] = speed[count:]
        path = self._predict(route, s, pace)
        hit = rectangles_overlap(path[:, None], path, STRETCH * LENGTH, WIDTH)
        meet = np.any(hit, axis=-1) & ~same
        clash = self._clashes(pace[:count])

        blocked = np.any(clash & inside[:count], axis=1)
        meet[:count, :count] |= clash
        free = np.zeros(total, bool)
        free[count:] = present[count:]
        self.held = np.zeros(count, bool)
        for i in np.argsort(-rank):
            if i < count and head[i]:
                waits = blocked[i] or (meet[i] & free & (rank > rank[i])).any()
                self.held[i] = waits and not self.heedless[i]
                free[i] = not self.held[i]
        stop = self._stops_in_box(route, s, rank, inside, clash, meet)
        self.stop = np.where(self.held, STOP, stop)

    def _clashes(self, pace: np.ndarray) -> np.ndarray:
        """[N, N]: would vehicle i, at ``pace`` [N] m/s, meet j in the zone of their routes?"""
        route, s = self.route, self.s
        mine = self.table.zone[route[:, None], route]
        other = mine.transpose(1, 0, 2)
        crossing = np.isfinite(mine[..., 0]) & (s[:, None] < mine[..., 1]) & (s < other[..., 1])
        with np.errstate(invalid="ignore"):
            begin = (mine[..., 0] - s[:, None]) / pace[:, None]
            end = (mine[..., 1] - s[:, None]) / pace[:, None]
            other_pace = np.maximum(self.speed, 0.5)
            other_begin = np.maximum(other[..., 0] - s, 0.0) / other_pace
            other_end = (other[..., 1] - s) / other_pace
        margin = TIME_MARGIN * self.headway[:, None]
        return crossing & (begin < other_end + margin) & (other_begin < end + margin)

    def _stops_in_box(self, route, s, rank, inside, clash, meet) -> np.ndarray:
        """[N] arc length before which a vehicle that has entered must stop for an earlier one."""
        count = len(clash)
        begin = self.table.zone[route[:count, None], route][..., 0]  # [N, total]
        within = s[:count, None] >= begin
        wait = np.zeros(begin.shape, bool)
        wait[:, :count] = clash & within[:, :count].T
        later = rank > rank[:count, None]
        wait[:, :count] |= clash & later[:, :count]
        # The ego keeps to no zone: wait for it only where it is predicted to be.
        wait[:, count:] = meet[:count, count:] & later[:, count:]
        wait &= ~within & inside & inside[:count, None]
        begin[:, count:] -= EGO_ROOM
        return np.where(wait, begin - 0.5, np.inf).min(1, initial=np.inf)

    def act(self) -> None:
        """Accelerations of all surrounding vehicles: IDM behind leaders, braking before stops.

        Applies the road rules first if a pass is due.
        """
        if self.time >= self.next_pass - 1e-9:
            self.enforce_road_rules()
            self.next_pass += PERIOD
        table, s, v, route = self.table, self.s, self.speed, self.route
        # Slow down in time for the box, keep its speed limit, and speed up after it.
        limit = np.sqrt(table.turn_speed[route] ** 2 + 2 * 2.0 * np.maximum(ARM - s, 0.0))
        limit = np.where(s > table.out[route], np.inf, limit)
        wanted = np.minimum(self.desired, limit)
        a = ACCELERATION * (1 - (v / wanted) ** DELTA)

        gap, pace, along = self._leaders()
        gap = np.maximum(gap, 0.1)
        spacing = (
            GAP
            + v[:, None] * self.headway[:, None]
            + v[:, None] * (v[:, None] - pace) / (2 * np.sqrt(ACCELERATION * BRAKING))
        )
        follow = a[:, None] - ACCELERATION * (np.maximum(spacing, 0.5) / gap) ** 2
        # A body across the corridor is no leader to follow; brake for it once that is needed.
        need = v[:, None] ** 2 / (2 * np.maximum(gap - BODY_GAP, 0.1))
        cross = np.where((need > 3.0) | (gap < BODY_GAP + 0.5), -np.maximum(need, 1.0), np.inf)
        a = np.minimum(a, np.where(along, follow, cross).min(1, initial=np.inf))

        room = self.stop - s
        need = v**2 / (2 * np.maximum(room, 0.1))
        brake = (need > 2.0) | (room < 1.0)
        a = np.where(brake, np.minimum(a, -np.maximum(need, 0.5)), a)
        self.acceleration = np.clip(a, -ACC_MAX, ACC_MAX)

    def _leaders(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For N vehicles and M bodies: gap [N, M] m (inf if not ahead), the body's speed along the
        route [N, M], and whether it drives along it."""
        body = self.table.body
        index = np.clip(np.rint(self.s / BODY_STEP).astype(int), 0, body.shape[2] - 1)
        mine = self.route[:, None]
        other = (self.route - mine // 4 * 4) % 16  # seen from the arm of each
        offset, aligned = np.moveaxis(body[mine % 4, other, index], -1, 0)
        where, speed = offset + self.s, self.speed
        np.fill_diagonal(where, np.inf)
        first, turn = self._ego_ahead()
        where = np.concatenate([where, first[:, None]], 1)
        aligned = np.concatenate([aligned, turn[:, None]], 1)
        speed = np.append(speed, self.ego_pose()[2])
        gap = np.where(where > self.s[:, None] + 1.0, where - self.s[:, None] - LENGTH / 2, np.inf)
        return gap, speed * aligned, aligned > 0.5

    def _ego_ahead(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the ego's body begins in the corridor ahead of each vehicle [N] (arc length, m, or
        inf), and the cosine of its angle to the route there [N]."""
        position, heading, _ = self.ego_pose()
        cos, sin = np.cos(heading), np.sin(heading)
        points = position + OUTLINE @ np.array([[cos, sin], [-sin, cos]])
        at, lateral = self.table.project(
            self.route, np.broadcast_to(points, (len(self.s), *points.shape))
        )
        ahead = (np.abs(lateral) < CORRIDOR) & (at > self.s[:, None] + 1.0)
        first = np.where(ahead, at, np.inf).min(1)
        near = np.where(np.isfinite(first), first, self.s)
        return first, np.cos(heading - self.table.pose(self.route, near)[..., 2])

    def step(self, dt: float) -> None:
        """Move every vehicle by ``dt`` seconds; who passes the end of an exit arm is removed."""
        speed = np.maximum(self.speed + self.acceleration * dt, 0.0)
        self.s = self.s + (self.speed + speed) / 2 * dt
        self.speed = speed
        self.time += dt
        keep = self.s + LENGTH / 2 <= self.table.out[self.route] + ARM
        for name in _ARRAYS:
            setattr(self, name, getattr(self, name)[keep])
        self.entered = np.append(self.entered[:-1][keep], self.entered[-1])
