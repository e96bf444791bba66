"""The intersection of the paper as a constrained Markov decision process, on three backends.

The batched road stands alone; highway-env is imported with the first use of what is built on it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from saferl.envs.intersection.base import IntersectionBase
from saferl.envs.intersection.batched import BatchedIntersection
from saferl.envs.intersection.collision_cost import CollisionCost
from saferl.envs.intersection.registration import register
from saferl.envs.intersection.reward import Reward
from saferl.envs.intersection.scenario import Scenario
from saferl.envs.intersection.spawning import SCENARIOS, Traffic
from saferl.envs.intersection.sumo import SumoIntersection

if TYPE_CHECKING:
    from saferl.envs.intersection.highway import IntersectionEnv
    from saferl.envs.intersection.highway_torchrl import HighwayIntersection

__all__ = [
    "SCENARIOS",
    "BatchedIntersection",
    "CollisionCost",
    "HighwayIntersection",
    "IntersectionBase",
    "IntersectionEnv",
    "Reward",
    "Scenario",
    "SumoIntersection",
    "Traffic",
    "register",
]

_LATE = {"IntersectionEnv": "highway", "HighwayIntersection": "highway_torchrl"}


def __getattr__(name: str) -> Any:
    if name not in _LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LATE[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_LATE})
