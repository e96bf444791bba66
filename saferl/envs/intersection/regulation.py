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
from saferl.envs.intersection.network import build_network, rectangles_overlap, routes
from saferl.envs.intersection.traffic import EgoVehicle, RouteVehicle

PERIOD = 0.2  # s between two decisions of the traffic, at any policy frequency
HORIZON = 2.0  # s of prediction (paper)
TIMES = np.arange(0.25, HORIZON + 0.01, 0.25)
STRETCH = 1.5  # predicted rectangles are 1.5 times as long, as in highway-env
GO_SPEED = 4.0  # m/s, least speed at which a vehicle predicts its own crossing
COMMIT = 5.0  # m/s^2; a vehicle that could not stop with it before the box has entered
STOP = ARM - LENGTH / 2 - 1.0  # m, where a yielding vehicle's centre stops
TIME_MARGIN = 0.5  # s between two vehicles in the zone where their routes cross
CORRIDOR = WIDTH / 2 + 0.3  # m to either side of the route that must be free of bodies
BODY_GAP = 3.0  # m kept from a body across the corridor
EGO_ROOM = 2.0  # m more for the ego, which keeps to no line
_BODY = np.array([(x, y) for x in (-0.5, 0.0, 0.5) for y in (-0.5, 0.5)]) * (LENGTH, WIDTH)


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
        route, s, speed, desired: their routes [N], arc lengths [N] m, speeds and wanted speeds
            [N] m/s.
        held: [N] bool, waits at the entry line; stop: [N] arc length where it must stop, or inf.
    """

    def __init__(self, network: RoadNetwork | None = None):
        super().__init__(network or build_network(), [], [])
        self.table = routes()
        self.populate(None, np.zeros(0, int), np.zeros(0), np.zeros(0))

    def populate(
        self, ego: EgoVehicle | None, route: np.ndarray, s: np.ndarray, speed: np.ndarray
    ) -> None:
        """Put the ego and new surrounding vehicles on the road, and start its clock."""
        self.ego = ego
        self.traffic = [
            RouteVehicle(self, r, at, v, self.table)
            for r, at, v in zip(route, s, speed, strict=True)
        ]
        self.vehicles = ([ego] if ego is not None else []) + self.traffic
        self.route, self.s = np.array(route, int), np.array(s, float)
        self.speed, self.desired = np.array(speed, float), np.array(speed, float)
        self.acceleration = np.zeros(len(route))
        self.entered = np.full(len(route) + 1, np.inf)  # s, the ego last
        self.held = np.zeros(len(route), bool)
        self.stop = np.full(len(route), np.inf)
        self.pose = self.table.pose(self.route, self.s)
        self.time, self.next_pass = 0.0, 0.0

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
        path = self.table.pose(route[:, None], s[:, None] + pace[:, None] * TIMES)
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
        rank = np.where(
            inside, 1e6 - np.where(inside, entered, 0.0), table.priority[route] * 1e3 - arrival
        )
        rank += s * 1e-6 - np.arange(total) * 1e-9  # no ties

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
                self.held[i] = blocked[i] or (meet[i] & free & (rank > rank[i])).any()
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
        return crossing & (begin < other_end + TIME_MARGIN) & (other_begin < end + TIME_MARGIN)

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
        top, best = RouteVehicle.COMFORT_ACC_MAX, -RouteVehicle.COMFORT_ACC_MIN
        # Slow down in time for the box, keep its speed limit, and speed up after it.
        limit = np.sqrt(table.turn_speed[route] ** 2 + 2 * 2.0 * np.maximum(ARM - s, 0.0))
        limit = np.where(s > table.out[route], np.inf, limit)
        wanted = np.minimum(self.desired, limit)
        a = top * (1 - (v / wanted) ** RouteVehicle.DELTA)

        gap, pace, along = self._leaders()
        gap = np.maximum(gap, 0.1)
        spacing = (
            RouteVehicle.DISTANCE_WANTED
            - LENGTH
            + v[:, None] * RouteVehicle.TIME_WANTED
            + v[:, None] * (v[:, None] - pace) / (2 * np.sqrt(top * best))
        )
        follow = a[:, None] - top * (np.maximum(spacing, 0.5) / gap) ** 2
        # A body across the corridor is no leader to follow; brake for it once that is needed.
        need = v[:, None] ** 2 / (2 * np.maximum(gap - BODY_GAP, 0.1))
        cross = np.where((need > 3.0) | (gap < BODY_GAP + 0.5), -np.maximum(need, 1.0), np.inf)
        a = np.minimum(a, np.where(along, follow, cross).min(1, initial=np.inf))

        room = self.stop - s
        need = v**2 / (2 * np.maximum(room, 0.1))
        brake = (need > 2.0) | (room < 1.0)
        a = np.where(brake, np.minimum(a, -np.maximum(need, 0.5)), a)
        self.acceleration = np.clip(a, -RouteVehicle.ACC_MAX, RouteVehicle.ACC_MAX)

    def _leaders(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For N vehicles and M bodies: gap [N, M] m (inf if not ahead), the body's speed along the
        route [N, M], and whether it drives along it."""
        pose, speed = self.pose, self.speed
        if self.ego is not None:
            ego = self.ego
            pose = np.concatenate([pose, [[*ego.position, ego.heading]]])
            speed = np.append(speed, ego.speed)
        cos, sin = np.cos(pose[:, 2, None]), np.sin(pose[:, 2, None])
        points = np.stack(
            [pose[:, 0, None] + cos * _BODY[:, 0] - sin * _BODY[:, 1],
             pose[:, 1, None] + sin * _BODY[:, 0] + cos * _BODY[:, 1]], -1,
        )  # fmt: skip
        where, lateral = self.table.project(
            self.route[:, None], np.broadcast_to(points, (len(self.s), *points.shape))
        )
        ahead = (np.abs(lateral) < CORRIDOR) & (where > self.s[:, None, None] + 1.0)
        gap = np.where(ahead, where, np.inf).min(-1) - self.s[:, None] - LENGTH / 2
        index = np.arange(len(self.s))
        gap[index, index] = np.inf
        near = np.where(np.isfinite(gap), gap + LENGTH / 2, 0.0) + self.s[:, None]
        heading = self.table.pose(self.route[:, None], near)[..., 2]
        aligned = np.cos(pose[:, 2] - heading)
        return gap, speed * aligned, aligned > 0.5

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
        for name in ("route", "s", "speed", "desired", "acceleration", "held", "stop", "pose"):
            setattr(self, name, getattr(self, name)[keep])
        self.entered = np.append(self.entered[:-1][keep], self.entered[-1])
