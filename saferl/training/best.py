"""The best policy of a run so far, beside its newest checkpoint."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from torch import Tensor
from torchrl.objectives import LossModule

from saferl.checkpoint.policy import write_policy
from saferl.evaluation.costs import by_name, limits, names

log = logging.getLogger(__name__)

#: Its folder in the run's.
BEST = "best"
#: Fewer episodes say too little.
LEAST = 50


class BestPolicy:
    """Keeps the policy whose last training episodes were the best as ``RUN/best/policy.safetensors``.

    Better is whose mean cost is within the limit, if there is one; then what succeeds more often, or, of a task without success,
    returns more. Episodes that ended before the first update do not count; the file says whether the limit is kept (``within``). As training episodes explore, and the best of many means is a lucky one, it is no estimate.

    Args:
        run: folder of the run.
        loss: of the policy.
        cfg: the run's configuration.
        costs: names of the numbers of a cost.
    """

    def __init__(
        self, run: Path, loss: LossModule, cfg: DictConfig, costs: Sequence[str] = ("cost",)
    ):
        self.run, self.loss, self.cfg, self.costs = run, loss, cfg, costs
        self.score: list[float] = []
        self.since = -1

    def state_dict(self) -> dict[str, Any]:
        """How good the kept one is."""
        return {"score": list(self.score), "since": self.since}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.score, self.since = list(state["score"]), state["since"]

    def look(
        self,
        episodes: Mapping[str, Tensor],
        counted: Mapping[str, int],
        check: Callable[[], None],
    ) -> None:
        """Keep the policy as it is now, if it is better.

        Args:
            episodes: of the last training episodes ``return``, ``cost_return`` and outcomes, [n] each, or [n, K] of several
                costs.
            counted: frames, episodes and updates so far.
            check: raises where something that is learned is not finite.
        """
        if not counted["updates"] or not episodes:
            return
        if self.since < 0:  # what came before was not learned
            self.since = counted["episodes"]
        count = min(counted["episodes"] - self.since, len(episodes["return"]))
        if count < LEAST:
            return
        figures = by_name(episodes, self.costs)
        means = {name: float(value[-count:].double().mean()) for name, value in figures.items()}
        if not all(map(math.isfinite, means.values())):
            return
        paid = {name: means[name] for name in names("cost_return", self.costs)}
        allowed = limits(self.cfg.cost_limit, self.costs)
        within = all(
            limit is None or cost <= limit
            for cost, limit in zip(paid.values(), allowed, strict=True)
        )
        score = [float(within), means.get("success", means["return"])]
        if self.score and score <= self.score:
            return
        check()
        self.score = score
        about = {"return": means["return"], **paid, "within": within}
        write_policy(self.run / BEST, self.loss.state_dict(), self.cfg, {**counted, **about})
