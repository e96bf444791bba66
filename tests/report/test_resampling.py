"""The bootstrap against closed forms, scipy's, and the truth that its intervals should cover."""

from __future__ import annotations

import numpy as np
import pytest
from made import drawn
from scipy import stats

from saferl.evaluation.statistics import mean_interval, wilson
from saferl.report.resampling import Estimate, improvement, interquartile_mean, resample


def estimate(tests, rng: np.random.Generator, count: int = 4000) -> Estimate:
    means = np.array([test[0].mean() for test in tests])
    return Estimate.of(means, resample(tests, rng, count)[..., 0, 0])


def test_where_episodes_agree_it_is_scipys_bootstrap_of_seeds():
    values = np.random.default_rng(0).exponential(size=12)
    tests = [[np.full((3, 1), value)] for value in values]
    mine = resample(tests, np.random.default_rng(1), 40_000)[..., 0, 0].mean(1)
    theirs = stats.bootstrap(
        (values,), np.mean, n_resamples=40_000, method="percentile", rng=np.random.default_rng(2)
    )
    ours = np.quantile(mine, [0.025, 0.975])
    assert ours == pytest.approx(list(theirs.confidence_interval), abs=0.01)
    assert mine.std() == pytest.approx(theirs.standard_error, rel=0.02)


def test_of_one_seed_it_is_scipys_bootstrap_of_episodes():
    values = np.random.default_rng(0).exponential(size=40)
    only = estimate([[values[:, None]]], np.random.default_rng(1), 40_000)
    theirs = stats.bootstrap(
        (values,), np.mean, n_resamples=40_000, method="percentile", rng=np.random.default_rng(2)
    )
    assert only.freedom == np.inf
    assert only.interval() == pytest.approx(tuple(theirs.confidence_interval), abs=0.01)


def test_the_variance_is_that_of_seeds_and_that_of_episodes():
    """var = s^2 / S + sum of var_s / n / S / (S - 1): what S seeds spread, unbiased, and the episodes of each."""
    rng = np.random.default_rng(0)
    tests = drawn(5, 20, rng, between=0.2, mean=0.0)
    means = np.array([test[0].mean() for test in tests])
    within = np.mean([test[0].var() / 20 for test in tests])
    expected = means.var(ddof=1) / 5 + within / 4
    found = estimate(tests, rng, 40_000)
    assert found.value == pytest.approx(means.mean())
    assert found.deviations.var() == pytest.approx(expected, rel=0.03)


def test_with_many_seeds_that_hardly_spread_within_it_is_students_interval():
    values = np.random.default_rng(0).normal(size=20)
    tests = [[np.full((2, 1), value)] for value in values]
    found = estimate(tests, np.random.default_rng(1), 40_000)
    assert found.freedom == pytest.approx(19, rel=0.05)
    low, high = mean_interval(values.tolist())
    assert found.interval() == pytest.approx((low, high), abs=0.05)


def test_tasks_and_figures_are_kept_apart_and_a_task_without_episodes_is_nan():
    test = [np.array([[1.0, 10.0]] * 3), np.empty((0, 2)), np.array([[2.0, 20.0]] * 5)]
    means = resample([test, test], np.random.default_rng(0), 10)
    assert means.shape == (10, 2, 3, 2)
    assert np.isnan(means[:, :, 1]).all()
    assert (means[:, :, 0] == [1.0, 10.0]).all() and (means[:, :, 2] == [2.0, 20.0]).all()


@pytest.mark.parametrize("between", [0.0, 0.05, 1.0])
def test_its_intervals_cover_the_truth(between: float):
    """Of 150 studies of five seeds at least 138 should; 95% are 142.5, less two standard deviations of 2.7."""
    rng = np.random.default_rng(7)
    covered = apart = improved = 0
    for _ in range(150):
        tests = [drawn(5, 100, rng, between, mean) for mean in (1.0, 3.0)]
        means = [np.array([each[0].mean() for each in test]) for test in tests]
        again = [resample(test, rng, 400)[..., 0, 0] for test in tests]
        mine, other = (Estimate.of(*pair) for pair in zip(means, again, strict=True))
        low, high = mine.interval()
        covered += low <= 1.0 <= high
        low, high = (mine - other).interval()
        apart += low <= -2.0 <= high
        # A seed of the one is above another of the same but for 2 by Phi(2 / spread).
        truth = stats.norm.cdf(-2 / np.sqrt(2 * (between**2 + 0.01)))
        _, low, high = improvement(*means, *again)
        improved += low <= truth <= high
    assert min(covered, apart, improved) >= 137


def test_it_says_no_more_of_two_than_their_seeds_do():
    """Welch: 5 and 20 seeds have fewer degrees of freedom than 23, and more than 4."""
    rng = np.random.default_rng(3)
    few, many = (estimate(drawn(count, 2, rng, 10.0, 0.0), rng) for count in (5, 20))
    both = few - many
    assert both.value == few.value - many.value
    assert 4 <= both.freedom <= 23
    assert both.deviations.std() == pytest.approx(
        np.hypot(few.deviations.std(), many.deviations.std()), rel=0.05
    )


def test_the_probability_of_improvement_is_mann_whitneys_u():
    rng = np.random.default_rng(0)
    for _ in range(20):
        mine, other = rng.integers(6, size=5) * 1.0, rng.integers(6, size=4) * 1.0
        value, low, high = improvement(mine, other, mine[None], other[None])
        u = stats.mannwhitneyu(mine, other).statistic
        assert value == pytest.approx(u / 20)
        assert 0 <= low <= value <= high <= 1


def test_seeds_that_lie_apart_do_not_make_it_certain():
    mine, other = np.arange(5.0) + 10, np.arange(5.0)
    value, low, high = improvement(mine, other, mine[None], other[None])
    assert (value, low, high) == pytest.approx((1.0, wilson(5, 5)[0], 1.0))


def test_the_interquartile_mean_by_hand():
    assert interquartile_mean(np.array([9.0, 1.0, 2.0, 3.0, -50.0])) == 2.0  # of five, three
    assert interquartile_mean(np.array([4.0, 5.0])) == 4.5
