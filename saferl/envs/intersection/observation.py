"""What the ego observes: its own nine features and the vehicles around it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from saferl.envs.intersection.geometry import LENGTH, WIDTH, columns, target_points

AHEAD = 70.0  # m along the ego's heading
BEHIND = 30.0
ROWS = 11
_RADIUS = math.hypot(LENGTH / 4, WIDTH / 2)


def _circles(state: Tensor) -> tuple[Tensor, Tensor]:
    """Centres x, y, each [2, ...], of the two circles that stand for a vehicle."""
    along, across = (LENGTH / 4 * f(state[..., 4]) for f in (torch.cos, torch.sin))
    x, y = state[..., 0], state[..., 1]
    return torch.stack([x + along, x - along]), torch.stack([y + across, y - across])


def vehicle_distance(ego: Tensor, vehicles: Tensor, observed: Tensor) -> Tensor:
    """d_veh [...], metres: smallest gap between the ego's two circles and any observed vehicle's.

    Args:
        ego: [..., 6].
        vehicles: [..., N, 6].
        observed: bool [..., N]; with none observed the distance is 70 m.
    """
    (x, y), (own_x, own_y) = _circles(vehicles.movedim(-2, 0)), _circles(ego)
    observed = observed.movedim(-1, 0)
    gap = torch.hypot(x - own_x[:, None, None], y - own_y[:, None, None]).amin((0, 1)) - 2 * _RADIUS
    gap = torch.where(observed, gap, torch.inf)
    none = torch.full_like(ego[..., 0], torch.inf)[None]  # also where there is no vehicle at all
    return torch.where(observed.any(0), torch.cat([gap, none]).amin(0), AHEAD)


def destination_distance(ego: Tensor, route: Tensor) -> Tensor:
    """d_des [...], metres: smallest Manhattan distance to the two target points."""
    return (target_points(route, ego) - ego[..., None, :2]).abs().sum(-1).amin(-1)


def observe(
    ego: Tensor, vehicles: Tensor, present: Tensor, route: Tensor, rows: int = ROWS
) -> tuple[Tensor, Tensor, Tensor]:
    """The observation of the CMDP, in SI units.

    Args:
        ego: [..., 6].
        vehicles: [..., N, 6]; N may be 0.
        present: bool [..., N].
        route: int64 [...].
        rows: M; at most M - 1 vehicles are observed, one row is always padding.

    Returns:
        ``ego`` [..., 9] = I_veh, x, y, v_x, v_y, phi, omega, d_veh, d_des; ``vehicles``
        [..., M, 6] = I_veh, dx, dy, dv_x, dv_y, phi in the world frame, nearest first, absent rows
        zero; and which of the N vehicles are observed, bool [..., N]. A vehicle's heading lies in
        [-3 pi / 4, 5 pi / 4): the seam is on no lane's direction.
    """
    # Vehicles come first here, [N, ...].
    x, y, v_x, v_y, heading, _ = vehicles.movedim(-2, 0).unbind(-1)
    own_x, own_y, own_v_x, own_v_y, phi, _ = ego.unbind(-1)
    cos, sin = torch.cos(phi), torch.sin(phi)
    dx, dy = x - own_x, y - own_y
    ahead = dx * cos + dy * sin
    seen = present.movedim(-1, 0) & (ahead <= AHEAD) & (ahead >= -BEHIND)

    # The row of each vehicle: how many are nearer.
    distance = torch.where(seen, torch.hypot(dx, dy), torch.inf)
    number = torch.arange(len(x), device=x.device).reshape(-1, *[1] * (x.ndim - 1))
    tie = (distance[None] == distance[:, None]) & (number[None] < number[:, None])
    row = ((distance[None] < distance[:, None]) | tie).sum(1)
    count = min(rows - 1, len(x))
    seen = seen & (row < count)

    v_cos, v_sin = torch.cos(heading), torch.sin(heading)
    features = [
        torch.ones_like(x),
        dx,
        dy,
        (v_x * v_cos - v_y * v_sin) - (own_v_x * cos - own_v_y * sin),
        (v_x * v_sin + v_y * v_cos) - (own_v_x * sin + own_v_y * cos),
        torch.remainder(heading + 0.75 * math.pi, 2 * math.pi) - 0.75 * math.pi,
    ]
    places = torch.arange(rows, device=x.device).reshape(-1, *[1] * x.ndim)
    here = (places == row) & seen  # [M, N, ...]
    table = torch.stack([torch.where(here, feature, 0.0).sum(1) for feature in features])
    observed = seen.movedim(0, -1)
    nearest = vehicle_distance(ego, vehicles, observed)
    own = columns(torch.ones_like(phi), *ego.unbind(-1), nearest, destination_distance(ego, route))
    return own, table.movedim((0, 1), (-1, -2)), observed
