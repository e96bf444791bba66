"""What becomes of the limit on the mean cost of an episode while a run learns."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

from torch import Tensor

from saferl.evaluation.costs import limits, names
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
        name: what the limit is called.
    """

    def __init__(self, limit: Any = None, window: int = 200, name: str = "cost_limit"):
        self.limit, self.window, self.name = limit, window, name
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
                "%s=%g has limited nothing so far: no episode cost more than %.4g.",
                self.name,
                self.limit,
                self.dearest,
            )
        kept = self.bound and mean <= self.limit and len(costs) >= self.window
        if kept and self.first("met"):
            log.info(
                "%s=%g is met at frame %d: the last %d episodes cost %.4g in the mean.",
                self.name,
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
        said = verdict(mean, low, self.limit, self.name)
        if not self.bound:
            said = f"{self.name}={self.limit:g} never bound, no episode cost as much"
        well = self.bound and not (low is not None and low > self.limit)
        log.log(
            logging.INFO if well else logging.WARNING,
            "In training %s: the last %d episodes cost %.4g %s.",
            said,
            len(costs),
            mean,
            span(low, high, ".4g"),
        )


class CostWatches(CostWatch):
    """A watch of each of several limits.

    Args:
        limit: of each cost; None: there is none.
        costs: their names.
        window: of how many episodes the means count.
    """

    def __init__(self, limit: Sequence[float] | None, costs: Sequence[str], window: int = 200):
        super().__init__(limit, window)
        numbered = zip(limits(limit, costs), names("cost_limit", costs, "."), strict=True)
        self.each = [CostWatch(one, window, name) for one, name in numbered]

    def state_dict(self) -> dict[str, Any]:
        return {"said": [*self.said], "each": [watch.state_dict() for watch in self.each]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.said = [*state["said"]]
        for watch, own in zip(self.each, state["each"], strict=True):
            watch.load_state_dict(own)

    def take(self, costs: Tensor) -> None:
        for watch, own in self._of(costs):
            watch.take(own)

    def look(self, costs: Tensor | None, frames: int, spent: float) -> None:
        for watch, own in self._of(costs):
            watch.look(own, frames, spent)

    def judge(self, costs: Tensor | None) -> None:
        for watch, own in self._of(costs):
            watch.judge(own)

    def _of(self, costs: Tensor | None) -> list[tuple[CostWatch, Tensor]]:
        """Each watch and the costs [n] that it is of, of costs [n, K]."""
        return [] if costs is None else [*zip(self.each, costs.unbind(-1), strict=True)]


def watch_of(limit: Any, costs: Sequence[str]) -> CostWatch:
    """The watch of a limit on one cost, or of those on several.

    >>> watch_of(0.1, ["cost"]).name, len(watch_of([0.1, 0.2], ["road", "speed"]).each)
    ('cost_limit', 2)
    """
    return CostWatch(limit) if len(costs) == 1 else CostWatches(limit, costs)
