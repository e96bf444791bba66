"""What becomes of the limit on the mean cost of an episode while a run learns."""

from __future__ import annotations

import logging
from typing import Any

from torch import Tensor

from saferl.evaluation.statistics import mean_interval, span, verdict

log = logging.getLogger(__name__)

#: The share of a budget after which a limit that nothing came up to is spoken of.
EARLY = 0.1


class CostWatch:
    """Says when a limit is met, that it limits nothing, and at the end whether it is kept; once each, however often a run
    is resumed.

    Args:
        limit: ``cost_limit``, undiscounted; None: there is none, and nothing is said.
        window: of how many episodes the mean counts.
    """

    def __init__(self, limit: float | None = None, window: int = 200):
        self.limit, self.window = limit, window
        self.dearest, self.bound = 0.0, False
        self.said: list[str] = []

    def state_dict(self) -> dict[str, Any]:
        """What was seen and said so far."""
        return {"dearest": self.dearest, "bound": self.bound, "said": [*self.said]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)

    def first(self, what: str) -> bool:
        """Whether a run comes to say something for the first time.

        >>> watch = CostWatch()
        >>> watch.first("it is met"), watch.first("it is met")
        (True, False)
        """
        if what in self.said:
            return False
        self.said.append(what)
        return True

    def take(self, costs: Tensor) -> None:
        """Take the costs [n] of the episodes that have just ended."""
        if self.limit is not None:
            self.dearest = max(self.dearest, float(costs.max()))
            self.bound = self.bound or self.dearest >= self.limit

    def look(self, costs: Tensor | None, frames: int, spent: float) -> None:
        """Say what is to be said of the costs [n] of the last episodes of training.

        Args:
            costs: None before the first.
            frames: how far the run is.
            spent: share of its budget.
        """
        if self.limit is None or costs is None or not len(costs):
            return
        mean = float(costs.mean())
        if not self.bound and spent >= EARLY and self.first("idle"):
            log.warning(
                "cost_limit=%g has limited nothing so far: no episode cost more than %.4g.",
                self.limit,
                self.dearest,
            )
        kept = self.bound and mean <= self.limit and len(costs) >= self.window
        if kept and self.first("met"):
            log.info(
                "cost_limit=%g is met at frame %d: the last %d episodes cost %.4g in the mean.",
                self.limit,
                frames,
                len(costs),
                mean,
            )

    def judge(self, costs: Tensor | None) -> None:
        """Say at the end what became of the limit in training, where a policy explores."""
        if self.limit is None or costs is None or not len(costs):
            return
        mean, (low, high) = float(costs.mean()), mean_interval(costs.tolist())
        said = verdict(mean, low, self.limit)
        if not self.bound:
            said = f"cost_limit={self.limit:g} never bound, no episode cost as much"
        well = self.bound and not (low is not None and low > self.limit)
        log.log(
            logging.INFO if well else logging.WARNING,
            "In training %s: the last %d episodes cost %.4g %s.",
            said,
            len(costs),
            mean,
            span(low, high, ".4g"),
        )
