"""Constrained losses, written the way TorchRL writes its own."""

from __future__ import annotations

from saferl.objectives.cat import CaTLoss
from saferl.objectives.cpo import CPOLoss
from saferl.objectives.crpo import CRPOLoss
from saferl.objectives.focops import FOCOPSLoss
from saferl.objectives.p3o import P3OLoss
from saferl.objectives.policy_step import TrustRegionStep
from saferl.objectives.ppo import PPOLagLoss, RiskPPOLoss
from saferl.objectives.sac import SACLagLoss

__all__ = [
    "CPOLoss",
    "CRPOLoss",
    "CaTLoss",
    "FOCOPSLoss",
    "P3OLoss",
    "PPOLagLoss",
    "RiskPPOLoss",
    "SACLagLoss",
    "TrustRegionStep",
]
