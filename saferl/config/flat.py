"""Settings by their dotted names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Settings of where and how a run is made, not of what it is.
MADE = ("out", "device", "threads", "logger", "save_every", "save_minutes")


def flat(node: Any, prefix: str = "") -> dict[str, Any]:
    """A nested configuration by dotted keys.

    >>> flat({"lr": {"actor": [1, 2]}, "seed": 0})
    {'lr.actor': [1, 2], 'seed': 0}
    """
    if not isinstance(node, Mapping):
        return {prefix: node}
    return {
        name: value
        for key, below in node.items()
        for name, value in flat(below, f"{prefix}.{key}".removeprefix(".")).items()
    }
