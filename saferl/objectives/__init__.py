"""Constrained losses, written the way TorchRL writes its own."""

from __future__ import annotations

from saferl.objectives.cpo import CPOLoss
from saferl.objectives.policy_step import TrustRegionStep
from saferl.objectives.ppo import PPOLagLoss, RiskPPOLoss
from saferl.objectives.sac import SACLagLoss

__all__ = ["CPOLoss", "PPOLagLoss", "RiskPPOLoss", "SACLagLoss", "TrustRegionStep"]
