"""What all networks of a scene share: the scales of its features, absent rows, and layers on rows."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

EGO_SCALE = (1.0, 10.0, 10.0, 10.0, 2.0, 1.0, 1.0, 20.0, 50.0)
"""Divisors of the ego features (I_veh, x, y, v_x, v_y, phi, omega, d_veh, d_des)."""
VEHICLE_SCALE = (1.0, 20.0, 20.0, 10.0, 10.0, 1.0)
"""Divisors of a vehicle's features (I_veh, dx, dy, dv_x, dv_y, phi)."""

#: In place of what belongs to an absent row, before a softmax or a largest.
MASKED = -1e9


def feature_scale(name: str, values: Sequence[float]) -> Tensor:
    """The divisors of a row of features as a tensor; every one must be positive and finite."""
    scale = torch.as_tensor(values, dtype=torch.get_default_dtype())
    if scale.ndim != 1 or not bool((scale.isfinite() & (scale > 0)).all()):
        raise ValueError(f"{name} must be positive finite numbers, got {tuple(values)}.")
    return scale


def check_sizes(**sizes: int) -> None:
    """Refuses a size or count below 1, by its name."""
    for name, value in sizes.items():
        if value < 1:
            raise ValueError(f"{name} must be >= 1, got {value}.")


def scale_ego(ego: Tensor, scale: Tensor) -> Tensor:
    """Scaled features [*B, F]."""
    if ego.shape[-1] != len(scale):  # one feature would be repeated
        raise ValueError(f"ego must have {len(scale)} features, got shape {tuple(ego.shape)}.")
    return ego / scale


def scale_vehicles(vehicles: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
    """Scaled features [*B, M, F], zero where the row is absent, and presence [*B, M] (bool)."""
    if vehicles.shape[-1] != len(scale):
        raise ValueError(
            f"vehicles must have {len(scale)} features, got shape {tuple(vehicles.shape)}."
        )
    present = vehicles[..., 0] > 0
    return torch.where(present.unsqueeze(-1), vehicles / scale, 0.0), present


def largest(rows: Tensor, present: Tensor) -> Tensor:
    """The largest of the rows [*B, M, K] that are ``present`` [*B, M, 1], [*B, K]; where none is, so low that
    a GELU makes 0 of it."""
    if not rows.shape[-2]:
        return rows.new_full((*rows.shape[:-2], rows.shape[-1]), MASKED)
    # A sum, whose gradient is the rows' own: choosing row by row took a sixth of an update at width 64.
    return (rows + torch.where(present, 0.0, MASKED)).amax(-2)


def flat_linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """``F.linear`` of [*B, F] as of [N, F].

    With stacked weights, vmap turns a linear map of three or more dimensions into a product with
    one copy of the weights for each scene, which is several times slower.
    """
    if x.ndim == 2:
        return F.linear(x, weight, bias)
    out = F.linear(x.reshape(-1, x.shape[-1]), weight, bias)
    return out.reshape(*x.shape[:-1], out.shape[-1])
