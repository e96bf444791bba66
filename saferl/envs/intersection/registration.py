"""The names under which gymnasium makes the intersection, without an import of what it is built on."""

from __future__ import annotations

import gymnasium


def register() -> None:
    """Make ``saferl/Intersection-{LT,GS,RT,Mixed}-v0`` known to ``gymnasium.make``."""
    for name, task in (("LT", "lt"), ("GS", "gs"), ("RT", "rt"), ("Mixed", "mixed")):
        key = f"saferl/Intersection-{name}-v0"
        if key not in gymnasium.registry:
            gymnasium.register(
                id=key,
                entry_point="saferl.envs.intersection.highway:IntersectionEnv",
                kwargs={"task": task},
            )
