"""The road of highway-env's objects, driven by the tensor rules.

highway-env's own road predicts the ego again for every pair of vehicles, tests rectangles with a
rotation of the wrong sign, and stops yielding vehicles wherever they are. Here the rules of
:mod:`~saferl.envs.intersection.yielding` and :mod:`~saferl.envs.intersection.traffic` decide and move
all vehicles at once, and the objects follow.
"""

from __future__ import annotations

import torch
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import RoadNetwork
from torch import Tensor

from saferl.envs.intersection.network import build_network
from saferl.envs.intersection.roads import lanes, pairs, zones
from saferl.envs.intersection.traffic import Vehicles, accelerate, move, vehicle_states
from saferl.envs.intersection.vehicles import EgoVehicle, RouteVehicle
from saferl.envs.intersection.yielding import PERIOD, road_rules


class IntersectionRoad(RegulatedRoad):
    """highway-env's regulated road with the ego and surrounding vehicles on routes.

    Attributes:
        ego: the ego vehicle, or None before the first scene.
        surrounding: the surrounding vehicles, each [N] float64, absent ones too.
        states: theirs [N, 6]: x, y, v_x, 0, phi, omega.
        acceleration: theirs [N], m/s^2.
        traffic: highway-env's object of each that is present, by its number in [0, N).
    """

    surrounding: Vehicles
    states: Tensor
    acceleration: Tensor

    def __init__(self, network: RoadNetwork | None = None):
        super().__init__(network or build_network(), [], [])
        self.ego: EgoVehicle | None = None
        self.traffic: dict[int, RouteVehicle] = {}

    def populate(self, ego: EgoVehicle, vehicles: Vehicles) -> None:
        """Put the ego and surrounding vehicles [N] on the road, and start its clock."""
        self.ego, self.traffic = ego, {}
        self.time, self.next_pass = 0.0, 0.0
        self.acceleration = torch.zeros_like(vehicles.s)
        self.replace(vehicles)

    def replace(self, vehicles: Vehicles) -> None:
        """Let these [N] be the surrounding vehicles, the clock going on."""
        assert self.ego is not None
        route, like, ego_route = vehicles.route, vehicles.s, torch.tensor([self.ego.route_id])
        self._lane, self._own = lanes(route, like), lanes(ego_route[0], like)
        self._zone, self._pair = zones(route, torch.cat([route, ego_route]), like), pairs(route)
        self._take(vehicles)

    def _take(self, vehicles: Vehicles) -> None:
        """Bring highway-env's objects to where the vehicles are."""
        self.surrounding, self.states = vehicles, vehicle_states(vehicles, self._lane)
        columns = (*vehicles[:7], vehicles.held, self.acceleration, self.states)
        for number, (present, route, s, _, desired, headway, _, held, pushed, state) in enumerate(
            zip(*(column.tolist() for column in columns), strict=True)
        ):
            if not present:
                self.traffic.pop(number, None)
                continue
            if number not in self.traffic:
                self.traffic[number] = RouteVehicle(self, route, desired, headway)
            self.traffic[number].follow(s, pushed, state)
            self.traffic[number].is_yielding = held
        self.vehicles = [self.ego, *self.traffic.values()]

    def enforce_road_rules(self) -> None:
        """Decide which vehicles wait at the line or brake in the box."""
        assert self.ego is not None
        time = torch.tensor(self.time, dtype=torch.float64)
        who = self.surrounding, self._lane, self._own, self._zone, self.ego.state
        self.surrounding = road_rules(*who, time)

    def act(self) -> None:
        """Accelerations of all surrounding vehicles; the road rules first if a pass is due."""
        if self.ego is None or not len(self.surrounding.s):
            return
        if self.time >= self.next_pass - 1e-9:
            self.enforce_road_rules()
            self.next_pass += PERIOD
        self.acceleration = accelerate(self.surrounding, self._lane, self._pair, self.ego.state)

    def step(self, dt: float) -> None:
        """Move every vehicle by ``dt`` seconds; who passes the end of an exit arm is gone."""
        if self.ego is not None:
            self.ego.step(dt)
        self._take(move(self.surrounding, self._lane, self.acceleration, dt))
        self.time += dt
