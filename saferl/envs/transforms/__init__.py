"""Transforms that any TorchRL environment or replay buffer can be given."""

from saferl.envs.transforms.cost_to_reward import CostToReward
from saferl.envs.transforms.projector import ExecutedAction, SafetyProjector

__all__ = ["CostToReward", "ExecutedAction", "SafetyProjector"]
