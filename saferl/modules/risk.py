"""What the members of an ensemble of cost critics make a risk of, [n, *B, N] -> [*B, 1].

N is 1, or the number of quantiles of a distributional critic, whose mean is the expected cost. Of several costs each is
given by itself: they are a dimension of B.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Largest:
    """The largest of the members' expected costs (paper: Q_c = max_i Q_c,i).

    >>> Largest()(torch.tensor([[[1.0]], [[3.0]]]))
    tensor([[3.]])
    """

    def __call__(self, values: Tensor) -> Tensor:
        return values.mean(-1, keepdim=True).amax(0)


@dataclass(frozen=True)
class MeanStd:
    """Mean of the members' expected costs plus ``k`` standard deviations, for ensembles of about four
    (CAL, Wu et al., 2024).

    Attributes:
        k: how cautious; negative is optimistic.

    >>> MeanStd(k=2.0)(torch.tensor([[[1.0]], [[3.0]]]))
    tensor([[4.]])
    """

    k: float = 1.0

    def __call__(self, values: Tensor) -> Tensor:
        values = values.mean(-1, keepdim=True)
        # The variance of equal members has no root that can be differentiated.
        spread = values.var(0, correction=0).clamp_min(1e-12).sqrt()
        return values.mean(0) + self.k * spread


@dataclass(frozen=True)
class CVaR:
    """The mean cost of the worst cases, as the largest of the members says (WCSAC, Yang et al., 2021).

    Of N quantiles at (i + 1/2) / N each stands for 1 / N of the cases; those beyond ``level`` count.

    Attributes:
        level: in [0, 1); 0 is the expected cost.

    Raises:
        ValueError: ``level`` is out of range.

    >>> CVaR(level=0.5)(torch.tensor([[[4.0, 1.0, 2.0, 3.0]]]))
    tensor([[3.5000]])
    """

    level: float = 0.9

    def __post_init__(self):
        if not 0 <= self.level < 1:
            raise ValueError(f"level must be in [0, 1), got {self.level}.")

    def __call__(self, values: Tensor) -> Tensor:
        count = values.shape[-1]
        upper = torch.arange(1, count + 1, device=values.device, dtype=values.dtype) / count
        weight = (upper - self.level).clamp(0.0, 1.0 / count) / (1.0 - self.level)
        return (values.sort(-1).values * weight).sum(-1, keepdim=True).amax(0)
