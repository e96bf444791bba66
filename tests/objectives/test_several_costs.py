"""Several constraints: each as it would be alone, and one that weighs nothing changes nothing."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import ValueEstimators

from saferl.modules import (
    CVaR,
    DualAscent,
    LagrangeMultiplier,
    Largest,
    MeanStd,
    MLPPolicyEncoder,
    MLPValue,
    PIDMultiplier,
    StateValue,
    project,
    tanh_gaussian_actor,
    value_operator,
)
from saferl.objectives import CPOLoss, PPOLagLoss, RiskPPOLoss, SACLagLoss

SIZE, GAMMA, KEYS = 3, 0.9, ["observation", "action"]


def encoder() -> MLPPolicyEncoder:
    return MLPPolicyEncoder(size=SIZE, width=8, depth=1)


def actor():
    return tanh_gaussian_actor(encoder(), 8, 2, in_keys=["observation"]).double()


def member(key: str, outputs: int = 1):
    return value_operator(
        MLPValue(size=SIZE, width=8, depth=1, outputs=outputs).double(), KEYS, key
    )


def state_value(key: str, outputs: int = 1):
    return value_operator(StateValue(encoder(), 8, outputs).double(), ["observation"], key)


def rows_of(network, rows: slice):
    """A critic of some of the outputs of another one."""
    state = network.state_dict()
    last = [key for key in state if key.rpartition(".")[0] == [*state][-1].rpartition(".")[0]]
    own = {key: value[rows].clone() if key in last else value for key, value in state.items()}
    size = len(own[last[0]])
    made = member if "action" in network.in_keys else state_value
    alone = made(network.out_keys[0], size)
    alone.load_state_dict(own)
    return alone


def off_policy(costs: slice, quantiles: int = 1, **settings) -> SACLagLoss:
    """A loss with those of two costs; all else is the same."""
    torch.manual_seed(0)
    policy, rewards = actor(), [member("state_action_value") for _ in range(2)]
    both = [member("state_action_cost_value", 2 * quantiles) for _ in range(2)]
    own = slice(costs.start * quantiles, costs.stop * quantiles)
    values, limits = [0.7, 1.3][costs], [0.2, 0.1][costs]
    settings = {"lagrange": DualAscent(init=values), "risk_limit": limits} | settings
    loss = SACLagLoss(policy, rewards, [rows_of(each, own) for each in both], **settings)
    loss.make_value_estimator(gamma=GAMMA)
    return loss


def on_policy(costs: slice, kind=PPOLagLoss, **settings):
    torch.manual_seed(0)
    parts = actor(), state_value("state_value")
    whole = [state_value("state_cost_value", 2)]
    whole += [member("state_action_cost_value", 2) for _ in range(2)]
    cost, *risks = (rows_of(each, costs) for each in whole)
    members = (risks,) if kind is RiskPPOLoss else ()
    settings = {"lagrange": DualAscent(init=[0.7, 1.3][costs])} | settings
    loss = kind(*parts, cost, *members, **settings)
    loss.make_value_estimator(ValueEstimators.GAE, gamma=GAMMA, lmbda=0.8)
    return loss


def batch_of(costs: slice, *shape: int, policy=None) -> TensorDict:
    torch.manual_seed(1)

    def normal(size: int) -> torch.Tensor:
        return torch.randn(*shape, size, dtype=torch.float64)

    rows = torch.arange(torch.Size(shape).numel()).reshape(*shape, 1)
    following = {"observation": normal(SIZE), "reward": normal(1), "cost": normal(2).abs()}
    following["cost"] = following["cost"][..., costs]
    following |= {"terminated": rows % 5 == 1, "done": rows % 5 < 2}
    data = {"observation": normal(SIZE), "is_init": rows % 5 == 2, "next": following}
    data = TensorDict(data, shape)
    if policy is None:
        return data.set("action", normal(2).tanh())
    with torch.no_grad():
        return policy(data)


FIRST, SECOND, BOTH = slice(0, 1), slice(1, 2), slice(0, 2)
#: So high a limit that no state passes it.
IDLE = 1e6


def outcome(loss, data: TensorDict) -> tuple[TensorDict, dict[str, torch.Tensor]]:
    """Terms, and the gradient of each network."""
    torch.manual_seed(2)  # of the actions
    out = loss(data.clone())
    sum(value for key, value in out.items() if key.startswith("loss_")).backward()
    return out.detach(), {name: p.grad.clone() for name, p in loss.named_parameters()}


@pytest.mark.parametrize("risk", [Largest(), MeanStd(), CVaR(0.5)], ids=str)
@pytest.mark.parametrize("rescale", [False, True])
def test_an_idle_second_constraint_changes_nothing_of_sac(risk, rescale):
    """Multiplier 0 and a limit that nothing reaches: the actor's term and gradient are K=1's bit for bit."""
    quantiles = 4 if isinstance(risk, CVaR) else 1
    common = {"quantiles": quantiles, "risk": risk, "rescale": rescale}
    two = off_policy(BOTH, lagrange=DualAscent(init=[0.7, 0.0]), risk_limit=[0.2, IDLE], **common)
    (out, slopes), (alone, own) = (
        outcome(two, batch_of(BOTH, 8)),
        outcome(off_policy(FIRST, **common), batch_of(FIRST, 8)),
    )
    for key in ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy"):
        assert torch.equal(out[key], alone[key]), key
    for name, slope in own.items():
        if not name.startswith("cost_critic"):
            assert torch.equal(slopes[name], slope), name
    own = alone["constraint_violation"]
    torch.testing.assert_close(out["constraint_violation"][0], own, rtol=1e-14, atol=0)
    assert out["constraint_violation"][1] == 0
    two.lagrange.update(out["constraint_violation"])
    one = DualAscent(init=0.7)
    one.update(alone["constraint_violation"])
    assert two.lagrange.value.tolist() == pytest.approx([one.value.item(), 0.0], rel=1e-14)


@pytest.mark.parametrize("quantiles", [1, 4])
@pytest.mark.parametrize("backup", ["sum", "reach"])
def test_sac_sums_what_each_constraint_says_alone(quantiles, backup):
    """The critics' loss is the sum of both; the actor's is theirs but for what does not hold the cost, which counts once."""
    common = {"quantiles": quantiles, "cost_backup": backup}
    both, first, second, none = (
        outcome(off_policy(costs, **common, **more), batch_of(costs, 8))[0]
        for costs, more in (
            (BOTH, {}),
            (FIRST, {}),
            (SECOND, {}),
            (FIRST, {"lagrange": DualAscent(init=0.0)}),
        )
    )
    expected = first["loss_cost"] + second["loss_cost"]
    torch.testing.assert_close(both["loss_cost"], expected)
    expected = first["loss_actor"] + second["loss_actor"] - none["loss_actor"]
    torch.testing.assert_close(both["loss_actor"], expected)
    each = [first["constraint_violation"], second["constraint_violation"]]
    torch.testing.assert_close(both["constraint_violation"], torch.stack(each))
    assert both["lagrange_multiplier"].tolist() == [0.7, 1.3]


@pytest.mark.parametrize("kind", [PPOLagLoss, RiskPPOLoss])
def test_an_idle_second_constraint_changes_nothing_of_ppo(kind):
    two = on_policy(BOTH, kind, lagrange=DualAscent(init=[0.7, 0.0]))
    one = on_policy(FIRST, kind)
    results = []
    for loss, costs in ((two, BOTH), (one, FIRST)):
        data = batch_of(costs, 4, 10, policy=actor_of(loss))
        loss.begin(data)
        results.append((data, *outcome(loss, data.reshape(-1))))
    (data, out, slopes), (own_data, alone, own) = results
    for key in ("cost_advantage", "cost_value_target", "state_cost_value"):
        assert data[key].shape == (4, 10, 2)
        torch.testing.assert_close(data[key][..., :1], own_data[key], rtol=1e-12, atol=1e-12)
    for key in ("loss_objective", "loss_critic"):
        torch.testing.assert_close(out[key], alone[key], rtol=1e-10, atol=1e-12)
    for name, slope in own.items():
        if not name.startswith(("cost_critic", "risk_critic")):
            torch.testing.assert_close(slopes[name], slope, rtol=1e-9, atol=1e-12)


def actor_of(loss):
    """The loss's policy as a module that acts."""

    def act(data):
        with loss.actor_network_params.to_module(loss.actor_network, preserve_module_state=False):
            torch.manual_seed(3)
            return loss.actor_network(data)

    return act


def test_ppo_weighs_and_sums():
    """The weighed advantage by hand, and the value losses of both costs."""
    results = []
    for costs in (BOTH, FIRST, SECOND):
        loss = on_policy(costs, RiskPPOLoss, normalize_advantage=False)
        data = batch_of(costs, 4, 10, policy=actor_of(loss))
        loss.begin(data)
        results.append((data, loss(data.reshape(-1))))
    (data, both), (first_data, first), (second_data, second) = results
    each = torch.cat([first_data["cost_advantage"], second_data["cost_advantage"]], -1)
    torch.testing.assert_close(data["cost_advantage"], each)
    weighed = data["advantage"] - (each * torch.tensor([0.7, 1.3])).sum(-1, keepdim=True)
    # The ratio is 1, so that the objective is minus the mean.
    torch.testing.assert_close(both["loss_objective"], -(weighed / 3.0).mean())
    for key in ("loss_cost", "loss_risk"):
        torch.testing.assert_close(both[key], first[key] + second[key])


@pytest.mark.parametrize(
    "make",
    [
        lambda init: DualAscent(init=init, lr=0.3, signed=True, maximum=1.5),
        lambda init: PIDMultiplier(kp=1.0, ki=0.5, kd=2.0, init=init, smoothing=2.0),
        lambda init: PIDMultiplier(kp=1.0, ki=0.5, init=init, exponential=True, swing=0.5),
    ],
)
def test_each_multiplier_moves_as_it_would_alone(make):
    torch.manual_seed(0)
    several, alone = make([0.5, 1.0, 1.5]), [make(init) for init in (0.5, 1.0, 1.5)]
    expanded = make(1.0).expand(3)
    same = make(1.0)
    for step in range(5):
        violation = torch.randn(7, 3, dtype=torch.float64)
        violation[step, 1] = torch.nan  # is left out of the second's mean alone
        several.update(several.penalty(violation))
        expanded.update(expanded.penalty(violation))
        for one, column in zip(alone, violation.unbind(-1), strict=True):
            one.update(one.penalty(column))
        same.update(same.penalty(violation[:, 2]))
        expected = torch.stack([one.value for one in alone])
        torch.testing.assert_close(several.value, expected, rtol=1e-12, atol=0)
        torch.testing.assert_close(expanded.value[2], same.value, rtol=1e-12, atol=0)
    assert make(1.0).expand(1).value.shape == ()  # one constraint stays a scalar


def test_the_projection_lowers_the_worst():
    """Two linear risks of two coordinates, of which each sample passes another limit, or none."""
    start = torch.tensor([[0.5, 0.0], [0.0, 0.8], [0.1, 0.1], [0.5, 0.8]])
    limit = torch.tensor([0.3, 0.6])
    result = project(lambda a: a, start, limit, penalty=10.0)
    expected = torch.tensor([[0.3, 0.0], [0.0, 0.6], [0.1, 0.1], [0.3, 0.6]])
    assert (result.action - expected).abs().max() <= 0.02 + 1e-6
    assert result.feasible.all() and result.intervened.tolist() == [True, True, False, True]
    assert torch.equal(result.risk_before, start) and torch.equal(result.risk_after, result.action)


@pytest.mark.parametrize("keep", ["last", "safest"])
def test_an_idle_limit_changes_no_projection(keep):
    torch.manual_seed(0)
    start = torch.rand(64, 2) * 2 - 1
    risk = lambda a: (a * a).sum(-1, keepdim=True)  # noqa: E731
    alone = project(risk, start, 0.3, keep=keep, penalty=0.5)
    for high in (IDLE, float("inf")):
        both = lambda a: torch.cat([risk(a), a.sum(-1, keepdim=True)], -1)  # noqa: E731
        two = project(both, start, torch.tensor([0.3, high]), keep=keep, penalty=0.5)
        assert torch.equal(two.action, alone.action) and torch.equal(two.steps, alone.steps)
        assert torch.equal(two.risk_after[:, 0], alone.risk_after)


def test_a_wrong_number_is_refused():
    with pytest.raises(ValueError, match=r"risk_limit must be a number, or 2 of them, got 3\."):
        off_policy(BOTH, risk_limit=[0.1, 0.2, 0.3])
    with pytest.raises(ValueError, match=r"risk_limit must be >= 0, got \[0.1, -1.0\]\."):
        off_policy(BOTH, risk_limit=[0.1, -1.0])
    with pytest.raises(ValueError, match=r"'cost'\) must be \[8, 2\], as many .* got \[8, 1\]\."):
        off_policy(BOTH)(batch_of(FIRST, 8))
    loss = on_policy(BOTH)
    with pytest.raises(ValueError, match=r"'cost'\) must be \[4, 10, 2\], .* got \[4, 10, 1\]\."):
        loss.begin(batch_of(FIRST, 4, 10))
    with pytest.raises(ValueError, match=r"init must be a number or 3 of them, got 2\."):
        LagrangeMultiplier(init=[1.0, 2.0]).expand(3)
    with pytest.raises(ValueError, match="cost_limit must be one number, as CPO's step has one"):
        CPOLoss(actor(), state_value("state_value"), state_value("c"), cost_limit=[0.1, 0.2])
    with pytest.raises(ValueError, match=r"shape \(3,\) or \(3, 2\) for actions"):
        project(lambda a: a[..., :1], torch.zeros(3, 2), torch.tensor([0.1, 0.2]))
