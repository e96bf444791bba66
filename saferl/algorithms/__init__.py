"""From settings to an agent and what it learns by."""

from saferl.algorithms.base import Agent, Algorithm
from saferl.algorithms.off_policy import OffPolicy
from saferl.algorithms.on_policy import OnPolicy
from saferl.algorithms.parts import Parts

__all__ = ["Agent", "Algorithm", "OffPolicy", "OnPolicy", "Parts"]
