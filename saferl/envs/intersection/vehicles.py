"""The vehicles on the road: the ego, the surrounding vehicles, and how these are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from highway_env.road.road import Road
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from torch import Tensor

from saferl.envs.intersection.dynamics import step_ego
from saferl.envs.intersection.geometry import ARM, LENGTH, WIDTH
from saferl.envs.intersection.network import LANE_INDEXES
from saferl.envs.intersection.roads import lane_frames, lanes
from saferl.envs.intersection.traffic import ACC_MAX, ACCELERATION, BRAKING, GAP


class RouteVehicle(IDMVehicle):
    """A surrounding vehicle: highway-env's IDM vehicle on a route, without lane changes.

    :class:`~saferl.envs.intersection.regulation.IntersectionRoad` decides and moves all of them at
    once, exactly along their routes, so ``act`` and ``step`` of a single one do nothing.

    Args:
        road: the road it drives on.
        route_id: in [0, 16), see :mod:`~saferl.envs.intersection.roads`.
        desired: the speed that it wants, m/s.
        headway: s.
    """

    LENGTH, WIDTH = LENGTH, WIDTH
    COMFORT_ACC_MAX, COMFORT_ACC_MIN, ACC_MAX = ACCELERATION, -BRAKING, ACC_MAX  # m/s^2
    DISTANCE_WANTED = GAP + LENGTH  # m, centre to centre
    YIELDING_COLOR = (255, 170, 60)

    def __init__(self, road: Road, route_id: int, desired: float, headway: float):
        # Without a road the base class does not search every lane for the closest one.
        nowhere: Any = None
        super().__init__(nowhere, [0.0, 0.0], enable_lane_change=False, timer=0.0)
        self.road, self.route_id = road, route_id
        self.target_speed, self.TIME_WANTED = desired, headway
        self.is_yielding = False
        self.lane_index = None
        self._lane = lanes(torch.tensor(route_id), torch.zeros(1, dtype=torch.float64))
        self._out = float(self._lane.out)

    def follow(self, s: float, acceleration: float, state: Sequence[float]) -> None:
        """Take the place at arc length ``s`` with ``state`` [6]; keeps lane and route up to date."""
        x, y, self.speed, _, self.heading, _ = state
        self.s, self.position = s, np.array([x, y])
        self.action = {"steering": 0.0, "acceleration": acceleration}
        segment = 0 if s <= ARM else 1 if s <= self._out else 2
        index = LANE_INDEXES[self.route_id][segment]
        if index != self.lane_index:
            self.lane_index = self.target_lane_index = index
            self.lane = self.road.network.get_lane(index)
            self.route = list(LANE_INDEXES[self.route_id][segment:])

    @property
    def color(self) -> tuple[int, int, int] | None:
        """Orange while it waits for others, otherwise highway-env's own colour."""
        return self.YIELDING_COLOR if self.is_yielding else None

    def act(self, action=None) -> None:
        """Nothing: the road decides for all vehicles at once."""

    def step(self, dt: float) -> None:
        """Nothing: the road moves all vehicles at once."""

    def predict_trajectory_constant_speed(self, times) -> tuple[np.ndarray, np.ndarray]:
        """Positions [T, 2] and headings [T] along the route at constant speed."""
        ahead = self.s + self.speed * torch.as_tensor(times, dtype=torch.float64)
        place, heading = lane_frames(self._lane, ahead)
        return torch.stack([place.x, place.y], -1).numpy(), heading.numpy()


class EgoVehicle(Vehicle):
    """The ego: a highway-env vehicle that moves by the dynamic bicycle (E5_1b).

    Attributes:
        state: [6] float64, x, y, v_x, v_y, phi, omega; ``position``, ``heading`` and ``speed``
            follow it.
        control: [2] float64, a_x (m/s^2) and delta_f (rad), held over the substeps.
        route: row in :data:`~saferl.envs.intersection.geometry.ROUTES`.
    """

    LENGTH, WIDTH = LENGTH, WIDTH
    COLOR = (50, 200, 0)

    def __init__(self, road: Road, state: Tensor, route: int):
        nowhere: Any = None
        super().__init__(nowhere, [0.0, 0.0])
        self.road, self.route_id = road, int(route)
        self.color = self.COLOR
        self.control = torch.zeros(2, dtype=torch.float64)
        self.place(state)

    def place(self, state: Tensor) -> None:
        """Take ``state`` [6]."""
        self.state = state.to(torch.float64)
        x, y, v_x, v_y, phi, self.omega = self.state.tolist()
        self.position = np.array([x, y])
        self.heading, self.speed = phi, float(np.hypot(v_x, v_y))

    def act(self, action: Tensor | None = None) -> None:
        """Hold a control [2] in physical units; without one keep the last."""
        if action is not None:
            self.control = action.to(torch.float64)
            acceleration, steering = self.control.tolist()
            self.action = {"acceleration": acceleration, "steering": steering}

    def step(self, dt: float) -> None:
        """Integrate E5_1b for ``dt`` seconds."""
        self.place(step_ego(self.state, self.control, dt))
