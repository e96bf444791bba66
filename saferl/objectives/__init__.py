"""Constrained losses, written the way TorchRL writes its own."""

from __future__ import annotations

from saferl.objectives.sac import SACLagLoss

__all__ = ["SACLagLoss"]
