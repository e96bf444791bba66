"""Options of the cost critics: quantiles, reachability, risks, the rescaled actor loss."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from saferl.modules import (
    CriticEnsemble,
    CVaR,
    DualAscent,
    Largest,
    MeanStd,
    MLPPolicyEncoder,
    MLPValue,
    tanh_gaussian_actor,
    value_operator,
)
from saferl.objectives import SACLagLoss
from saferl.objectives.cost_terms import quantile_loss

SIZE, GAMMA = 3, 0.9


def build(outputs: int = 1, members: int = 2, **settings) -> SACLagLoss:
    torch.manual_seed(0)
    keys = ["observation", "action"]

    def critics(count: int, key: str, outputs: int = 1):
        networks = [MLPValue(size=SIZE, width=8, depth=1, outputs=outputs) for _ in range(count)]
        return [value_operator(network.double(), keys, key) for network in networks]

    encoder = MLPPolicyEncoder(size=SIZE, width=8, depth=1)
    loss = SACLagLoss(
        tanh_gaussian_actor(encoder, 8, 2, in_keys=["observation"]).double(),
        critics(2, "state_action_value"),
        critics(members, "state_action_cost_value", outputs),
        num_cost_critics=members,
        **{"lagrange": DualAscent(init=3.0)} | settings,
    )
    loss.make_value_estimator(gamma=GAMMA)
    return loss


def batch_of(size: int = 6) -> TensorDict:
    torch.manual_seed(1)
    draw = lambda *shape: torch.randn(*shape, dtype=torch.float64)  # noqa: E731
    terminated = torch.zeros(size, 1, dtype=torch.bool)
    terminated[0] = True
    following = {
        "observation": draw(size, SIZE),
        "reward": draw(size, 1),
        "cost": draw(size, 1).abs(),
        "done": terminated,
        "terminated": terminated,
    }
    data = {"observation": draw(size, SIZE), "action": draw(size, 2).tanh(), "next": following}
    return TensorDict(data, [size])


def of_critics(loss, params, data, action) -> torch.Tensor:
    """Values [n, B, K] by one call of each member."""
    out = []
    for member in params.unbind(0):
        with torch.no_grad(), member.to_module(loss.cost_critic, preserve_module_state=False):
            states = TensorDict({"observation": data["observation"], "action": action}, data.shape)
            out.append(loss.cost_critic(states)["state_action_cost_value"])
    return torch.stack(out)


def test_quantile_loss_matches_a_loop():
    torch.manual_seed(0)
    predicted, target = torch.randn(4, 3).numpy() * 2, torch.randn(4, 5).numpy() * 2
    expected = np.zeros(4)
    for b in range(4):
        for i in range(3):
            for j in range(5):
                error = target[b, j] - predicted[b, i]
                expected[b] += abs((i + 0.5) / 3 - (error < 0)) * abs(error) / 5
    ours = quantile_loss(torch.tensor(predicted), torch.tensor(target))
    np.testing.assert_allclose(ours, expected, rtol=1e-5)


@pytest.mark.parametrize("size", [0.05, 1.0, 50.0])
def test_quantile_loss_finds_the_quantiles(size: float):
    """Of costs of any size, also far below 1: a tenth of the cases cost ``size``, the others up to a tenth of it."""
    torch.manual_seed(0)
    samples = 0.1 * size * torch.rand(1, 4000)
    samples[:, :400] = size
    guess = torch.zeros(1, 10, requires_grad=True)
    optimizer = torch.optim.Adam([guess], lr=0.02 * size)
    for step in range(600):
        optimizer.param_groups[0]["lr"] = 0.02 * size * (1 - step / 600)
        optimizer.zero_grad()
        (quantile_loss(guess, samples).sum() / size).backward()
        optimizer.step()
    wanted = torch.quantile(samples, (torch.arange(10) + 0.5) / 10, dim=1).T
    torch.testing.assert_close(guess.detach(), wanted, rtol=0, atol=0.02 * size)
    values = guess.detach()[None]
    assert float(CVaR(0.9)(values)) == pytest.approx(size, rel=0.03)
    assert float(Largest()(values)) == pytest.approx(float(samples.mean()), rel=0.05)


@pytest.mark.parametrize("outputs", [1, 5])
@pytest.mark.parametrize("target", ["max", "mean"])
def test_targets_of_the_sum(outputs: int, target: str):
    loss, data = build(outputs, cost_target=target), batch_of()
    next_state, _ = drawn = loss.sample_next(data)
    loss.sample_next = lambda _: drawn
    then = of_critics(loss, loss.target_cost_critic_params, next_state, next_state["action"])
    then = then.amax(0) if target == "max" else then.mean(0)
    alive = ~data["next", "terminated"]
    expected = data["next", "cost"] + GAMMA * alive * then  # [B, K]
    now = of_critics(loss, loss.cost_critic_params, data, data["action"])
    ours, _ = loss.cost_loss(data)
    if outputs == 1:
        by_hand = 0.5 * (now - expected).square().sum(0).mean()
    else:
        by_hand = sum(quantile_loss(member, expected).mean() for member in now)
    torch.testing.assert_close(ours, by_hand)


def test_target_of_the_reachability():
    loss, data = build(cost_backup="reach"), batch_of()
    next_state, _ = drawn = loss.sample_next(data)
    loss.sample_next = lambda _: drawn
    then = of_critics(loss, loss.target_cost_critic_params, next_state, next_state["action"]).amax(
        0
    )
    cost, end = data["next", "cost"], data["next", "terminated"]
    expected = torch.stack(
        [
            c if dead else (1 - GAMMA) * c + GAMMA * torch.maximum(c, v)
            for c, v, dead in zip(cost, then, end, strict=True)
        ]
    )
    now = of_critics(loss, loss.cost_critic_params, data, data["action"])
    ours, _ = loss.cost_loss(data)
    torch.testing.assert_close(ours, 0.5 * (now - expected).square().sum(0).mean())


def test_reachability_is_the_largest_cost_ahead():
    """Fixed point on a chain whose third step costs 2: never more than that, and discounted backwards."""
    loss = build(cost_backup="reach")
    value = torch.zeros(5, 1, dtype=torch.float64)
    cost = torch.tensor([[0.0], [0.5], [2.0], [0.0], [0.0]], dtype=torch.float64)
    data = batch_of(5)
    data["next", "cost"], data["next", "terminated"] = cost, torch.arange(5)[:, None] == 4
    for _ in range(10):
        value = loss.backup(data, torch.cat([value[1:], value[:1]]))
    at = 2.0
    before = 0.1 * 0.5 + 0.9 * at
    expected = torch.tensor([[0.9 * before], [before], [at], [0.0], [0.0]], dtype=torch.float64)
    torch.testing.assert_close(value, expected)


@pytest.mark.parametrize(("outputs", "members", "risk"), [(1, 4, MeanStd(2.0)), (5, 2, CVaR(0.5))])
def test_one_risk_for_loss_and_projector(outputs: int, members: int, risk):
    loss, data = build(outputs, members, risk=risk, risk_limit=0.1), batch_of()
    torch.manual_seed(5)
    _, metadata = loss.actor_loss(data)
    torch.manual_seed(5)
    sample, _ = loss.sample_action(data)
    values = of_critics(loss, loss.cost_critic_params, data, sample["action"])
    violation = (risk(values) - 0.1).clamp(min=0).mean()
    torch.testing.assert_close(metadata["constraint_violation"], violation)
    ours = loss.cost_value(data.clone())["state_action_cost_value"]
    stored = of_critics(loss, loss.cost_critic_params, data, data["action"])
    torch.testing.assert_close(ours, risk(stored))
    out = loss(data)
    assert all(value.isfinite().all() for value in out.values())


def test_rescaled_actor_loss():
    plain, rescaled, data = build(), build(rescale=True), batch_of()
    losses = []
    for loss in (plain, rescaled):
        torch.manual_seed(5)
        losses.append(loss.actor_loss(data)[0])
    torch.testing.assert_close(losses[1], losses[0] / 4.0)  # lambda is 3


def test_one_critic_is_trained():
    """As itself; in a list TorchRL would hide its parameters."""
    loss = build(members=2)
    critic = loss.cost_critic
    with pytest.raises(
        ValueError, match="cost_critic must be a critic or a list of several, got a list"
    ):
        build(members=1)
    alone = CriticEnsemble([critic])
    assert list(alone.parameters()) and all(p.is_leaf for p in alone.parameters())
    state = batch_of().select("observation", "action")
    alone(state)["state_action_cost_value"].sum().backward()
    assert all(p.grad is not None for p in alone.parameters())


def test_refuses():
    with pytest.raises(ValueError, match="cost_backup must be one of sum, reach, got 'min'"):
        build(cost_backup="min")
    with pytest.raises(ValueError, match="lagrange must be a LagrangeMultiplier, got 1.0"):
        build(lagrange=1.0)
    with pytest.raises(ValueError, match="risk must be a function, .* got 'max'"):
        build(risk="max")
    with pytest.raises(ValueError, match="is of single steps"):
        build(cost_backup="reach")(batch_of().set("steps_to_next_obs", torch.ones(6, 1)))
