"""The cart: its sums, its optimum, its episodes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torchrl.envs.utils import check_env_specs

from saferl.envs import Cart, CartEnv


@pytest.mark.parametrize(("gamma", "horizon"), [(1.0, 20), (0.9, 20)])
def test_sums_are_those_of_episodes(gamma: float, horizon: int):
    cart, gain = Cart(), np.array([0.4, 0.5])
    env = CartEnv(cart, num_envs=40_000, seed=3)
    force = torch.tensor(gain, dtype=torch.float32)
    data = env.rollout(
        horizon,
        lambda td: td.set("action", -(td["observation"] @ force)[:, None]),
        break_when_any_done=False,
    )
    weight = gamma ** torch.arange(horizon)
    for key, expected in zip(("reward", "cost"), cart.sums(gain, gamma, horizon), strict=True):
        each = data["next", key].squeeze(-1) @ weight
        assert abs(float(each.mean()) - expected) < 4 * float(each.std()) / 200


def test_optimum_is_the_best_linear_policy():
    """Against a general optimiser over all gains; the constraint binds."""
    cart, limit, gamma = Cart(), 0.2, 0.9
    gain = cart.optimum(limit, gamma)
    found = minimize(
        lambda k: -cart.sums(k, gamma)[0],
        np.array([0.1, 0.1]),
        constraints=[{"type": "ineq", "fun": lambda k: limit - cart.sums(k, gamma)[1]}],
        method="SLSQP",
        options={"ftol": 1e-12},
    )
    assert cart.sums(gain, gamma)[1] == pytest.approx(limit, rel=1e-6)
    assert cart.sums(gain, gamma)[0] == pytest.approx(-found.fun, rel=1e-4)
    np.testing.assert_allclose(gain, found.x, atol=5e-3)
    with pytest.raises(ValueError, match=r"limit=100 does not bind"):
        cart.optimum(100, gamma)


def test_specs_and_episodes():
    check_env_specs(CartEnv(Cart(horizon=4), num_envs=3, seed=0))
    env = CartEnv(Cart(horizon=4), num_envs=3, seed=1)
    data = env.rollout(9, break_when_any_done=False)
    assert data["next", "truncated"].squeeze(-1).all(0).tolist() == [False] * 3 + [True] + [
        False
    ] * 3 + [True, False]
    assert not data["next", "terminated"].any()
    torch.testing.assert_close(data["next", "cost"], data["action"] ** 2)
    again = CartEnv(Cart(horizon=4), num_envs=3, seed=1).rollout(
        9, lambda td: td.set("action", torch.zeros(3, 1)), break_when_any_done=False
    )
    assert torch.equal(again["observation"][:, 4], data["observation"][:, 4])  # of the seed alone


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"horizon": 0}, "task.horizon must be >= 1, got 0"),
        ({"spread": -1.0}, "task.spread must be >= 0, got -1"),
        ({"noise": float("nan")}, "task.noise must be >= 0, got nan"),
    ],
)
def test_refuses(setting: dict, message: str):
    with pytest.raises(ValueError, match=message):
        Cart(**setting)


def test_state_goes_on_where_it_was():
    env, other = (CartEnv(Cart(), num_envs=2, seed=seed) for seed in (0, 9))
    still = lambda td: td.set("action", torch.full((2, 1), 0.3))  # noqa: E731
    env.rollout(5, still, break_when_any_done=False)
    other.reset()
    other.load_state_dict(env.state_dict())
    step = env._step(still(env.reset().clone()))  # both from here: reset draws the next episodes
    same = other._step(still(other.reset().clone()))
    assert torch.equal(step["observation"], same["observation"])


def test_the_optimum_under_two_limits():
    """Both bind, and no linear policy near it that keeps them returns more."""
    cart, limits = Cart(costs=("effort", "motion")), (0.25, 0.5)
    gain = cart.optimum(limits, 0.9, 1.0, 20)
    assert cart.sums(gain, 1.0, 20)[1:] == pytest.approx(limits, rel=1e-6)
    best, draw, kept = cart.sums(gain, 0.9)[0], np.random.default_rng(0), 0
    for _ in range(200):
        moved = gain + 0.05 * draw.normal(size=2)
        costs = np.array(cart.sums(moved, 1.0, 20)[1:])
        if (costs <= limits).all():
            kept += 1
            assert cart.sums(moved, 0.9)[0] < best
    assert kept > 8
    with pytest.raises(ValueError, match="does not bind"):
        cart.optimum((0.25, 5.0), 0.9, 1.0, 20)
    with pytest.raises(ValueError, match=r"task.costs must be \[effort\] or \[effort,motion\]"):
        Cart(costs=("motion",))


def test_two_costs_of_played_episodes():
    """Their sums are those of the closed form."""
    cart = Cart(costs=("effort", "motion"))
    gain = torch.tensor(cart.optimum((0.25, 0.5), 0.9, 1.0, 20), dtype=torch.float32)
    env = CartEnv(cart, num_envs=4000, seed=0)
    policy = lambda td: td.set("action", -(td["observation"] @ gain)[:, None])  # noqa: E731
    cost = env.rollout(20, policy)["next", "cost"].sum(1)
    error = cost.std(0) / len(cost) ** 0.5
    assert ((cost.mean(0) - torch.tensor([0.25, 0.5])).abs() < 4 * error).all()
