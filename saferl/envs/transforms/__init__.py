"""Transforms that any TorchRL environment or replay buffer can be given, and the shield, which is of the intersection."""

from saferl.envs.transforms.correction import Correction
from saferl.envs.transforms.cost_to_reward import CostToReward
from saferl.envs.transforms.projector import ExecutedAction, SafetyProjector
from saferl.envs.transforms.saute import Saute
from saferl.envs.transforms.shield import Shield

__all__ = ["Correction", "CostToReward", "ExecutedAction", "SafetyProjector", "Saute", "Shield"]
