"""What was measured of each system: a composition over its seeds, or a scripted driver over the same tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from saferl.evaluation.statistics import as_sure_as, within
from saferl.report.resampling import Estimate, improvement, interquartile_mean, resample
from saferl.report.runs import FIGURES, FINISHED, TASKS, Run

#: The tasks of the tables; the last one is the mean of the others that there are.
CONDITIONS = (*TASKS, "mean")
#: What the paper calls them. Others go by their own name.
LABELS = {
    "scripted": "cautious driver",
    "blind": "blind driver",
    "cpo": "CPO",
    "ppo_rs": "PPO-RS",
    "sac_rs": "SAC-RS",
    "sac_lag": "SAC-Lag",
    "sac": "SAC",
    "rsac": "RSAC",
    "asac": "ASAC",
    "arsac_unprojected": "ARSAC unprojected",
    "arsac": "ARSAC",
}


@dataclass(frozen=True)
class Cell:
    """One figure of one system in one task.

    Attributes:
        mean, std: over seeds; std is None for a single one.
        low, high: 95%, over seeds and episodes; of a single seed over its episodes.
    """

    mean: float
    std: float | None
    low: float
    high: float


@dataclass(frozen=True)
class System:
    """A system and its tests.

    Attributes:
        name: its ``algo_name``, or the driver's.
        tests: of each of S seeds the figures [episodes, 5] of each of :data:`TASKS`; a driver's seeds are one sample.
        seeds: of its tests.
        frames, updates, minutes: of a training, means over seeds; None for drivers.
        shaped: whether the rewards of its training hold r_safe.
    """

    name: str
    tests: Sequence[Sequence[np.ndarray]]
    seeds: Sequence[int]
    frames: float | None = None
    updates: float | None = None
    minutes: float | None = None
    shaped: bool = False

    @property
    def label(self) -> str:
        return LABELS.get(self.name, self.name)

    @property
    def trained(self) -> bool:
        return self.frames is not None

    @cached_property
    def means(self) -> np.ndarray:
        """[S, 4, 5]: of each seed, in each of :data:`CONDITIONS`, each of :data:`FIGURES`; NaN for a task without episodes."""
        nothing = np.full(len(FIGURES), np.nan)
        tests = [[task.mean(0) if len(task) else nothing for task in test] for test in self.tests]
        return _with_mean(np.array(tests))

    @cached_property
    def resampled(self) -> np.ndarray:
        """[R, S, 4, 5]: the same with other seeds and episodes, the same ones each time."""
        # A stream of its own: two systems of as many seeds would else draw alike.
        rng = np.random.default_rng([0, *self.name.encode()])
        return _with_mean(resample(self.tests, rng))

    def estimate(self, condition: str, figure: str) -> Estimate | None:
        """The mean over seeds; None where nothing was tested."""
        means, resampled = self._of(condition, figure)
        return None if np.isnan(means).any() else Estimate.of(means, resampled)

    def cell(self, condition: str, figure: str) -> Cell | None:
        """A table's cell; None where nothing was tested."""
        estimate = self.estimate(condition, figure)
        if estimate is None:
            return None
        means = self._of(condition, figure)[0]
        interval = estimate.interval()
        if figure.endswith("_rate"):
            chosen = range(len(TASKS)) if condition == "mean" else [TASKS.index(condition)]
            episodes = sum(len(test[task]) for test in self.tests for task in chosen)
            interval = as_sure_as(estimate.value, episodes, interval)
        low, high = within(figure, interval, [estimate.value])
        assert low is not None and high is not None
        std = float(means.std(ddof=1)) if len(means) > 1 else None
        return Cell(estimate.value, std, low, high)

    def interquartile_mean(self, figure: str) -> float:
        """Over seeds, in the mean of the tasks."""
        return interquartile_mean(self._of("mean", figure)[0])

    def improvement(self, other: System, figure: str, lower: bool) -> tuple[float, float, float]:
        """Probability that a seed of this system is better than one of another, in the mean of the tasks, with its 95% interval.

        Args:
            other: system.
            figure: by which.
            lower: whether less of it is better.
        """
        (mine, again), (others, others_again) = self._of("mean", figure), other._of("mean", figure)
        if lower:
            return improvement(-mine, -others, -again, -others_again)
        return improvement(mine, others, again, others_again)

    def _of(self, condition: str, figure: str) -> tuple[np.ndarray, np.ndarray]:
        place = CONDITIONS.index(condition), FIGURES.index(figure)
        return self.means[:, *place], self.resampled[:, :, *place]


def _with_mean(tasks: np.ndarray) -> np.ndarray:
    """[..., 3, 5] with the mean of the tasks that there are behind them."""
    there = ~np.isnan(tasks).any(axis=(*range(tasks.ndim - 2), -1))
    return np.concatenate([tasks, tasks[..., there, :].mean(-2, keepdims=True)], -2)


def gather(runs: Sequence[Run]) -> list[System]:
    """The systems of all finished runs, in the order of :data:`LABELS`."""
    groups: dict[str, list[Run]] = {}
    for run in runs:
        if run.state == FINISHED:
            groups.setdefault(run.algo, []).append(run)
    order = [*LABELS, *groups]
    return [_system(name, groups[name]) for name in sorted(groups, key=order.index)]


def _system(name: str, runs: Sequence[Run]) -> System:
    spent = [_spent(run.timing) for run in runs]
    means = {key: float(np.mean([each[key] for each in spent])) for key in spent[0]}
    return System(
        name,
        [run.test for run in runs],
        [run.seed for run in runs],
        **means,
        shaped=bool(runs[0].settings.get("task.reward.risk_shaping")),
    )


def _spent(timing: Mapping[str, np.ndarray]) -> dict[str, float]:
    """What a training took, from the last row of its ``timing.csv``: counts, and seconds of each of its phases."""
    last = {key: float(column[-1]) for key, column in timing.items()}
    counted = {key: last.pop(key, np.nan) for key in ("frames", "updates")}
    return counted | {"minutes": sum(last.values()) / 60}
