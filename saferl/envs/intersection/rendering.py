"""Pictures of a scene, drawn with highway-env's own graphics and without a display."""

from __future__ import annotations

import os
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from saferl.envs.intersection.geometry import ARM, CURB_RADIUS, HALF_BOX, LANE_WIDTH

if TYPE_CHECKING:
    from saferl.envs.intersection.regulation import IntersectionRoad
    from saferl.envs.intersection.traffic import Vehicles

_HALF_ROAD, _END = 2 * LANE_WIDTH, HALF_BOX + ARM
#: The pavement, as (x, y, width, height) of rectangles, m.
PAVEMENT = (
    (-_HALF_ROAD, -_END, 2 * _HALF_ROAD, 2 * _END),
    (-_END, -_HALF_ROAD, 2 * _END, 2 * _HALF_ROAD),
    (-HALF_BOX, -HALF_BOX, 2 * HALF_BOX, 2 * HALF_BOX),
)
#: Centres (x, y), m, of the circles of grass that round off the corners of the box.
CURBS = tuple((x, y) for x in (-HALF_BOX, HALF_BOX) for y in (-HALF_BOX, HALF_BOX))

SIZE = 600  # pixels
VIEW = 55.0  # m shown to either side of the middle of the intersection
_GRASS = (122, 158, 108)
_ASPHALT = (100, 100, 100)


class Renderer:
    """Draws a road into arrays [600, 600, 3] uint8, north up, the whole intersection in view.

    Args:
        size: width and height in pixels.
        view: metres shown to either side of the middle.
    """

    def __init__(self, size: int = SIZE, view: float = VIEW):
        # No display is opened; this keeps SDL from looking for one.
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        import pygame
        from highway_env.road.graphics import WorldSurface

        canvas: Any = pygame.Surface((size, size))
        self.surface = WorldSurface((size, size), 0, canvas)
        self.surface.scaling = size / (2 * view)
        self.surface.centering_position = [0.5, 0.5]
        self.surface.move_display_window_to(np.zeros(2))
        self._background: Any = None
        self._made = size, view

    def __reduce__(self) -> tuple:
        """A copy has a surface of its own."""
        return Renderer, self._made

    def _draw_background(self, road: IntersectionRoad) -> Any:
        import pygame
        from highway_env.road.graphics import LaneGraphics

        surface = self.surface
        surface.fill(_GRASS)
        pix = surface.vec2pix
        for x, y, width, height in PAVEMENT:
            (left, top), (right, bottom) = pix((x, y)), pix((x + width, y + height))
            pygame.draw.rect(surface, _ASPHALT, (left, top, right - left, bottom - top))
        for centre in CURBS:
            pygame.draw.circle(surface, _GRASS, pix(centre), surface.pix(CURB_RADIUS))
        for lane in road.network.lanes_list():
            LaneGraphics.display(lane, surface)
        return surface.copy()

    def draw(self, road: IntersectionRoad) -> np.ndarray:
        """The scene as it is now; yielding vehicles are orange, the ego is green."""
        import pygame
        from highway_env.vehicle.graphics import VehicleGraphics

        if self._background is None:
            self._background = self._draw_background(road)
        self.surface.blit(self._background, (0, 0))
        for vehicle in road.vehicles:
            VehicleGraphics.display(vehicle, self.surface, offscreen=True)
        return np.ascontiguousarray(np.moveaxis(pygame.surfarray.array3d(self.surface), 0, 1))


@lru_cache(maxsize=1)
def _stage() -> tuple[IntersectionRoad, Renderer]:
    """A road to put scenes on, and what draws it: the road's lanes take longer than a picture."""
    from saferl.envs.intersection.regulation import IntersectionRoad  # late: needs highway-env

    return IntersectionRoad(), Renderer()


def draw_state(ego: Tensor, route: int, vehicles: Vehicles) -> np.ndarray:
    """The picture [600, 600, 3] uint8 of one environment of the batched intersection.

    Args:
        ego: state [6], on the CPU.
        route: the ego's, in :data:`~saferl.envs.intersection.geometry.ROUTES`.
        vehicles: surrounding ones, each [N], on the CPU.
    """
    from saferl.envs.intersection.vehicles import EgoVehicle

    road, renderer = _stage()
    road.populate(EgoVehicle(road, ego, route), vehicles)
    return renderer.draw(road)
