"""The regulated road: improved IDM traffic that yields, clears the box and never locks up.

highway-env's road predicts the ego again for every pair of vehicles, tests rectangles with a
rotation of the wrong sign, and stops yielding vehicles wherever they are. Here every vehicle is
predicted once, all pairs are tested at once by the separating axis theorem, and a yielding vehicle
stops before the box.
"""

from __future__ import annotations

import numpy as np
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import RoadNetwork

from saferl.envs.intersection.geometry import ARM, LENGTH, WIDTH
from saferl.envs.intersection.network import (
    BODY,
    BODY_STEP,
    CORRIDOR,
    build_network,
    rectangles_overlap,
    routes,
)
from saferl.envs.intersection.spawning import Drawn
from saferl.envs.intersection.traffic import (
    ACC_MAX,
    ACCELERATION,
    BODY_GAP,
    BRAKING,
    COMMIT,
    DELTA,
    EGO_ROOM,
    GAP,
    GO_SPEED,
    PERIOD,
    STOP,
    STRETCH,
    TIME_MARGIN,
    TIMES,
)
from saferl.envs.intersection.vehicles import EgoVehicle, RouteVehicle

_ARRAYS = {
    "slot": int, "route": int, "s": float, "speed": float, "desired": float, "headway": float,
    "heedless": bool, "acceleration": float, "held": bool, "stop": float,
}  # fmt: skip


class IntersectionRoad(RegulatedRoad):
    """highway-env's regulated road with the ego and surrounding vehicles on routes.

    The rules, each pass (every 0.2 s):

    1. A vehicle has *entered* once its front is past the entry line or it can no longer stop before
       it. Entered vehicles never yield to vehicles that have not, so the box clears.
    2. Of the vehicles that have not entered only the first on each lane decides. It waits at the
       line while an entered vehicle on a crossing route would meet it in the zone that both sweep,
       and while it would hit a vehicle of higher rank that does not wait itself: because their
       rectangles meet within 2 s (paper), or because both are due in their zone at the same time.
    3. Rank: entered vehicles in order of entry, then road priority, then time to the line. It is a
       total order, so no two vehicles ever wait for each other.
    4. Two entered vehicles bound for the same zone: the later one brakes before it, unless it is
       already there and the other is not.
    5. The ego counts as a vehicle of its rank, predicted along its route at constant speed; any
       body in a vehicle's corridor ahead is a leader, whatever lane it is on.

    Attributes:
        ego: the ego vehicle, or None.
        traffic: the surrounding vehicles.
        slot: their numbers when drawn [N].
        route, s, speed, desired: their routes [N], arc lengths [N] m, speeds and wanted speeds
            [N] m/s.
        headway, heedless: time headways [N] s, and who ignores road priority [N].
        held: [N] bool, waits at the entry line; stop: [N] arc length where it must stop, or inf.
    """

    slot: np.ndarray
    route: np.ndarray
    s: np.ndarray
    speed: np.ndarray
    desired: np.ndarray
    headway: np.ndarray
    heedless: np.ndarray
    acceleration: np.ndarray
    held: np.ndarray
    stop: np.ndarray

    def __init__(self, network: RoadNetwork | None = None):
        super().__init__(network or build_network(), [], [])
        self.table = routes()
        self.populate(None)

    def populate(self, ego: EgoVehicle | None, drawn: Drawn | None = None) -> None:
        """Put the ego and the vehicles that are present in ``drawn`` on the road; start its clock."""
        self.ego, self.traffic = ego, []
        for name, kind in _ARRAYS.items():
            setattr(self, name, np.zeros(0, kind))
        self.pose = np.zeros((0, 3))
        self.entered = np.full(1, np.inf)  # s, the ego last
        self.time, self.next_pass = 0.0, 0.0
        if drawn is not None:
            self.add(drawn)
        self.vehicles = ([ego] if ego is not None else []) + self.traffic

    def add(self, drawn: Drawn) -> None:
        """Put more vehicles on the road, those that are present in ``drawn`` [N]."""
        there = drawn.present.numpy()
        slot, count = there.nonzero()[0], int(there.sum())
        route, s, speed, headway, heedless = (value.numpy()[there] for value in drawn[1:])
        zero = np.zeros(count)
        new = {
            "slot": slot, "route": route, "s": s, "speed": speed, "desired": speed,
            "headway": headway, "heedless": heedless, "acceleration": zero, "held": zero,
            "stop": zero + np.inf, "pose": self.table.pose(route, s),
        }  # fmt: skip
        for name, value in new.items():
            old = getattr(self, name)
            setattr(self, name, np.concatenate([old, value.astype(old.dtype)]))
        self.entered = np.insert(self.entered, -1, [np.inf] * count)
        self.traffic += [
            RouteVehicle(self, r, at, v, t, self.table)
            for r, at, v, t in zip(route, s, speed, headway, strict=True)
        ]
        self.vehicles = ([self.ego] if self.ego is not None else []) + self.traffic

    def states(self) -> np.ndarray:
        """States [N, 6] of the surrounding vehicles: x, y, v_x, 0, phi, omega."""
        out = np.zeros((len(self.s), 6))
        out[:, :2], out[:, 4] = self.pose[:, :2], self.pose[:, 2]
        out[:, 2] = self.speed
        out[:, 5] = self.speed * self.table.bend(self.route, self.s)
        return out

    def _everyone(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Routes, arc lengths (m) and speeds along them (m/s), each [N], or [N + 1] with the ego
        last."""
        if self.ego is None:
            return self.route, self.s, self.speed
        ego = self.ego
        s, _ = self.table.project(ego.route_id, ego.position[None])
        turned = ego.heading - self.table.pose(ego.route_id, s)[0, 2]
        pace = max(ego.speed * np.cos(turned), 0.0)
        return (
            np.append(self.route, ego.route_id),
            np.append(self.s, s),
            np.append(self.speed, pace),
        )

    def _predict(self, route: np.ndarray, s: np.ndarray, pace: np.ndarray) -> np.ndarray:
        """Poses [total, T, 3] along the routes at constant speed, every vehicle once.

        The ego keeps its distance and angle to its route.
        """
        path = self.table.pose(route[:, None], s[:, None] + pace[:, None] * np.array(TIMES))
        if self.ego is not None:
            x, y, heading = self.table.pose(route[-1], s[-1])
            lateral = (self.ego.position[1] - y) * np.cos(heading) - (
                self.ego.position[0] - x
            ) * np.sin(heading)
            path[-1, :, 0] -= lateral * np.sin(path[-1, :, 2])
            path[-1, :, 1] += lateral * np.cos(path[-1, :, 2])
            path[-1, :, 2] += self.ego.heading - heading
        return path

    def _entries(self, s: np.ndarray, speed: np.ndarray, present: np.ndarray) -> np.ndarray:
        """Times [total] at which vehicles entered, s; inf for those that have not or have left."""
        total = len(s)
        to_line = ARM - LENGTH / 2 - s
        held = np.append(self.held, False)[:total]
        unable = ~held & (speed**2 > 2 * COMMIT * (to_line - 0.5))
        inside = present & ((to_line < 0) | unable)
        self.entered[:total] = np.where(inside, np.minimum(self.entered[:total], self.time), np.inf)
        return self.entered[:total]

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
        for vehicle, yields in zip(self.traffic, self.held, strict=True):
            vehicle.is_yielding = bool(yields)

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
        count = len(self.s)
        if not count:
            return
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
        if self.ego is not None:
            first, turn = self._ego_ahead(self.ego)
            where = np.concatenate([where, first[:, None]], 1)
            aligned = np.concatenate([aligned, turn[:, None]], 1)
            speed = np.append(speed, self.ego.speed)
        gap = np.where(where > self.s[:, None] + 1.0, where - self.s[:, None] - LENGTH / 2, np.inf)
        return gap, speed * aligned, aligned > 0.5

    def _ego_ahead(self, ego: EgoVehicle) -> tuple[np.ndarray, np.ndarray]:
        """Where the ego's body begins in the corridor ahead of each vehicle [N] (arc length, m, or
        inf), and the cosine of its angle to the route there [N]."""
        cos, sin = np.cos(ego.heading), np.sin(ego.heading)
        points = ego.position + BODY @ np.array([[cos, sin], [-sin, cos]])
        at, lateral = self.table.project(
            self.route, np.broadcast_to(points, (len(self.s), *points.shape))
        )
        ahead = (np.abs(lateral) < CORRIDOR) & (at > self.s[:, None] + 1.0)
        first = np.where(ahead, at, np.inf).min(1)
        near = np.where(np.isfinite(first), first, self.s)
        return first, np.cos(ego.heading - self.table.pose(self.route, near)[..., 2])

    def step(self, dt: float) -> None:
        """Move every vehicle by ``dt`` seconds; who passes the end of an exit arm is removed."""
        if self.ego is not None:
            self.ego.step(dt)
        speed = np.maximum(self.speed + self.acceleration * dt, 0.0)
        self.s = self.s + (self.speed + speed) / 2 * dt
        self.speed = speed
        self.time += dt
        self.pose = self.table.pose(self.route, self.s)
        for k, vehicle in enumerate(self.traffic):
            vehicle.follow(self.s[k], self.speed[k], self.acceleration[k], self.pose[k])
        gone = self.s + LENGTH / 2 > self.table.out[self.route] + ARM
        if gone.any():
            self._remove(gone)

    def _remove(self, gone: np.ndarray) -> None:
        keep = ~gone
        self.traffic = [v for v, kept in zip(self.traffic, keep, strict=True) if kept]
        self.vehicles = ([self.ego] if self.ego is not None else []) + self.traffic
        for name in (*_ARRAYS, "pose"):
            setattr(self, name, getattr(self, name)[keep])
        self.entered = np.append(self.entered[:-1][keep], self.entered[-1])
