"""P3O, FOCOPS, CRPO and CaT, each term by hand on a few samples, and where it is PPO's."""

from __future__ import annotations

import math

import pytest
import torch
from on_policy import GAMMA, LAMBDA, batch_of, build, encoder, value
from tensordict import TensorDict
from torchrl.objectives import ClipPPOLoss, ValueEstimators

from saferl.modules import DualAscent, ExactPenalty, Switch, tanh_gaussian_actor
from saferl.objectives import CaTLoss

#: Of three samples: ratios, one beyond each end of the clip; advantages, the costs' with mean 0.
RATIO, REWARD, COST = (1.5, 0.5, 1.0), (1.0, 2.0, -3.0), (0.3, -0.6, 0.3)


def column(values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None]


def samples(loss, actor) -> TensorDict:
    """Three transitions with these advantages, whose actions the policy that acted took with other probabilities."""
    data = batch_of(actor)
    loss.begin(data)
    data = data[3, :3]
    log_prob = actor.get_dist(data.copy()).log_prob(data["action"]).detach()
    data["action_log_prob"] = log_prob - column(RATIO).log().squeeze(-1)
    return data.set("advantage", column(REWARD)).set("cost_advantage", column(COST))


def actor_gradient(loss, terms) -> torch.Tensor:
    loss.zero_grad(set_to_none=True)
    sum(terms).backward(retain_graph=True)
    grads = [p.grad for n, p in loss.named_parameters() if n.startswith("actor")]
    return torch.cat([grad.reshape(-1) for grad in grads])


def plain(loss, actor, advantage: torch.Tensor, data: TensorDict):
    """TorchRL's own PPO on an advantage."""
    torch.manual_seed(0)
    theirs = ClipPPOLoss(
        actor, value("state_value").double(), entropy_bonus=False, normalize_advantage=True,
        loss_critic_type="l2",
    )  # fmt: skip
    theirs.critic_network_params.data.copy_(loss.critic_network_params.data)
    return theirs, theirs(data.clone().set("advantage", advantage))


# P3O.


def test_p3o_penalty_by_hand():
    loss, actor = build("p3o", lagrange=ExactPenalty(init=20.0))
    data = samples(loss, actor)
    loss.lagrange.update(torch.tensor(2.0))
    # max(rho A_c, clip(rho) A_c) = 0.45, -0.3, 0.3, of which the mean is 0.15; 0.15 + (1 - 0.9) 2 = 0.35;
    # 20 * 0.35 = 7, and the deviation of the reward's advantages is sqrt((1 + 4 + 9) / 2).
    assert float(loss(data)["loss_penalty"]) == pytest.approx(7 / math.sqrt(7.0), rel=1e-6)
    loss.normalize_advantage = False
    assert float(loss(data)["loss_penalty"]) == pytest.approx(7, rel=1e-6)


def test_p3o_adds_up_several_costs():
    """The second is far within its limit; a constant on its advantages changes nothing."""
    loss, _ = build("p3o", lagrange=ExactPenalty(init=20.0))
    loss.lagrange.expand(2)
    loss.lagrange.update(torch.tensor([[2.0, -50.0]]))
    loss.normalize_advantage = False
    single, other = build("p3o")
    data = samples(single, other)
    data["cost_advantage"] = data["cost_advantage"] * torch.tensor([1.0, 3.0]) + torch.tensor(
        [0.0, 9.0]
    )
    assert float(loss.policy_terms(data)["loss_penalty"]) == pytest.approx(7, rel=1e-6)


def test_p3o_within_its_limit_is_ppo():
    loss, actor = build("p3o")
    data = samples(loss, actor)
    loss.lagrange.update(torch.tensor(-10.0))
    out, (theirs, other) = loss(data), plain(loss, actor, data["advantage"], data)
    assert out["loss_penalty"] == 0 and torch.equal(out["loss_objective"], other["loss_objective"])
    ours = actor_gradient(loss, [out["loss_objective"], out["loss_penalty"]])
    assert torch.equal(ours, actor_gradient(theirs, [other["loss_objective"]]))


@pytest.mark.parametrize("kind", ["p3o", "crpo", "focops"])
def test_a_step_lowers_what_costs(kind: str):
    """Over the limit, and with a reward that does not matter, actions that cost more become less likely."""
    multiplier = {"p3o": ExactPenalty(), "crpo": Switch(), "focops": DualAscent(init=1e6)}[kind]
    loss, actor = build(kind, lagrange=multiplier)
    multiplier.update(torch.tensor(2.0))
    data = batch_of(actor)
    loss.begin(data)
    data = data.reshape(-1)
    term = loss(data)["loss_penalty" if kind == "p3o" else "loss_objective"]
    grad = actor_gradient(loss, [term])
    parameters = [p for n, p in loss.named_parameters() if n.startswith("actor")]
    log_prob = actor.get_dist(data.copy()).log_prob(data["action"])
    cost = data["cost_advantage"].squeeze(-1)
    priced = torch.autograd.grad((log_prob * (cost - cost.mean())).mean(), parameters)
    assert grad @ torch.cat([each.reshape(-1) for each in priced]) > 0


def test_p3o_refuses_what_would_not_count():
    loss, _ = build("p3o")
    with pytest.raises(ValueError, match="gamma must be < 1, as"):
        loss.make_value_estimator(ValueEstimators.GAE, gamma=1.0, lmbda=0.9)
    with pytest.raises(ValueError, match="lagrange must be a ExactPenalty, got DualAscent"):
        build("p3o", lagrange=DualAscent())


# CRPO.


@pytest.mark.parametrize(("violation", "sign"), [(-0.1, 1), (0.1, -1)])
def test_crpo_is_ppo_on_the_reward_or_on_the_cost_alone(violation: float, sign: int):
    loss, actor = build("crpo")
    data = samples(loss, actor)
    loss.lagrange.update(torch.tensor(violation))
    advantage = data["advantage"] if sign > 0 else -data["cost_advantage"]
    out, (theirs, other) = loss(data), plain(loss, actor, advantage, data)
    assert torch.equal(out["loss_objective"], other["loss_objective"])
    ours = actor_gradient(loss, [out["loss_objective"]])
    assert torch.equal(ours, actor_gradient(theirs, [other["loss_objective"]]))
    assert out["lagrange_multiplier"] == float(sign < 0)


def test_crpo_has_a_tolerance_and_lowers_the_worst_cost():
    loss, _ = build("crpo", lagrange=Switch(tolerance=0.05))
    loss.lagrange.expand(3)
    data = samples(*build("crpo"))
    data["cost_advantage"] = data["cost_advantage"] * torch.tensor([1.0, 10.0, 100.0])
    for violation, column_of in (([0.04, 0.03, 0.0], None), ([0.06, 0.3, -1.0], 1)):
        loss.lagrange.update(torch.tensor([violation]))
        weighed = loss.weigh(data["advantage"], data["cost_advantage"])
        expected = data["advantage"]
        if column_of is not None:
            expected = -data["cost_advantage"][:, [column_of]]
        torch.testing.assert_close(weighed, expected)
    loss.lagrange.update(torch.full((0, 3), 1.0))  # no episode ended
    assert loss.lagrange.value.tolist() == [0.0, 1.0, 0.0]


# FOCOPS.


def test_focops_objective_by_hand():
    """Before the policy has moved the KL is 0: what is left is the ratio times the weighed advantage over lambda."""
    loss, actor = build("focops", lagrange=DualAscent(init=1.0), normalize_advantage=False)
    out = loss(samples(loss, actor))
    # (A_r - A_c) / 2 = 0.35, 1.3, -1.65, by ratios of 1.5, 0.5 and 1 in the mean -0.475 / 3.
    torch.testing.assert_close(out["loss_objective"], torch.tensor(0.475 / 3 / 1.5).double())
    assert abs(float(out["kl"])) < 1e-12 and out["trusted"] == 1


def test_focops_without_a_multiplier_is_of_the_reward_alone():
    loss, actor = build("focops", lagrange=DualAscent(init=0.0))
    data = samples(loss, actor)
    other = data.clone().set("cost_advantage", 1e3 * data["cost_advantage"])
    assert torch.equal(loss(data)["loss_objective"], loss(other)["loss_objective"])


def test_focops_kl_and_mask():
    """The KL of tanh-Gaussians is that of their Gaussians; states beyond delta pull no more."""
    loss, actor = build("focops", lagrange=DualAscent(init=1.0), normalize_advantage=False)
    data = samples(loss, actor)
    data["action_log_prob"] += column(RATIO).log().squeeze(-1)  # those that acted
    with torch.no_grad():
        for parameter in loss.actor_network_params.values(True, True):
            parameter.add_(0.1 * torch.randn_like(parameter))
    with loss.actor_network_params.to_module(loss.actor_network):
        now = loss.actor_network.get_dist_params(data.select("observation"))
        new = loss.actor_network.get_dist(data.select("observation")).log_prob(data["action"])
    before, after = (data["loc"], data["scale"]), (now["loc"], now["scale"])
    kl = (before[1] / after[1]).log() - 0.5
    kl = kl + (after[1] ** 2 + (after[0] - before[0]) ** 2) / (2 * before[1] ** 2)
    kl = kl.sum(-1).detach()
    loss.trust = float(kl.median())
    near = kl <= loss.trust
    assert 0 < near.sum() < 3
    gain = (new - data["action_log_prob"]).exp() * (column(REWARD) - column(COST)).squeeze(-1) / 2
    out = loss(data)
    torch.testing.assert_close(out["loss_objective"], (near * (kl - gain / 1.5)).sum() / 3)
    torch.testing.assert_close(out["kl"], kl.mean())
    torch.testing.assert_close(out["trusted"], near.double().mean())


@pytest.mark.parametrize("name", ["temperature", "trust"])
def test_focops_refuses(name: str):
    with pytest.raises(ValueError, match=f"{name} must be > 0, got 0"):
        build("focops", **{name: 0})


# CaT.


def cat(**settings) -> tuple[CaTLoss, object]:
    torch.manual_seed(0)
    actor = tanh_gaussian_actor(encoder(), 8, 2, in_keys=["observation"]).double()
    loss = CaTLoss(actor, value("state_value").double(), **settings)
    loss.make_value_estimator(ValueEstimators.GAE, gamma=GAMMA, lmbda=LAMBDA)
    return loss, actor


def test_cat_probabilities_by_hand():
    loss, _ = cat(step_limit=[1.0, 0.0], probability=0.5, memory=0.9)
    cost = torch.tensor([[0.5, 0.0], [3.0, 0.1], [2.0, 0.4]])
    # The largest violations are 2 and 0.4.
    expected = torch.tensor([[0.0], [0.5], [0.5]])
    torch.testing.assert_close(loss.terminations(cost), expected)
    assert loss.largest.tolist() == pytest.approx([2.0, 0.4])
    # Of a milder batch: 0.9 * 2 + 0.1 * 1 and 0.9 * 0.4 + 0.1 * 0.09.
    torch.testing.assert_close(
        loss.terminations(torch.tensor([[2.0, 0.0], [1.0, 0.09]])),
        0.5 * torch.tensor([[1 / 1.9], [0.09 / 0.369]]),
    )


@pytest.mark.parametrize("bonus", [0.0, 2.0])
def test_cat_advantages_match_a_loop(bonus: float):
    loss, actor = cat(step_limit=0.3, probability=0.8, bonus=bonus)
    data = batch_of(actor)
    loss.begin(data)
    cost = data["next", "cost"]
    violation = (cost - 0.3).clamp(min=0)
    ends = (0.8 * violation / violation.max()).squeeze(-1)
    critic = loss.critic_network
    with torch.no_grad(), loss.critic_network_params.to_module(critic):
        now = critic(data.select("observation"))["state_value"].squeeze(-1)
        then = critic(data["next"].select("observation"))["state_value"].squeeze(-1)
    reward, done, dead = (data["next", k].squeeze(-1) for k in ("reward", "done", "terminated"))
    expected = torch.zeros_like(now)
    for row in range(now.shape[0]):
        running = 0.0
        for t in reversed(range(now.shape[1])):
            goes_on = 1 - ends[row, t]
            delta = goes_on * (reward[row, t] + bonus) - now[row, t]
            delta = delta + (0.0 if dead[row, t] else goes_on * GAMMA * then[row, t])
            ahead = 0.0 if done[row, t] else goes_on * GAMMA * LAMBDA * running
            running = expected[row, t] = delta + ahead
    torch.testing.assert_close(data["advantage"].squeeze(-1), expected)
    torch.testing.assert_close(data["value_target"].squeeze(-1), expected + now)
    out = loss(data.reshape(-1))
    torch.testing.assert_close(out["termination"].double(), ends.mean())
    assert "termination" in loss.out_keys


def test_cat_without_a_violation_is_ppo():
    loss, actor = cat(step_limit=2.0)
    data = batch_of(actor)
    theirs = data.clone()
    loss.begin(data)
    loss.value_estimator(
        theirs,
        params=loss.critic_network_params.detach(),
        target_params=loss.target_critic_network_params,
    )
    for key in ("advantage", "value_target"):
        torch.testing.assert_close(data[key], theirs[key])
    assert loss.termination == 0


def test_cat_refuses():
    with pytest.raises(ValueError, match=r"probability must be in \[0, 1\], got 2"):
        cat(probability=2)
    with pytest.raises(ValueError, match="step_limit must be >= 0, got -1"):
        cat(step_limit=-1)
    loss, actor = cat()
    with pytest.raises(KeyError, match=r"no entry \('next', 'cost'\)"):
        loss.begin(batch_of(actor).exclude(("next", "cost")))
    with pytest.raises(KeyError, match=r"no entry 'advantage': loss.begin"):
        loss(batch_of(actor).reshape(-1))
    with pytest.raises(NotImplementedError):
        loss.make_value_estimator(ValueEstimators.TD0, gamma=0.9)


def test_focops_needs_the_distribution_that_acted():
    loss, actor = build("focops")
    data = samples(loss, actor)
    with pytest.raises(KeyError, match="no entry 'scale': FOCOPS compares"):
        loss(data.exclude("scale"))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"clip_epsilon": -0.5}, "clip_epsilon must be > 0, got -0.5"),
        ({"bonus": math.nan}, "bonus must be a number"),
    ],
)
def test_cat_refuses_what_ppo_does(settings, message: str):
    parts = tanh_gaussian_actor(encoder(), 8, 2, in_keys=["observation"]), value("state_value")
    with pytest.raises(ValueError, match=message):
        CaTLoss(*parts, **settings)
    with pytest.raises(ValueError, match=r"gamma must be in \[0, 1\], got 2.0"):
        CaTLoss(*parts).make_value_estimator(gamma=2.0)
