"""What the ego observes: its own nine features and the vehicles around it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from saferl.envs.intersection.geometry import LENGTH, WIDTH, target_points

AHEAD = 70.0  # m along the ego's heading
BEHIND = 30.0
ROWS = 11
_RADIUS = math.hypot(LENGTH / 4, WIDTH / 2)


def _circles(state: Tensor) -> Tensor:
    """Centres [..., 2, 2] of the two circles that stand for a vehicle."""
    heading = torch.stack([torch.cos(state[..., 4]), torch.sin(state[..., 4])], -1) * (LENGTH / 4)
    return torch.stack([state[..., :2] + heading, state[..., :2] - heading], -2)


def vehicle_distance(ego: Tensor, vehicles: Tensor, observed: Tensor) -> Tensor:
    """d_veh [...], metres: smallest gap between the ego's two circles and any observed vehicle's.

    Args:
        ego: [..., 6].
        vehicles: [..., N, 6].
        observed: bool [..., N]; with none observed the distance is 70 m.
    """
    offset = _circles(vehicles)[..., None, :] - _circles(ego)[..., None, None, :, :]
    gap = offset.norm(dim=-1).flatten(-2).amin(-1) - 2 * _RADIUS
    none = torch.full_like(ego[..., :1], torch.inf)  # also where there is no vehicle at all
    nearest = torch.cat([torch.where(observed, gap, torch.inf), none], -1).amin(-1)
    return torch.where(observed.any(-1), nearest, AHEAD)


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
    cos, sin = torch.cos(ego[..., 4]), torch.sin(ego[..., 4])
    delta = vehicles[..., :2] - ego[..., None, :2]
    ahead = delta[..., 0] * cos[..., None] + delta[..., 1] * sin[..., None]
    distance = delta.norm(dim=-1)
    seen = present & (ahead <= AHEAD) & (ahead >= -BEHIND)

    count = min(rows - 1, vehicles.shape[-2])
    order = torch.where(seen, distance, torch.inf).argsort(dim=-1, stable=True)[..., :count]
    observed = torch.zeros_like(seen).scatter(-1, order, True) & seen

    v_cos, v_sin = torch.cos(vehicles[..., 4]), torch.sin(vehicles[..., 4])
    world_v = torch.stack([ego[..., 2] * cos - ego[..., 3] * sin,
                           ego[..., 2] * sin + ego[..., 3] * cos], -1)  # fmt: skip
    features = torch.cat(
        [
            torch.ones_like(distance)[..., None],
            delta,
            (vehicles[..., 2] * v_cos - vehicles[..., 3] * v_sin)[..., None]
            - world_v[..., None, :1],
            (vehicles[..., 2] * v_sin + vehicles[..., 3] * v_cos)[..., None]
            - world_v[..., None, 1:],
            (torch.remainder(vehicles[..., 4:5] + 0.75 * math.pi, 2 * math.pi) - 0.75 * math.pi),
        ],
        -1,
    )
    features = torch.where(seen[..., None], features, 0.0)
    table = features.gather(-2, order[..., None].expand(*order.shape, 6))
    table = torch.nn.functional.pad(table, (0, 0, 0, rows - count))

    own = torch.cat(
        [
            torch.ones_like(ego[..., :1]),
            ego,
            vehicle_distance(ego, vehicles, observed)[..., None],
            destination_distance(ego, route)[..., None],
        ],
        -1,
    )
    return own, table, observed
