"""Settings by their dotted names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Settings of where and how a run is made, not of what it is.
MADE = ("out", "device", "threads", "collector", "logger", "save_every", "save_minutes")


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


def system_name(settings: Mapping[str, Any]) -> str:
    """What a system is system_name: its algorithm, and what corrects it if that has a name. Settings by dotted keys.

    >>> system_name({"algo_name": "sac", "projector.name": "shield"}), system_name({"algo_name": "sac"})
    ('sac + shield', 'sac')
    """
    names = [settings.get(key) for key in ("algo_name", "projector.name")]
    return " + ".join(str(name) for name in names if name)
