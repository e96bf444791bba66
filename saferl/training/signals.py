"""What a trainer calls besides the learner: multipliers' signals and the projector's progress."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from tensordict import TensorDictBase

from saferl.evaluation.costs import names
from saferl.modules import LagrangeMultiplier
from saferl.modules.limits import as_limit
from saferl.objectives.checks import check_limit
from saferl.training.limit import EARLY
from saferl.training.trainer import Trainer

log = logging.getLogger(__name__)


@runtime_checkable
class Signal(Protocol):
    """What moves a multiplier: it hangs itself into a trainer."""

    def register(self, trainer: Trainer) -> None: ...


class CriticSignal:
    """Dual ascent on the risk above its limit in the states of each update's batch (E11).

    Args:
        risk_limit: d_thres, which the loss has, too; of several costs one for each.
    """

    def __init__(self, risk_limit: float | Sequence[float]):
        self.risk_limit = check_limit("risk_limit", risk_limit)

    def register(self, trainer: Trainer) -> None:
        self._lagrange, self._trainer = _multiplier(trainer), trainer
        if "constraint_violation" not in trainer.learner.loss.out_keys:
            raise ValueError(
                f"lagrange.signal=CriticSignal needs Q_c(s, a), which {type(trainer.learner.loss).__name__} "
                "has not; use lagrange=episode."
            )
        loss: Any = trainer.learner.loss
        ours, own = (
            [f"{each:g}" for each in limit.reshape(-1).tolist()]
            for limit in (self.risk_limit, loss.risk_limit)
        )
        if ours != own:
            raise ValueError(
                f"loss.risk_limit must be lagrange.signal.risk_limit, got {', '.join(own)} and {', '.join(ours)}; "
                "set risk_limit."
            )
        self._begin = self._lagrange.value.clone()
        trainer.learner.after_update.append(self._update)
        trainer.after_collect.append(self._watch)

    def _update(self, losses: TensorDictBase) -> None:
        self._lagrange.update(losses["constraint_violation"])

    def _watch(self, finished: TensorDictBase, spent: float) -> None:
        """Say once that a limit limits nothing."""
        if not (spent >= EARLY and self._trainer.progress.updates):
            return
        if not self._trainer.watch.first("risk"):
            return
        idle = (self._lagrange.value <= self._begin).reshape(-1).tolist()
        numbers = zip(
            names("risk_limit", self._trainer.costs, "."),
            self.risk_limit.expand(self._lagrange.count).tolist(),
            self._lagrange.value.reshape(-1).tolist(),
            strict=True,
        )
        for which, at_rest in zip(numbers, idle, strict=True):
            if at_rest:
                log.warning(
                    "%s=%g has limited nothing so far: the multiplier, %.4g, has not risen.", *which
                )


class EpisodeSignal:
    """Dual ascent on the mean cost of fresh episodes, each used once.

    Args:
        cost_limit: mean cost of an episode, undiscounted; of several costs one for each.
        relative: whether the violation is a share of the limit (of the mean cost where that is larger) and time a share
            of the budget, so that one rate serves every task and every budget; else the violation is in the unit of the
            cost, and every batch in which episodes end is a unit of time.

    Raises:
        ValueError: a negative limit, or one of another number of costs than the multiplier's.
    """

    def __init__(self, cost_limit: float | Sequence[float], relative: bool = True):
        self.cost_limit, self.relative = check_limit("cost_limit", cost_limit), relative

    def register(self, trainer: Trainer) -> None:
        self._lagrange, self._trainer = _multiplier(trainer), trainer
        if getattr(trainer.learner.loss, "cost_backup", "sum") != "sum":
            raise ValueError(
                "lagrange.signal=EpisodeSignal limits the summed cost of an episode, which cost_backup=reach does "
                "not learn: set cost_backup=sum, or lagrange=statewise."
            )
        as_limit("cost_limit", self.cost_limit, self._lagrange.count)
        trainer.after_collect.append(self._update)

    def _update(self, finished: TensorDictBase, spent: float) -> None:
        if not len(finished):
            return
        costs, limit, elapsed = finished["cost_return"], self.cost_limit, 1.0
        violation = costs - limit.to(costs.device)
        if self.relative:
            mean = self._trainer.window.values["cost_return"].mean(0).abs().to(limit)
            scale = torch.maximum(limit, mean)
            violation = violation / torch.where(scale > 0, scale, 1.0).to(costs.device)
            progress, budget = self._trainer.progress, self._trainer.budget
            elapsed = (budget.done(progress) - progress.last_end) / budget.whole
        self._lagrange.update(self._lagrange.penalty(violation), elapsed)


def _multiplier(trainer: Trainer) -> LagrangeMultiplier:
    loss = trainer.learner.loss
    multiplier = getattr(loss, "lagrange", None)
    if not isinstance(multiplier, LagrangeMultiplier):
        raise ValueError(
            "lagrange.signal needs a loss with a multiplier (loss=sac_lag, ppo_lag or ppo_risk), "
            f"got {type(loss).__name__}."
        )
    return multiplier
