"""CPO against lists of costs, hand-made steps and dense linear algebra."""

from __future__ import annotations

import math

import pytest
import torch
from on_policy import GAMMA, batch_of, build, encoder, value
from tensordict import TensorDict
from torch.distributions import kl_divergence
from torchrl.modules import TanhNormal
from torchrl.objectives import ValueEstimators

from saferl.modules import tanh_gaussian_actor
from saferl.objectives import CPOLoss, TrustRegionStep
from saferl.objectives.policy_step import assign
from saferl.objectives.trust_region import CASES, Direction, constrained_direction, flat


def drive(data: TensorDict, over: torch.Tensor, previous: torch.Tensor) -> None:
    """Let the episodes of a batch end where ``over`` [B, T] says, the next ones begin behind; ``previous`` [B] is
    whether the step before the batch ended one."""
    data["next", "done"] = over.unsqueeze(-1)
    data["is_init"] = torch.cat([previous[:, None], over[:, :-1]], 1).unsqueeze(-1)


@pytest.mark.parametrize("gamma", [GAMMA, 1.0])
def test_cost_of_the_policy_is_that_of_whole_episodes(gamma: float):
    """Against lists of costs, over several batches: each episode from its start to its end, the later the heavier."""
    loss, actor = build("cpo")
    loss.make_value_estimator(ValueEstimators.GAE, gamma=gamma, lmbda=0.95)
    played: list[list[float]] = [[] for _ in range(4)]
    previous, known = torch.ones(4, dtype=torch.bool), torch.zeros(3, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    for number in range(12):
        data = batch_of(actor, seed=number)
        over = torch.rand(4, 7, generator=generator) < (0.0 if number in (0, 5) else 0.1)
        drive(data, over, previous)
        previous = over[:, -1]
        loss.begin(data)
        cost, decisions = loss.cost_of_policy(data)
        finished = []
        for row in range(4):
            for t in range(7):
                played[row].append(float(data["next", "cost"][row, t]))
                if over[row, t]:
                    finished.append(played[row])
                    played[row] = []
        if finished:
            sums = [sum(map(sum, finished)), sum(map(len, finished)), len(finished)]
            known = 0.8 * known + torch.tensor(sums, dtype=torch.float64)
        if not known[2]:  # what was paid so far, and the critic of the rest
            with torch.no_grad(), loss.cost_critic_params.to_module(loss.cost_critic):
                rest = loss.cost_critic(data[:, -1]["next"].select("observation"))
            expected = sum(map(sum, played)) / 4 + float(rest["state_cost_value"].mean())
            assert float(cost) == pytest.approx(expected)
            ahead = 0 if gamma == 1 else 1 / (1 - gamma)  # of an episode without an end
            assert float(decisions) == pytest.approx(7 + ahead)
        else:
            expected = (known[:2] / known[2]).tolist()
            assert (float(cost), float(decisions)) == pytest.approx(expected)


def test_an_episode_whose_start_was_not_seen_does_not_count():
    """And batches of another shape are others' episodes; a loss that loads the state goes on with them."""
    loss, actor = build("cpo")
    data, over = batch_of(actor), torch.zeros(4, 7, dtype=torch.bool)
    over[0, 2] = True
    drive(data, over, torch.tensor([False, True, True, True]))
    loss.begin(data)
    loss.cost_of_policy(data)
    assert loss.episodes.count == 0  # the only end is of an episode that began before
    over = torch.zeros(4, 7, dtype=torch.bool)
    over[1, 0] = True
    drive(data, over, torch.zeros(4, dtype=torch.bool))
    other, _ = build("cpo", seed=3)
    other.load_state_dict(loss.state_dict())
    costs = [*data["next", "cost"][1].squeeze(-1).tolist(), float(data["next", "cost"][1, 0])]
    for each in (loss, other):
        assert float(each.cost_of_policy(data)[0]) == pytest.approx(sum(costs))
    (single := batch_of(actor, envs=2))["is_init"].zero_()
    assert float(loss.cost_of_policy(single)[0]) == pytest.approx(sum(costs))
    assert loss.episodes.running.shape == (2, 3)


def test_cost_of_long_episodes_is_not_a_guess_of_the_critic():
    """A cost of 1 in each of 500 decisions, in batches of 64: the limit is seen to be broken at once."""
    loss, actor = build("cpo", cost_limit=30.0)
    step = loss.policy_step()
    loss.make_value_estimator(ValueEstimators.GAE, gamma=0.99, lmbda=0.95)
    for number in range(9):
        data = batch_of(actor, steps=64)
        data["next", "cost"].fill_(1.0)
        decision = torch.arange(64 * number, 64 * number + 64) % 500
        drive(data, (decision == 499).expand(4, 64), torch.full((4,), number == 0))
        loss.begin(data)
        step.step(data)
        out = loss(data.reshape(-1))
        assert out["cost_estimate"] > 40 and out["cpo_infeasible"] + out["cpo_recoverable"] == 1
    assert float(out["cost_estimate"]) == pytest.approx(500)


def test_the_violation_is_stated_per_decision():
    """(J_c - d) / L goes into the step (docs/pitfalls.md, 7)."""
    loss, actor = build("cpo", cost_limit=1.2)
    step, given = loss.policy_step(), []
    step.move = lambda batch, violation: given.append(violation) or (0.0, 0.0, "feasible")
    data = batch_of(actor)
    loss.begin(data)
    step.step(data)
    costs = data["next", "cost"].squeeze(-1)
    ended = costs[0, :4].tolist(), costs[1, :3].tolist()
    assert given == [pytest.approx((sum(map(sum, ended)) / 2 - 1.2) / 3.5, rel=1e-5)]


def test_the_margin_grows_with_what_steps_exceed():
    """By its share of each excess, down again with a shortage, between 0 and the limit; none as published."""
    loss, actor = build("cpo", cost_limit=1.0, margin_rate=0.5)
    step, given = loss.policy_step(), []
    step.move = lambda batch, violation: given.append(violation) or (0.0, 0.0, "feasible")
    data = batch_of(actor)
    loss.begin(data)
    course, margin, expected = [1.4, 1.8, 5.0, 0.0, 0.0], 0.0, []
    for cost in course:
        loss.cost_of_policy = lambda data, cost=cost: (torch.tensor(cost), torch.tensor(4.0))
        step.step(data)
        expected.append((cost - 1.0 + margin) / 4)
        margin = min(max(margin + 0.5 * (cost - 1.0), 0.0), 1.0)
        assert float(loss.margin) == pytest.approx(margin)
    assert given == pytest.approx(expected) and "margin" in loss.state_dict()
    assert float(build("cpo")[0].margin_rate) == 0.0


@pytest.mark.parametrize(
    ("case", "violation", "step", "taken"),
    [
        # reward, cost and KL of a fraction of the step; what it must satisfy, and where that first holds
        ("feasible", -0.1, lambda f: (f, 0.0, 0.0), 1.0),
        ("feasible", -0.1, lambda f: (-1.0 if f > 0.5 else 0.0, 0.0, 0.0), 0.5),
        ("infeasible", 0.1, lambda f: (-1.0, -f, 0.0), 1.0),
        ("recoverable", 0.1, lambda f: (-1.0, -f, 0.0), 1.0),
        ("feasible", -0.1, lambda f: (f, 0.11 if f > 0.5 else 0.09, 0.0), 0.5),
        ("infeasible", 0.1, lambda f: (f, 0.09 if f > 0.5 else 0.0, 0.0), 0.5),
        ("feasible", -0.1, lambda f: (f, 0.0, 0.011 if f > 0.5 else 0.009), 0.5),
        ("feasible", -0.1, lambda f: (math.nan if f > 0.5 else f, 0.0, 0.0), 0.5),
    ],
)
def test_the_search_takes_the_longest_step_that_keeps_every_promise(
    case, violation, step, taken, monkeypatch
):
    loss, _ = build("cpo", trust=0.01, backtrack=0.5)
    parameter = torch.zeros(1)
    monkeypatch.setattr(TrustRegionStep, "policy_parameters", [parameter])
    loss.surrogates = lambda batch, old: (
        tuple(map(torch.tensor, step(float(parameter))))
        if parameter
        else (torch.tensor(0.0), torch.tensor(0.0), torch.tensor(0.0))
    )
    found = Direction(torch.ones(1), case, 1.0, 0.0)
    kl, fraction = loss.policy_step().search(TensorDict(), None, found, violation)
    assert float(parameter) == taken == fraction
    assert kl == pytest.approx(step(taken)[2])


def test_kl_of_squashed_policies():
    """torch's is that of the Gaussians, summed over an action's dimensions, and of samples."""
    torch.manual_seed(0)
    loc, scale = torch.randn(2, 5, 2), torch.rand(2, 5, 2) + 0.5
    options = {"low": -1.0, "high": 1.0, "safe_tanh": True}  # as our policies have them
    old, new = (TanhNormal(loc[i], scale[i], **options) for i in range(2))
    normal = [torch.distributions.Normal(loc[i], scale[i]) for i in range(2)]
    ours = kl_divergence(old, new)
    torch.testing.assert_close(ours, kl_divergence(*normal).sum(-1))
    action = old.sample((40_000,))
    sampled = old.log_prob(action) - new.log_prob(action)
    error = sampled.std(0) / 200
    assert ((sampled.mean(0) - ours).abs() < 5 * error).all()


def policy(loss) -> torch.Tensor:
    return flat(p.detach() for p in loss.actor_network_params.values(True, True))


@pytest.mark.parametrize("above", [-10.0, -0.02, 0.02, 10.0])
def test_a_step_keeps_what_it_promises(above: float):
    """With the limit far or little above or below what the policy costs."""
    loss, actor = build("cpo", trust=0.02, damping=0.01)
    data = batch_of(actor, envs=64)
    loss.begin(data)
    limit = max(float(loss.cost_of_policy(data)[0]) + above, 0.0)
    loss, actor = build("cpo", cost_limit=limit, trust=0.02, damping=0.01)
    data = batch_of(actor, envs=64)
    before = policy(loss)
    data_flat = data.reshape(-1)
    with loss.actor_network_params.to_module(loss.actor_network), torch.no_grad():
        old = loss.actor_network.get_dist(data_flat.select("observation"))
    loss.begin(data)
    assert torch.equal(policy(loss), before)  # the step alone moves it
    loss.policy_step().step(data)
    out = loss(data.reshape(-1))
    (case,) = (name for name in CASES if out[f"cpo_{name}"] == 1)
    with torch.no_grad():
        reward, cost, kl = loss.surrogates(data.reshape(-1), old)
    assert kl <= loss.trust and float(out["kl"]) == pytest.approx(float(kl), rel=1e-4)
    assert float(out["step_fraction"]) > 0 and not torch.equal(policy(loss), before)
    start = float(out["cost_estimate"])
    if start > limit:
        assert case in ("recoverable", "infeasible") and cost < 0
    else:
        assert case in ("unconstrained", "feasible") and reward > 0


@pytest.mark.parametrize(
    ("case", "violation"),
    [("unconstrained", -10.0), ("feasible", -1e-3), ("recoverable", 1e-3), ("infeasible", 10.0)],
)
def test_fisher_products_and_direction_match_dense_algebra(case: str, violation: float):
    """The step that is tried first is the closed-form solution of the quadratic problem (1e-5)."""
    loss, actor = build("cpo", damping=0.1, cg_steps=200)
    data = batch_of(actor, envs=16)
    loss.begin(data)
    flat_data = data.reshape(-1)
    parameters = list(loss.actor_network_params.values(True, True))
    with loss.actor_network_params.to_module(loss.actor_network), torch.no_grad():
        old = loss.actor_network.get_dist(flat_data.select("observation"))
    reward, price, kl = loss.surrogates(flat_data, old)
    g, b = (
        flat(torch.autograd.grad(term, parameters, retain_graph=True)) for term in (reward, price)
    )
    first = flat(torch.autograd.grad(kl, parameters, create_graph=True))
    rows = [flat(torch.autograd.grad(each, parameters, retain_graph=True)) for each in first]
    H = torch.stack(rows) + 0.1 * torch.eye(len(first), dtype=torch.float64)

    tried = loss.policy_step().direction(flat_data, old, violation)
    x = tried.step
    dense = constrained_direction(g, b, violation, lambda v: torch.linalg.solve(H, v), loss.trust)
    assert tried.case == dense.case == case
    assert (x - dense.step).norm() <= 1e-5 * dense.step.norm() > 0
    # Optimality of a convex problem, with multipliers fitted to the solution.
    assert 0.5 * x @ H @ x <= loss.trust * (1 + 1e-5)
    least = violation - float(torch.sqrt(2 * loss.trust * b @ torch.linalg.solve(H, b)))
    if case == "infeasible":  # all that the region has against the cost
        assert float(violation + b @ x) == pytest.approx(least, rel=1e-5) and least > 0
    else:
        assert violation + b @ x <= 1e-5 * b.norm() * x.norm() and least <= 0
    basis = torch.stack([(case != "infeasible") * g, -b], 1)
    weights = torch.linalg.lstsq(basis, (H @ x)[:, None], driver="gelsd").solution.squeeze(-1)
    assert (basis @ weights - H @ x).norm() <= 1e-4 * (H @ x).norm()
    assert (weights >= -1e-6 * weights.abs().max()).all()


def test_a_failed_search_restores_the_policy():
    """Also where the surrogates are not finite (docs/pitfalls.md, 7)."""
    loss, actor = build("cpo", cost_limit=100.0)
    data = batch_of(actor)
    before = policy(loss)
    surrogates, calls = loss.surrogates, []

    def broken(batch, old):
        calls.append(None)
        values = surrogates(batch, old)
        return values if len(calls) <= 2 else tuple(value * math.nan for value in values)

    loss.surrogates = broken
    loss.begin(data)
    loss.policy_step().step(data)
    assert torch.equal(policy(loss), before)
    out = loss(data.reshape(-1))
    assert out["step_fraction"] == 0 and out["kl"] == 0
    assert len(calls) == 2 + loss.search_steps


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"trust": 0.0}, "trust must be > 0, got 0.0"),
        ({"cost_limit": -1}, "cost_limit must be >= 0, got -1"),
        ({"damping": math.nan}, "damping must be > 0, got nan"),
        ({"cg_steps": 0}, "cg_steps must be >= 1, got 0"),
        ({"search_steps": 0}, "search_steps must be >= 1, got 0"),
        ({"backtrack": 1.0}, r"backtrack must be in \(0, 1\), got 1.0"),
    ],
)
def test_cpo_refuses(setting: dict, message: str):
    with pytest.raises(ValueError, match=message):
        build("cpo", **setting)


def test_cpo_leaves_parameters_that_the_policy_does_not_use():
    torch.manual_seed(0)
    actor = tanh_gaussian_actor(encoder(), 8, 2, in_keys=["observation"]).double()
    spare = torch.nn.Parameter(torch.ones(3, dtype=torch.float64))
    actor.module[0].register_parameter("spare", spare)
    values = value("state_value").double(), value("state_cost_value").double()
    loss = CPOLoss(actor, *values, cost_limit=100.0)
    data = batch_of(actor)
    loss.begin(data)
    loss.policy_step().step(data)
    assert loss.report[2] > 0 and (spare == 1).all()


def test_cpo_needs_to_know_where_episodes_begin():
    loss, actor = build("cpo")
    with pytest.raises(KeyError, match=r"no entry 'is_init'.*InitTracker"):
        loss.begin(batch_of(actor).exclude("is_init"))


def test_parameters_are_written_where_they_lie():
    """What holds their memory, a compiled graph or a view of them, sees the step."""
    parameters = [torch.nn.Parameter(torch.zeros(2, 3)), torch.nn.Parameter(torch.zeros(()))]
    places = [parameter.data_ptr() for parameter in parameters]
    assign(parameters, torch.arange(7.0))
    assert torch.equal(flat(parameters), torch.arange(7.0))
    assert [parameter.data_ptr() for parameter in parameters] == places
    # A tensor that lies transposed keeps its order, where a view of it would fail.
    assert flat([torch.arange(6).reshape(2, 3).T]).tolist() == [0, 3, 1, 4, 2, 5]
