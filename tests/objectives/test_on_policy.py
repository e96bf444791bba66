"""What PPO-Lagrangian, CPO and their kin have in common, against loops and hand-made formulas."""

from __future__ import annotations

import pytest
import torch
from on_policy import GAMMA, LAMBDA, LOSSES, batch_of, build, value
from torchrl.objectives import ClipPPOLoss, ValueEstimators

from saferl.algorithms.on_policy import begin_of
from saferl.modules import DualAscent


@pytest.mark.parametrize("kind", LOSSES)
def test_advantages_match_a_loop(kind: str):
    """Through a truncation with the value behind it, not through a termination; an episode's cost ends with it."""
    loss, actor = build(kind)
    data = batch_of(actor)
    loss.begin(data)
    for name, params, key, advantage, target in (
        ("critic_network", loss.critic_network_params, "reward", "advantage", "value_target"),
        ("cost_critic", loss.cost_critic_params, "cost", "cost_advantage", "cost_value_target"),
    ):
        network = getattr(loss, name)
        with torch.no_grad(), params.to_module(network):
            now = network(data.select("observation"))[network.out_keys[0]].squeeze(-1)
            then = network(data["next"].select("observation"))[network.out_keys[0]].squeeze(-1)
        signal = data["next", key].squeeze(-1)
        end, dead = (data["next", k].squeeze(-1) for k in ("done", "terminated"))
        dead = end if key == "cost" else dead
        expected = torch.zeros_like(now)
        for row in range(now.shape[0]):
            running = 0.0
            for t in reversed(range(now.shape[1])):
                delta = signal[row, t] - now[row, t]
                if not dead[row, t]:
                    delta = delta + GAMMA * then[row, t]
                running = delta + (0.0 if end[row, t] else GAMMA * LAMBDA * running)
                expected[row, t] = running
        torch.testing.assert_close(data[advantage].squeeze(-1), expected)
        torch.testing.assert_close(data[target].squeeze(-1), expected + now)


def test_objective_is_the_weighed_advantage_standardised_once():
    loss, actor = build(entropy_bonus=False)
    data = batch_of(actor)
    loss.begin(data)
    flat_data = data.reshape(-1)
    with torch.no_grad():  # another policy than the one that acted
        for parameter in loss.actor_network_params.values(True, True):
            parameter.add_(0.05 * torch.randn_like(parameter))
    out = loss(flat_data)
    multiplier = 0.7
    weighed = (flat_data["advantage"] - multiplier * flat_data["cost_advantage"]) / 1.7
    standard = (weighed - weighed.mean()) / weighed.std()
    with loss.actor_network_params.to_module(loss.actor_network):
        dist = loss.actor_network.get_dist(flat_data.select("observation"))
    ratio = (dist.log_prob(flat_data["action"]) - flat_data["action_log_prob"]).exp()[:, None]
    gain = torch.minimum(ratio * standard, ratio.clamp(0.8, 1.2) * standard)
    # TorchRL clamps the log-ratio to log1p(+-0.2), which is the same.
    torch.testing.assert_close(out["loss_objective"], -gain.mean(), rtol=1e-3, atol=1e-6)
    with loss.cost_critic_params.to_module(loss.cost_critic):
        predicted = loss.cost_critic(flat_data.select("observation"))["state_cost_value"]
    half = 0.5 * (predicted - flat_data["cost_value_target"]).square().mean()
    torch.testing.assert_close(out["loss_cost"], half)
    assert float(out["lagrange_multiplier"]) == multiplier


def test_without_a_multiplier_it_is_torchrls_own():
    loss, actor = build(lagrange=DualAscent(init=0.0))
    torch.manual_seed(0)
    theirs = ClipPPOLoss(
        actor,
        value("state_value").double(),
        entropy_bonus=False,
        normalize_advantage=True,
        loss_critic_type="l2",
    )
    theirs.critic_network_params.data.copy_(loss.critic_network_params.data)
    data = batch_of(actor)
    loss.begin(data)
    ours, other = loss(data.reshape(-1)), theirs(data.reshape(-1))
    for key in ("loss_objective", "loss_critic", "kl_approx"):
        torch.testing.assert_close(ours[key], other[key])


@pytest.mark.parametrize("kind", [*LOSSES, "torchrl"])
@pytest.mark.parametrize("location", [0.0, 9.0, 20.0])
def test_an_unchanged_policy_has_a_ratio_of_one(kind: str, location: float):
    """Also where tanh saturates, and the number before it cannot be found again."""
    loss, actor = build("ppo_lag" if kind == "torchrl" else kind)
    actor = actor.float()  # float64 keeps apart what float32 rounds to the end of the box
    with torch.no_grad():
        actor[0].module.head.weight.zero_()
        actor[0].module.head.bias.copy_(torch.tensor([location, -location, -3.0, -3.0]))
    if kind == "torchrl":
        loss = ClipPPOLoss(actor, value("state_value"))
        loss.make_value_estimator(ValueEstimators.GAE, gamma=GAMMA, lmbda=LAMBDA)
    data = batch_of(actor.double()).apply(lambda x: x.float() if x.is_floating_point() else x)
    data = actor.float()(data)
    drawn = data["action_log_prob"]
    begin = begin_of(loss.float()) if kind == "torchrl" else loss.float().begin  # CPO steps besides
    begin(data)
    found = actor.get_dist(data).log_prob(data["action"])
    torch.testing.assert_close(data["action_log_prob"], found, rtol=1e-5, atol=1e-4)
    assert torch.allclose(drawn, found, atol=1e-2) == (location == 0.0)


@pytest.mark.parametrize("kind", LOSSES)
def test_terms_reach_their_own_parameters(kind: str):
    loss, actor = build(kind)
    data = batch_of(actor)
    loss.begin(data)
    out = loss(data.reshape(-1))
    reach = {
        "loss_objective": "actor_network_params",
        "loss_critic": "critic_network_params",
        "loss_cost": "cost_critic_params",
        "loss_penalty": "actor_network_params",
    }
    for term, owner in reach.items():
        if term not in out.keys():  # noqa: SIM118
            continue
        loss.zero_grad(set_to_none=True)
        out[term].backward(retain_graph=True)
        reached = {n.split(".")[0] for n, p in loss.named_parameters() if p.grad is not None}
        assert reached == {owner}


@pytest.mark.parametrize("separate", [False, True])
@pytest.mark.parametrize("kind", LOSSES)
def test_separate_losses_leave_shared_parameters_to_the_policy(kind: str, separate: bool):
    loss, actor = build(kind, shared=True, separate_losses=separate)
    data = batch_of(actor)
    loss.begin(data)
    out = loss(data.reshape(-1))
    policy = [p for name, p in loss.named_parameters() if name.startswith("actor_network_params")]
    for term in ("loss_critic", "loss_cost"):
        slopes = torch.autograd.grad(out[term], policy, allow_unused=True, retain_graph=True)
        assert any(slope is not None for slope in slopes) != separate


@pytest.mark.parametrize("kind", LOSSES)
def test_a_batch_can_be_begun_again(kind: str):
    """Its advantages are then those of the networks as they are by then."""
    loss, actor = build(kind)
    data, fresh = batch_of(actor), batch_of(actor)
    loss.begin(data)
    with torch.no_grad():
        for parameter in loss.cost_critic_params.values(True, True):
            parameter.add_(0.1)
    loss.begin(data)
    loss.begin(fresh)
    for key in ("advantage", "cost_advantage", "cost_value_target"):
        torch.testing.assert_close(data[key], fresh[key])


@pytest.mark.parametrize("kind", LOSSES)
def test_a_loss_loads_another_ones_state(kind: str):
    (one, actor), (two, _) = build(kind, seed=1), build(kind, seed=2)
    two.load_state_dict(one.state_dict())
    data, again = batch_of(actor), batch_of(actor)
    one.begin(data)
    two.begin(again)
    for key, term in one(data.reshape(-1)).items():
        if key.startswith("loss_"):
            torch.testing.assert_close(term, two(again.reshape(-1))[key])


@pytest.mark.parametrize("kind", LOSSES)
def test_refuses(kind: str):
    loss, actor = build(kind)
    data = batch_of(actor)
    with pytest.raises(KeyError, match=r"no entry \('next', 'cost'\)"):
        loss.begin(data.exclude(("next", "cost")))
    with pytest.raises(ValueError, match=r"gamma must be in \[0, 1\], got 2"):
        loss.make_value_estimator(ValueEstimators.GAE, gamma=2, lmbda=0.9)


@pytest.mark.parametrize("kind", LOSSES)
def test_dispatch_without_a_tensordict(kind: str):
    """By the entries that ``in_keys`` names, in the order of ``out_keys``."""
    loss, actor = build(kind)
    data = batch_of(actor)
    loss.begin(data)
    flat_data = data.reshape(-1)
    expected = loss(flat_data)
    entries = {key: flat_data.get(key) for key in loss.in_keys}
    assert all(isinstance(key, str) for key in entries)
    outputs = loss(**entries)
    assert len(outputs) == len(loss.out_keys) > 5
    for key, output in zip(loss.out_keys, outputs, strict=True):
        torch.testing.assert_close(output, expected[key], equal_nan=True)
    # No more and no less than these is read.
    assert set(loss(flat_data.select(*loss.in_keys)).keys()) == set(expected.keys())


@pytest.mark.parametrize("kind", LOSSES)
def test_a_batch_that_begin_has_not_seen(kind: str):
    loss, actor = build(kind)
    with pytest.raises(KeyError, match=r"no entry '\w+': loss.begin"):
        loss(batch_of(actor).reshape(-1))


def test_ppo_lag_refuses():
    with pytest.raises(ValueError, match="lagrange must be a LagrangeMultiplier, got 1.0"):
        build(lagrange=1.0)
    with pytest.raises(ValueError, match="clip_epsilon must be > 0, got -1"):
        build(clip_epsilon=-1)
