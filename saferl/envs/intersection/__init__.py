"""The intersection of the paper as a constrained Markov decision process, on two backends."""

from saferl.envs.intersection.base import IntersectionBase, Scenario
from saferl.envs.intersection.batched import BatchedIntersection
from saferl.envs.intersection.cost import CollisionCost
from saferl.envs.intersection.highway import IntersectionEnv, register
from saferl.envs.intersection.highway_torchrl import HighwayIntersection
from saferl.envs.intersection.reward import Reward
from saferl.envs.intersection.spawning import SCENARIOS, Traffic

__all__ = [
    "SCENARIOS",
    "BatchedIntersection",
    "CollisionCost",
    "HighwayIntersection",
    "IntersectionBase",
    "IntersectionEnv",
    "Reward",
    "Scenario",
    "Traffic",
    "register",
]
