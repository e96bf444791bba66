"""The linear-quadratic problems state their optimum."""

from __future__ import annotations

import numpy as np
import pytest
from lqr import HORIZON, LQR, PROBLEMS


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_sums_are_those_of_played_episodes(name: str):
    """And the actions of the optimum reach the box in few of the steps."""
    env, limit = LQR(**PROBLEMS[name].matrices), PROBLEMS[name].limit
    best, multiplier = env.optimum(limit)
    gains = env.gains(multiplier)
    assert env.sums(gains)[1] == pytest.approx(limit)
    totals, beyond = [], 0
    for seed in range(1500):
        x, total = env.reset(seed=seed)[0], np.zeros(2)
        for gain in gains:
            action = np.clip(-gain @ x, -1.0, 1.0)
            beyond += int((np.abs(action) == 1).any())
            x, reward, _, _, info = env.step(action)
            total += reward, info["cost"]
        totals.append(total)
    mean, error = np.mean(totals, 0), np.std(totals, 0) / len(totals) ** 0.5
    assert (np.abs(mean - [best, limit]) < 4 * error).all()
    assert beyond < 0.005 * len(totals) * HORIZON


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


def test_an_optimum_that_the_box_cuts_off_is_none():
    env = LQR(**PROBLEMS["Effort"].matrices | {"spread": 2.0})
    with pytest.raises(ValueError, match="cut off forces whose standard deviation is"):
        env.optimum(120.0)
