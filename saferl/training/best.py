"""The best policy of a run so far, beside its newest checkpoint."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from torch import Tensor
from torchrl.objectives import LossModule

from saferl.checkpoint.policy import write_policy

log = logging.getLogger(__name__)

#: Its folder in the run's.
BEST = "best"
#: Fewer episodes say too little.
LEAST = 50


class BestPolicy:
    """Keeps the policy whose last training episodes were the best as ``RUN/best/policy.safetensors``.

    Better is whose mean cost is within the limit, if there is one; then what succeeds more often, or, of a task without success,
    returns more. As training episodes explore, and the best of many means is a lucky one, it is no estimate.

    Args:
        run: folder of the run.
        loss: of the policy.
        cfg: the run's configuration.
    """

    def __init__(self, run: Path, loss: LossModule, cfg: DictConfig):
        self.run, self.loss, self.cfg = run, loss, cfg
        self.score: list[float] = []

    def state_dict(self) -> dict[str, Any]:
        """How good the kept one is."""
        return {"score": list(self.score)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.score = list(state["score"])

    def look(
        self,
        episodes: Mapping[str, Tensor],
        counted: Mapping[str, int],
        check: Callable[[], None],
    ) -> None:
        """Keep the policy as it is now, if it is better.

        Args:
            episodes: of the last training episodes ``return``, ``cost_return`` and outcomes, [n] each.
            counted: frames and episodes so far.
            check: raises where something that is learned is not finite.
        """
        if not episodes or len(episodes["return"]) < LEAST:
            return
        means = {name: float(value.double().mean()) for name, value in episodes.items()}
        limit = self.cfg.cost_limit
        within = limit is None or means["cost_return"] <= limit
        score = [float(within), means.get("success", means["return"])]
        if self.score and score <= self.score:
            return
        check()
        self.score = score
        about = {"return": means["return"], "cost_return": means["cost_return"]}
        write_policy(self.run / BEST, self.loss.state_dict(), self.cfg, {**counted, **about})
