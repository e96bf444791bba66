"""What a trainer calls besides the learner: multipliers' signals and the projector's progress."""

from __future__ import annotations

from tensordict import TensorDictBase

from saferl.envs.transforms import SafetyProjector
from saferl.modules import LagrangeMultiplier
from saferl.training.trainer import Trainer


class CriticSignal:
    """Dual ascent on Q_c(s, a) - d_thres of each update's batch (E11)."""

    def register(self, trainer: Trainer) -> None:
        self._lagrange = _multiplier(trainer)
        if "constraint_violation" not in trainer.learner.loss.out_keys:
            raise ValueError(
                f"lagrange.signal=CriticSignal needs Q_c(s, a), which {type(trainer.learner.loss).__name__} "
                "has not; use lagrange=episode."
            )
        trainer.learner.after_update.append(self._update)

    def _update(self, losses: TensorDictBase) -> None:
        self._lagrange.update(losses["constraint_violation"])


def episode_budget(cost_limit: float, gamma: float, horizon: float) -> float:
    """The mean undiscounted cost b of an episode whose discounted form is ``cost_limit`` d.

    Cost spread evenly over T decisions: d = b (1 - gamma^T) / ((1 - gamma) T).

    Args:
        cost_limit: d_thres.
        gamma: discount in [0, 1].
        horizon: T, decisions of an episode.

    >>> round(episode_budget(0.05, gamma=0.99, horizon=125), 4)
    0.0874
    """
    weight = horizon if gamma == 1.0 else (1.0 - gamma**horizon) / (1.0 - gamma)
    return cost_limit * horizon / weight


class EpisodeSignal:
    """Dual ascent on the mean undiscounted cost of fresh episodes, each used once.

    Args:
        cost_limit: mean episode cost, undiscounted; see :func:`episode_budget`.

    Raises:
        ValueError: a negative limit.
    """

    def __init__(self, cost_limit: float):
        if not cost_limit >= 0:
            raise ValueError(f"cost_limit must be >= 0, got {cost_limit}.")
        self.cost_limit = cost_limit

    def register(self, trainer: Trainer) -> None:
        self._lagrange = _multiplier(trainer)
        if getattr(trainer.learner.loss, "cost_backup", "sum") != "sum":
            raise ValueError(
                "lagrange.signal=EpisodeSignal limits the summed cost of an episode, which cost_backup=reach does "
                "not learn: set cost_backup=sum, or lagrange=statewise."
            )
        trainer.after_collect.append(self._update)

    def _update(self, finished: TensorDictBase, spent: float) -> None:
        if len(finished):
            violation = finished["cost_return"] - self.cost_limit
            self._lagrange.update(self._lagrange.penalty(violation))


class ProjectorProgress:
    """Tells a projector which share of the budget is spent, so that it can begin later.

    Args:
        projector: the environment's transform.
    """

    def __init__(self, projector: SafetyProjector):
        self.projector = projector

    def register(self, trainer: Trainer) -> None:
        trainer.after_collect.append(lambda _, spent: self.projector.set_progress(spent))


def _multiplier(trainer: Trainer) -> LagrangeMultiplier:
    loss = trainer.learner.loss
    multiplier = getattr(loss, "lagrange", None)
    if not isinstance(multiplier, LagrangeMultiplier):
        raise ValueError(
            "lagrange.signal needs a loss with a multiplier (loss=sac_lag, ppo_lag or ppo_risk), "
            f"got {type(loss).__name__}."
        )
    return multiplier
