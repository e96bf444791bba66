"""PPO-Lagrangian that also learns the risk of an action."""

from __future__ import annotations

import pytest
import torch
from on_policy import GAMMA, LAMBDA, SIZE, batch_of, encoder, value
from torchrl.objectives import ValueEstimators

from saferl.modules import DualAscent, MeanStd, MLPValue, tanh_gaussian_actor, value_operator
from saferl.objectives import PPOLagLoss, RiskPPOLoss


def member(outputs: int = 1):
    network = MLPValue(size=SIZE, width=8, depth=1, outputs=outputs)
    keys = ("observation", "action")
    return value_operator(network, in_keys=keys, out_key="state_action_cost_value").double()


def build(members: int = 2, outputs: int = 1, **settings):
    torch.manual_seed(0)
    actor = tanh_gaussian_actor(encoder(), 8, 2, in_keys=["observation"]).double()
    parts = actor, value("state_value").double(), value("state_cost_value").double()
    critics = [member(outputs) for _ in range(members)]
    loss = RiskPPOLoss(*parts, critics, lagrange=DualAscent(init=0.7), **settings)
    plain = PPOLagLoss(*parts, lagrange=DualAscent(init=0.7))
    for each in (loss, plain):
        each.make_value_estimator(ValueEstimators.GAE, gamma=GAMMA, lmbda=LAMBDA)
    data = batch_of(actor)
    loss.begin(data)
    return loss, plain, critics, data.reshape(-1)


@pytest.mark.parametrize("executed", [False, True])
def test_the_risk_is_fitted_to_the_cost_that_followed_the_executed_action(executed: bool):
    loss, plain, critics, data = build()
    action = data["action"]
    if executed:
        action = torch.rand_like(action) * 2 - 1
        data["next", "action_executed"] = action
    out, without = loss(data), plain(data)
    states = data.select("observation").set("action", action)
    errors = [critic(states.copy())["state_action_cost_value"] for critic in critics]
    expected = sum(0.5 * (e - data["cost_value_target"]).square().mean() for e in errors)
    torch.testing.assert_close(out["loss_risk"], expected)
    # The policy's own terms are those of PPO-Lagrangian, on the proposed action.
    for key in ("loss_objective", "loss_critic", "loss_cost"):
        torch.testing.assert_close(out[key], without[key])


def test_the_risk_loss_reaches_its_own_parameters_alone():
    loss, _, _, data = build()
    loss(data)["loss_risk"].backward()
    moved = {name.split(".")[0] for name, p in loss.named_parameters() if p.grad is not None}
    assert moved == {"risk_critic_params"}


def test_the_projectors_risk_is_live():
    loss, _, critics, data = build(members=3, risk=MeanStd(k=2.0))
    states = data.select("observation", "action")
    each = torch.stack([c(states.copy())["state_action_cost_value"] for c in critics])
    risk = loss.cost_value
    torch.testing.assert_close(risk(states.copy())["state_action_cost_value"], MeanStd(2.0)(each))
    with torch.no_grad():
        for parameter in loss.risk_critic_params.values(True, True):
            parameter.zero_()
    assert risk(states)["state_action_cost_value"].abs().max() < 1e-5


def test_quantiles_are_fitted_as_quantiles():
    loss, _, critics, data = build(outputs=4)
    states = data.select("observation", "action")
    expected = 0.0
    for critic in critics:
        error = data["cost_value_target"] - critic(states.copy())["state_action_cost_value"]
        level = (torch.arange(4).double() + 0.5) / 4
        expected = expected + torch.maximum(level * error, (level - 1) * error).sum(-1).mean()
    torch.testing.assert_close(loss(data)["loss_risk"], expected)


def test_one_member_is_refused():
    with pytest.raises(ValueError, match="risk_critic must be a list of two critics or more"):
        build(members=1)
