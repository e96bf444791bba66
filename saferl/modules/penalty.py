"""Multipliers that nothing ascends: a fixed penalty, and a switch."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from saferl.modules.lagrange import LagrangeMultiplier


class ExactPenalty(LagrangeMultiplier):
    r"""A fixed price kappa of a violation, which remembers the last one (Zhang et al., 2022, arXiv 2205.11814).

    An exact penalty :math:`\kappa \max(0, J_c - d)` has the minimum of the constrained problem, as long as kappa exceeds
    the multiplier of its optimum. Nothing has to be learned; :class:`saferl.objectives.P3OLoss` reads :attr:`excess`.

    Args:
        init: kappa, in units of reward per cost; of several constraints a list [K].

    Attributes:
        excess: mean violation of the last update, in the unit of the cost; 0 before the first. A scalar, or [K].

    Raises:
        ValueError: ``init`` is negative or not finite.

    Examples:
        >>> import torch
        >>> from saferl.modules import ExactPenalty
        >>> penalty = ExactPenalty(init=20.0)
        >>> penalty.update(torch.tensor([-0.5, 0.1]))
        >>> penalty.value.item(), round(penalty.excess.item(), 6)
        (20.0, -0.2)
    """

    excess: Tensor

    def __init__(self, init: float | Sequence[float] = 20.0):
        super().__init__(init, signed=True)
        self.register_buffer("excess", torch.zeros_like(self.value))

    @torch.no_grad()
    def update(self, penalty: Tensor, elapsed: float = 1.0) -> None:
        mean, known = self._mean(penalty)
        self.excess.copy_(torch.where(known, mean, self.excess))


class Switch(LagrangeMultiplier):
    """1 while a constraint is violated by more than a tolerance, else 0 (Xu, Liang and Lan, 2021, arXiv 2011.05869).

    Of several constraints the one that is violated most is switched on, alone: the violations should be shares of
    their limits. :class:`saferl.objectives.CRPOLoss` reads it.

    Args:
        tolerance: eta, what a mean violation may be before it counts, in its own unit.
        init: first value; of several constraints a list [K].

    Raises:
        ValueError: ``tolerance`` is not finite, or ``init`` lies outside [0, 1].

    Examples:
        >>> import torch
        >>> from saferl.modules import Switch
        >>> switch = Switch(tolerance=0.1, init=[0.0, 0.0])
        >>> switch.update(torch.tensor([[0.2, 0.3]]))
        >>> switch.value.tolist()
        [0.0, 1.0]
        >>> switch.update(torch.tensor([[0.05, -0.2]]))
        >>> switch.value.tolist()
        [0.0, 0.0]
    """

    def __init__(self, tolerance: float = 0.0, init: float | Sequence[float] = 0.0):
        super().__init__(init, signed=True, maximum=1.0)
        if not math.isfinite(tolerance):
            raise ValueError(f"tolerance must be finite, got {tolerance}.")
        self.tolerance = float(tolerance)

    @torch.no_grad()
    def update(self, penalty: Tensor, elapsed: float = 1.0) -> None:
        mean, known = self._mean(penalty)
        mean = torch.where(known, mean, -math.inf)
        worst = torch.zeros_like(self.value)
        worst.view(-1)[mean.argmax()] = 1.0
        self.value.copy_(torch.where(known.any(), worst * (mean > self.tolerance), self.value))
