"""From places, headings and speeds of cars to what a policy observes of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from saferl.envs.intersection.geometry import ROUTES
from saferl.envs.intersection.observation import ROWS, observe
from saferl.envs.ports import Feature, Port

_STATE = {
    "x": Feature(20.0, "m", says="of the centre, to the east; the middle of the box is 0, 0"),
    "y": Feature(20.0, "m", says="to the south"),
    "v_x": Feature(10.0, "m/s", low=0.0, says="forwards"),
    "v_y": Feature(2.0, "m/s", says="to the right"),
    "phi": Feature(1.0, "rad", says="heading, clockwise from x; the ego comes at -pi / 2"),
    "omega": Feature(1.0, "rad/s", says="yaw rate, clockwise"),
}


@dataclass(frozen=True)
class FromState:
    """:func:`observe` as a function of the state alone: for whoever has cars and no observation.

    Attributes:
        rows, form: see :func:`observe`.

    Reads ``ego`` [B, 6] and ``vehicles`` [B, N, 6] (x, y, v_x, v_y, phi, omega in highway-env's frame: x to the right, y
    down), absent rows NaN throughout, N from 0; and ``route`` [B] int64, a row of :data:`ROUTES`. Returns ``ego`` [B, F] and
    ``vehicles`` [B, M, G]; ``ego`` is NaN where a car is known in part or there is no such route.

    >>> ego, route = torch.tensor([[2.0, 55.0, 8.0, 0.0, -1.5708, 0.0]]), torch.tensor([1])
    >>> alone = FromState()(ego, torch.full((1, 3, 6), torch.nan), route)
    >>> alone["ego"].shape, int(alone["vehicles"].count_nonzero())
    (torch.Size([1, 12]), 0)
    """

    rows: int = ROWS
    form: str = "route"

    ports: ClassVar[dict[str, Port]] = {
        "ego": Port(("batch", 6), _STATE, says="the ego"),
        "vehicles": Port(
            ("batch", "vehicles", 6), _STATE, says="the others; a row of NaN: no vehicle"
        ),
        "route": Port(
            ("batch",),
            dtype=torch.int64,
            says=", ".join(f"{number}: {name}" for number, name in enumerate(ROUTES)),
        ),
    }

    def __call__(self, ego: Tensor, vehicles: Tensor, route: Tensor) -> dict[str, Tensor]:
        # One absent row more: not every runtime knows the largest of none.
        vehicles = torch.cat([vehicles, torch.full_like(ego[:, None], torch.nan)], 1)
        unknown = vehicles.isnan()
        present = ~unknown.any(-1)
        others = torch.where(present[..., None], vehicles, 0.0)
        there = route.clamp(0, len(ROUTES) - 1)
        own, table, _ = observe(ego, others, present, there, self.rows, self.form)
        # A car of which only a part is known must not seem to be absent, nor -1 the last route.
        partly = (unknown.any(-1) & ~unknown.all(-1)).any(-1)
        unfit = (partly | (there != route))[:, None]
        return {"ego": torch.where(unfit, torch.nan, own), "vehicles": table}
