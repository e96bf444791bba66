"""What enters and leaves a policy: names, shapes, units and ranges."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch


class Feature(NamedTuple):
    """One number of an observation or of an action.

    Attributes:
        scale: what a network divides it by.
        unit: SI; "" for a number without one.
        low, high: between which it lies; infinite where nothing bounds it.
        says: what it is.
    """

    scale: float = 1.0
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    says: str = ""


@dataclass(frozen=True)
class Port:
    """A tensor that a policy reads or writes.

    Attributes:
        shape: its dimensions; those of any size by a name.
        features: of its last dimension, in their order; none where nothing is known of them.
        dtype: of its numbers.
        says: what it is.

    >>> port = Port(("batch", 2), {"speed": Feature(10.0, "m/s", low=0.0), "lane": Feature()})
    >>> port.describe()["features"][0]
    {'name': 'speed', 'unit': 'm/s', 'low': 0.0, 'high': None, 'says': ''}
    """

    shape: tuple[int | str, ...]
    features: Mapping[str, Feature] = field(default_factory=dict)
    dtype: torch.dtype = torch.float32
    says: str = ""

    def describe(self) -> dict[str, Any]:
        """All of it as plain values; null where nothing bounds a number."""
        features = [
            {
                "name": name,
                "unit": each.unit,
                "low": each.low if math.isfinite(each.low) else None,
                "high": each.high if math.isfinite(each.high) else None,
                "says": each.says,
            }
            for name, each in self.features.items()
        ]
        dtype = str(self.dtype).removeprefix("torch.")
        return {
            "shape": list(self.shape),
            "dtype": dtype,
            "says": self.says,
            "features": features,
        }
