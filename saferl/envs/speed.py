"""Running tasks with a speed limit: ``pip install 'saferl[mujoco]'``.

    python -m saferl experiment=speed algo=sac_lag lagrange=signed lagrange.multiplier.lr=3e-3

Importing this registers ``saferl/{HalfCheetah,Hopper,Walker2d,Swimmer,Ant}Speed-v0``.
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium

#: gymnasium's running tasks, and the default limit of each, m/s.
RUNNERS = {"HalfCheetah": 1.0, "Hopper": 0.5, "Walker2d": 0.5, "Swimmer": 0.05, "Ant": 0.5}


class SpeedLimit(gymnasium.Wrapper):
    """Costs 1 in each step that is faster than a limit, in ``info["cost"]``.

    Args:
        env: tells ``x_velocity``, and in a plane ``y_velocity``, in its ``info``.
        limit: m/s.

    Raises:
        ValueError: ``limit`` is not positive.
    """

    def __init__(self, env: gymnasium.Env, limit: float):
        if not limit > 0:
            raise ValueError(f"limit must be > 0, got {limit}.")
        super().__init__(env)
        self.limit = limit

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        speed = math.hypot(info["x_velocity"], info.get("y_velocity", 0.0))
        cost = float(speed > self.limit)
        return observation, reward, terminated, truncated, {**info, "cost": cost}


def make(runner: str, limit: float | None = None, **settings: Any) -> gymnasium.Env:
    """One of :data:`RUNNERS` with a speed limit, by default its own."""
    env = gymnasium.make(f"{runner}-v5", **settings)
    return SpeedLimit(env, RUNNERS[runner] if limit is None else limit)


for _name in RUNNERS:
    gymnasium.register(
        f"saferl/{_name}Speed-v0", make, max_episode_steps=1000, kwargs={"runner": _name}
    )
