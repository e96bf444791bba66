"""From settings to an agent and what it learns by."""

from saferl.algorithms.base import Agent, Algorithm, Parts
from saferl.algorithms.off_policy import OffPolicy
from saferl.algorithms.on_policy import OnPolicy

__all__ = ["Agent", "Algorithm", "OffPolicy", "OnPolicy", "Parts"]
