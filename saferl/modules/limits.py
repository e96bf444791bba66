"""Limits on one cost or on several."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def as_limit(
    name: str, limit: float | Sequence[float] | Tensor, count: int | None = None
) -> Tensor:
    """A limit as float64: a scalar of one cost, [K] of several, so that ``risk - limit`` broadcasts over risks [*B, K].

    Args:
        name: of the setting, for the message.
        limit: a number, or one for each cost.
        count: K, where that is known: a number alone then serves all costs.

    Raises:
        ValueError: it is NaN, or of another number of costs.

    >>> as_limit("limit", 0.1).shape, as_limit("limit", [0.1, 0.2]).shape
    (torch.Size([]), torch.Size([2]))
    """
    values = torch.as_tensor(limit, dtype=torch.float64).detach().squeeze()
    if values.ndim > 1 or values.isnan().any():
        raise ValueError(f"{name} must be a number, or a list of one for each cost, got {limit}.")
    if count is not None and values.numel() not in (1, count):
        raise ValueError(f"{name} must be a number, or {count} of them, got {values.numel()}.")
    return values
