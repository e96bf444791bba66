"""What SACLagLoss refuses, and how many critics it counts."""

from __future__ import annotations

import pytest
import torch

# Gradients and state


def test_a_bad_cost_target_is_named(make_loss):
    with pytest.raises(ValueError, match="cost_target must be one of max, mean, got 'min'"):
        make_loss(cost_target="min")


@pytest.mark.parametrize("limit", [-1.0, float("nan"), float("inf")])
def test_a_bad_risk_limit_is_named(make_loss, limit):
    with pytest.raises(ValueError, match=rf"risk_limit must be >= 0, got {limit}\."):
        make_loss(risk_limit=limit)


@pytest.mark.parametrize("gamma", [1.2, -0.1, float("nan")])
def test_a_bad_gamma_is_named(make_loss, gamma):
    loss = make_loss(gamma=0.9)
    with pytest.raises(ValueError, match=rf"gamma must be in \[0, 1\], got {gamma}\."):
        loss.make_value_estimator(gamma=gamma)
    torch.testing.assert_close(loss.value_estimator.gamma, torch.tensor(0.9))


def test_a_list_is_as_many_critics_as_it_holds(make_loss, make_critic):
    reward = [make_critic("state_action_value") for _ in range(3)]
    cost = [make_critic("state_action_cost_value") for _ in range(4)]
    loss = make_loss(qvalue_network=reward, cost_critic=cost)
    assert (loss.num_qvalue_nets, loss.num_cost_critics) == (3, 4)
    with pytest.raises(ValueError, match="num_cost_critics must be 4, as cost_critic is a list"):
        make_loss(cost_critic=cost, num_cost_critics=2)


@pytest.mark.parametrize("name", ["num_qvalue_nets", "num_cost_critics"])
def test_an_empty_ensemble_is_refused(make_loss, name):
    with pytest.raises(ValueError, match=f"{name} must be >= 1, got 0"):
        make_loss(**{name: 0})
