"""Trials of a search, one training each, and what optuna is told of them."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import optuna
from optuna.trial import FrozenTrial, TrialState
from tensordict import TensorDictBase

from saferl.algorithms.assemble import build_agent, complete
from saferl.checkpoint.lock import alone
from saferl.cli.errors import MISTAKES, explain
from saferl.cli.settings import command, compose
from saferl.cli.train import train_into
from saferl.config.check import check
from saferl.config.limits import check_limits
from saferl.config.space import Dimension
from saferl.evaluation.compare import TESTED, finished, side_by_side
from saferl.evaluation.costs import limits, names
from saferl.training.trainer import Trainer

log = logging.getLogger(__name__)

#: How often a trial is looked at while it trains; the first quarter is never cut short.
LOOKS = 20
#: Below every return that keeps the limit.
_OVER = 1e12


def judged(figures: Mapping[str, float]) -> float:
    """What a trial is to have much of: success, or of a task without success, return.

    >>> judged({"success_rate": 0.9, "return": 80.0}), judged({"return": -1.5})
    (0.9, -1.5)
    """
    return figures.get("success_rate", figures["return"])


def beyond(figures: Mapping[str, float], limit: Any, costs: Sequence[str]) -> dict[str, float]:
    """By how much the mean of each cost that has a limit exceeds it, by the figure's name; not above 0 where it is kept.

    >>> beyond({"cost_return": 0.5}, 0.25, ["cost"]), beyond({"cost_return": 0.3}, None, ["cost"])
    ({'cost_return': 0.25}, {})
    """
    each = zip(names("cost_return", costs), limits(limit, costs), strict=True)
    return {name: figures[name] - most for name, most in each if most is not None}


def rank(figures: Mapping[str, float], excess: Mapping[str, float]) -> float:
    """One number for the pruner: within the limits :func:`judged`, else below all of these, and the lower the more it costs.

    >>> rank({"return": -9.0}, {"cost_return": -0.1}) > rank({"return": 5.0}, {"cost_return": 0.1})
    True
    """
    most = max(excess.values(), default=0.0)
    return judged(figures) if most <= 0 else -_OVER * (1.0 + most)


class Search:
    """A search that can be interrupted at any moment, in a folder of its own.

    Args:
        out: the folder; gets ``study.db``, which optuna's own tools open, and ``trial_0000``, ..., each a run.
        fixed: settings of all trials.
        space: what is searched.
        seed: of the sampler.

    Raises:
        ValueError: the folder holds another search, or a trial's settings do not go together.
    """

    def __init__(self, out: Path, fixed: list[str], space: list[Dimension], seed: int):
        self.out, self.fixed, self.space = out, fixed, space
        for dimension in space:
            for end in dimension.ends:
                values = {each.key: each.ends[0] for each in space} | {dimension.key: end}
                overrides = self.overrides(values)
                cfg = compose(overrides)
                check_limits(cfg, overrides, complete(cfg.task).costs)
                check(cfg)
                build_agent(cfg)
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        fresh = not out.exists()
        out.mkdir(parents=True, exist_ok=True)
        asked = json.dumps([fixed, [repr(each) for each in space]])
        self.study = optuna.create_study(
            storage=f"sqlite:///{out / 'study.db'}",
            study_name="saferl",
            direction="maximize",
            load_if_exists=True,
            pruner=optuna.pruners.MedianPruner(n_startup_trials=5, n_warmup_steps=LOOKS // 4),
        )
        if fresh or not self.study.user_attrs:
            self.study.set_user_attr("asked", asked)
        if self.study.user_attrs["asked"] != asked:
            raise ValueError(
                f"--out: {out} holds a search with other settings; take another folder."
            )
        # Another seed for each trial, so that a search that goes on does not try the same again.
        self.study.sampler = optuna.samplers.TPESampler(seed=seed + len(self.study.trials))

    def overrides(self, values: Mapping[str, Any]) -> list[str]:
        """A trial's command line."""
        return [*self.fixed, *(f"{key}={value}" for key, value in values.items())]

    def run(self, trials: int, seeds: int) -> None:
        """Train until there are so many trials, then print the best."""
        with alone(self.out, "--out"):
            while (trial := self._next(trials)) is not None:
                self._train(trial)
            best = self.best()
            print(self.table(best))
            if not best or best[0].state is not TrialState.COMPLETE:
                raise ValueError(f"no trial was finished; see {self.out}/trial_*.")
            chosen = self.overrides(best[0].params)
            print(f"\n{command(chosen)}")
            first = compose(chosen).seed
            for seed in range(first + 1, first + 1 + seeds):
                again = [*(o for o in chosen if not o.startswith("seed=")), f"seed={seed}"]
                train_into(self.out / "best" / f"seed_{seed}", compose(again), again)
            if seeds:
                print(f"\n{side_by_side(finished([self.out / 'best']))}")

    def _next(self, trials: int) -> optuna.Trial | None:
        """The trial that was interrupted, or a new one; None where there are enough."""
        there = self.study.get_trials(deepcopy=False)
        for each in there:
            if each.state is TrialState.RUNNING:
                return optuna.Trial(self.study, each._trial_id)
        return self.study.ask() if len(there) < trials else None

    def _suggest(self, trial: optuna.Trial, each: Dimension) -> Any:
        if each.choices:
            return trial.suggest_categorical(each.key, each.choices)
        if isinstance(each.low, int):
            step = each.step or 1
            return trial.suggest_int(each.key, each.low, each.high, log=each.log, step=step)
        return trial.suggest_float(each.key, each.low, each.high, log=each.log, step=each.step)

    def _train(self, trial: optuna.Trial) -> None:
        """Train and test with what the sampler suggests, and tell it how that went."""
        values = {each.key: self._suggest(trial, each) for each in self.space}
        overrides = self.overrides(values)
        cfg, run = compose(overrides), self.out / f"trial_{trial.number:04d}"
        log.info("\nTrial %d: %s", trial.number, _shown(values))
        try:
            train_into(run, cfg, overrides, prepare=lambda trainer: self._watch(trainer, trial))
        except optuna.TrialPruned:
            log.info("Trial %d is cut short: half of the others were better by then.", trial.number)
            self.study.tell(trial, state=TrialState.PRUNED)
            return
        except OSError:  # a full disk is no fault of the trial, which goes on with the same command
            raise
        except MISTAKES as error:  # it diverged, perhaps; the others go on
            log.info("Trial %d failed: %s", trial.number, explain(error))
            trial.set_user_attr("error", explain(error))
            self.study.tell(trial, state=TrialState.FAIL)
            return
        told = json.loads((run / TESTED).read_text(encoding="utf-8"))
        figures = {k: v["mean"] for k, v in told.items() if isinstance(v, dict) and "mean" in v}
        self._limit(trial, figures, cfg.cost_limit, complete(cfg.task).costs)
        self.study.tell(trial, judged(figures))

    def _limit(
        self, trial: optuna.Trial, figures: Mapping[str, float], limit: Any, costs: Sequence[str]
    ) -> None:
        """Tell optuna at the end of a trial whether its costs keep their limits: it prefers every trial whose do."""
        trial.set_user_attr("cost", [figures[name] for name in names("cost_return", costs)])
        for name, value in beyond(figures, limit, costs).items():
            trial.set_constraint(name, value)  # once: optuna takes no other value

    def _watch(self, trainer: Trainer, trial: optuna.Trial) -> None:
        """Let the pruner look at the last training episodes now and then."""
        seen = set(self.study.trials[trial.number].intermediate_values)

        def look(finished: TensorDictBase, spent: float) -> None:
            number = math.floor(spent * LOOKS)
            if number in seen or not 0 < number < LOOKS or not trainer.progress.updates:
                return
            figures = trainer.window.summary()
            if not math.isfinite(figures.get("return", math.nan)):
                return
            seen.add(number)
            limit, costs = trainer.watch.limit, trainer.costs
            trial.report(rank(figures, beyond(figures, limit, costs)), number)
            if trial.should_prune():
                self._limit(trial, figures, limit, costs)
                raise optuna.TrialPruned

        trainer.after_collect.append(look)

    def best(self) -> list[FrozenTrial]:
        """All trials, the best first: finished before cut short, within the limit before over it, then by value."""
        over = {True: 1, False: 0}

        def order(trial: FrozenTrial) -> tuple:
            states = [TrialState.COMPLETE, TrialState.PRUNED, TrialState.FAIL]
            excess = max(0.0, *trial.constraints.values(), 0.0)
            return states.index(trial.state), over[excess > 0], excess, -(trial.value or 0.0)

        return sorted(self.study.get_trials(deepcopy=False), key=order)

    def table(self, trials: Sequence[FrozenTrial], most: int = 10) -> str:
        """The first of these trials, one a line."""
        lines = [f"{'trial':>5}  {'value':>8}  {'cost':>8}  {'':<9}  settings"]
        for trial in trials[:most]:
            over = any(value > 0 for value in trial.constraints.values())
            how = {TrialState.PRUNED: "cut short", TrialState.FAIL: "failed"}.get(trial.state)
            how = how or ("over" if over else "")
            value = "" if trial.state is not TrialState.COMPLETE else f"{trial.value:.4g}"
            cost = " ".join(f"{each:.4g}" for each in trial.user_attrs.get("cost", ()))
            lines.append(
                f"{trial.number:>5}  {value:>8}  {cost:>8}  {how:<9}  {_shown(trial.params)}"
            )
        return "\n".join(lines)


def _shown(values: Mapping[str, Any]) -> str:
    return " ".join(
        f"{key}={value:.4g}" if isinstance(value, float) else f"{key}={value}"
        for key, value in values.items()
    )
