"""What would have been measured with other seeds and other episodes: a bootstrap in two stages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from saferl.evaluation.statistics import as_sure_as

RESAMPLES = 4000


def resample(
    tests: Sequence[Sequence[np.ndarray]], rng: np.random.Generator, count: int = RESAMPLES
) -> np.ndarray:
    """Means of seeds drawn with replacement, each over episodes of its own drawn with replacement, task by task.

    Args:
        tests: of each of S seeds the figures [episodes, F] of each of T tasks, the strata.
        rng: draws.
        count: R, how many times.

    Returns:
        [R, S, T, F]; NaN for a task without episodes.

    >>> test = [np.array([[0.0], [1.0]]), np.array([[3.0], [3.0]])]
    >>> resample([test, test], np.random.default_rng(0), 1000).mean((0, 1)).round(1).tolist()
    [[0.5], [3.0]]
    """
    drawn = rng.integers(len(tests), size=(count, len(tests)))
    tasks, figures = len(tests[0]), tests[0][0].shape[1]
    means = np.full((count, len(tests), tasks, figures), np.nan)
    for seed, test in enumerate(tests):
        slots = drawn == seed
        for task, values in enumerate(test):
            if len(values):
                episodes = rng.integers(
                    len(values), size=(slots.sum(), len(values)), dtype=np.int32
                )
                for figure, column in enumerate(np.ascontiguousarray(values.T)):
                    means[slots, task, figure] = column[episodes].mean(1)
    return means


@dataclass(frozen=True)
class Estimate:
    """A mean over seeds, or the difference of two, and how far off it may be.

    Attributes:
        value: the mean.
        deviations: [R], of the resampled means from it, of the spread of independent seeds.
        freedom: degrees of freedom of that spread; infinite for episodes of one seed.
    """

    value: float
    deviations: np.ndarray
    freedom: float

    @classmethod
    def of(cls, means: np.ndarray, resampled: np.ndarray) -> Estimate:
        """From the means [S] of seeds and the resampled ones [R, S].

        S seeds drawn from S spread less than S new ones by 1 - 1/S, which is undone here. What they spread has S - 1 degrees of
        freedom, what their episodes add to it many (Satterthwaite).
        """
        seeds, value = len(means), float(means.mean())
        deviations = resampled.mean(1) - value
        if seeds == 1:
            return cls(value, deviations, np.inf)
        deviations = deviations * np.sqrt(seeds / (seeds - 1))
        between = means.var(ddof=1) / seeds
        share = between / max(between, deviations.var()) if between else 0.0
        return cls(value, deviations, (seeds - 1) / share**2 if share else np.inf)

    def __sub__(self, other: Estimate) -> Estimate:
        """The difference of two that were resampled apart (Welch)."""
        mine, others = self.deviations.var(), other.deviations.var()
        parts = mine**2 / self.freedom + others**2 / other.freedom
        freedom = (mine + others) ** 2 / parts if parts else np.inf
        return Estimate(self.value - other.value, self.deviations - other.deviations, freedom)

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """The bootstrap's percentiles, as much wider than a normal variable's as Student's t is for so few seeds.

        >>> few = Estimate(1.0, np.random.default_rng(0).normal(size=100_000), freedom=4)
        >>> [round(bound, 1) for bound in few.interval()]
        [-1.8, 3.8]
        """
        tail = (1 + level) / 2
        wider = stats.t.ppf(tail, self.freedom) / stats.norm.ppf(tail)
        low, high = np.quantile(self.deviations, [1 - tail, tail]) * wider
        return self.value + float(low), self.value + float(high)


def interquartile_mean(means: np.ndarray) -> float:
    """Mean of seeds [S] without the lowest and the highest quarter; of a seed on the border counts what lies between.

    >>> interquartile_mean(np.array([0.0, 1.0, 2.0, 90.0])), interquartile_mean(np.array([0.0, 0.0, 90.0]))
    (1.5, 15.0)
    """
    count = len(means)
    edges = np.arange(count + 1).clip(count / 4, 3 * count / 4)
    return float(np.average(np.sort(means), weights=np.diff(edges)))


def improvement(
    means: np.ndarray, others: np.ndarray, resampled: np.ndarray, others_resampled: np.ndarray
) -> tuple[float, float, float]:
    """Probability that a seed of one system lies above a seed of another, a tie being half of it: U / (S S').

    Args:
        means, others: of seeds, [S] and [S'].
        resampled, others_resampled: [R, S] and [R, S'].

    Returns:
        The probability and its 95% interval, never narrower than Wilson's for as many pairs as there are of seeds.

    >>> a, b = np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.5, 2.0])
    >>> round(improvement(a, b, a[None], b[None])[0], 3)
    0.833
    """

    def above(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        apart = np.sign(a[..., :, None] - b[..., None, :])
        return (1 + apart.mean((-2, -1))) / 2

    value = float(above(means, others))
    low, high = np.quantile(above(resampled, others_resampled), [0.025, 0.975])
    low, high = as_sure_as(value, min(len(means), len(others)), (float(low), float(high)))
    assert low is not None and high is not None
    return value, low, high
