"""The linear-quadratic problems state their optimum."""

from __future__ import annotations

import numpy as np
import pytest
from lqr import LQR, PROBLEMS


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_optimum_is_what_the_environment_pays(name: str):
    """Steps of the environment, actions kept within their bounds."""
    env, limit = LQR(**PROBLEMS[name].matrices), PROBLEMS[name].limit
    best, multiplier = env.optimum(limit)
    gains = env.gains(multiplier)
    totals = []
    for seed in range(1500):
        x, total = env.reset(seed=seed)[0], np.zeros(2)
        for gain in gains:
            x, reward, _, _, info = env.step(np.clip(-gain @ x, -1.0, 1.0))
            total += reward, info["cost"]
        totals.append(total)
    mean, error = np.mean(totals, 0), np.std(totals, 0) / len(totals) ** 0.5
    assert (np.abs(mean - [best, limit]) < 4 * error).all()


@pytest.mark.parametrize("name", PROBLEMS)
def test_no_other_linear_policy_is_better(name: str):
    """For the reward less the multiplier times the cost, gains are moved at random."""
    env = LQR(**PROBLEMS[name].matrices)
    _, multiplier = env.optimum(PROBLEMS[name].limit)
    gains, draw = env.gains(multiplier), np.random.default_rng(0)

    def worth(policy) -> float:
        reward, cost = env.sums(policy)
        return reward - multiplier * cost

    for _ in range(50):
        moved = [gain + 0.05 * draw.normal(size=gain.shape) for gain in gains]
        assert worth(moved) < worth(gains)


def test_bounds_that_do_not_bind_change_nothing():
    """Played episodes come to the sums of the recursion; where bounds bind, to a smaller return."""
    wide, narrow = (LQR(**PROBLEMS[name].matrices) for name in ("Distance", "Effort"))
    gains = wide.gains(wide.optimum(PROBLEMS["Distance"].limit)[1])
    assert wide.played(gains) == pytest.approx(wide.sums(gains), rel=0.02)
    gains = narrow.gains(narrow.optimum(PROBLEMS["Effort"].limit)[1])
    assert narrow.played(gains)[0] < 1.1 * narrow.sums(gains)[0]
