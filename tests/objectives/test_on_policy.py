"""PPO-Lagrangian and CPO against loops, hand-made formulas and dense linear algebra."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import kl_divergence
from torchrl.modules import TanhNormal
from torchrl.objectives import ClipPPOLoss, ValueEstimators

from saferl.modules import (
    DualAscent,
    MLPPolicyEncoder,
    StateValue,
    tanh_gaussian_actor,
    value_operator,
)
from saferl.objectives import CPOLoss, PPOLagLoss
from saferl.objectives.cpo import policy_kl
from saferl.objectives.trust_region import CASES, constrained_direction, flat

GAMMA, LAMBDA, SIZE = 0.9, 0.8, 3
LOSSES = {"ppo_lag": PPOLagLoss, "cpo": CPOLoss}


def encoder() -> MLPPolicyEncoder:
    return MLPPolicyEncoder(size=SIZE, width=8, depth=1)


def value(key: str):
    return value_operator(StateValue(encoder(), 8), in_keys=["observation"], out_key=key)


def build(kind: str = "ppo_lag", seed: int = 0, **settings):
    """A loss, and its actor as a module that acts."""
    torch.manual_seed(seed)
    actor = tanh_gaussian_actor(encoder(), 8, 2, in_keys=["observation"]).double()
    parts = actor, value("state_value").double(), value("state_cost_value").double()
    if kind == "ppo_lag":
        settings = {"lagrange": DualAscent(init=0.7)} | settings
    loss = LOSSES[kind](*parts, **settings)
    loss.make_value_estimator(ValueEstimators.GAE, gamma=GAMMA, lmbda=LAMBDA)
    return loss, actor


def batch_of(actor, envs: int = 4, steps: int = 7, seed: int = 1) -> TensorDict:
    """Transitions [B, T] in float64: an end by termination, one by truncation, and the rest cut off."""
    torch.manual_seed(seed)
    states = torch.randn(envs, steps + 1, SIZE, dtype=torch.float64)
    terminated = torch.zeros(envs, steps, 1, dtype=torch.bool)
    done = terminated.clone()
    terminated[0, 3] = done[0, 3] = done[1, 2] = True
    is_init = torch.zeros_like(done)
    is_init[:, 0] = True
    is_init[0, 4] = is_init[1, 3] = True
    following = {
        "observation": states[:, 1:],
        "reward": torch.randn(envs, steps, 1, dtype=torch.float64),
        "cost": torch.rand(envs, steps, 1, dtype=torch.float64),
        "done": done,
        "terminated": terminated,
    }
    data = {"observation": states[:, :-1], "is_init": is_init, "next": following}
    with torch.no_grad():
        return actor(TensorDict(data, [envs, steps]))


@pytest.mark.parametrize("kind", LOSSES)
def test_advantages_match_a_loop(kind: str):
    """Through a truncation with the value behind it, not through a termination; an episode's cost ends with it."""
    loss, actor = build(kind)
    data = batch_of(actor)
    # CPO moves the policy in the same call; the values that the advantages use do not move.
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
    }
    for term, owner in reach.items():
        if term not in out.keys():  # noqa: SIM118
            continue
        loss.zero_grad(set_to_none=True)
        out[term].backward(retain_graph=True)
        reached = {n.split(".")[0] for n, p in loss.named_parameters() if p.grad is not None}
        assert reached == {owner}


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
        super(CPOLoss, loss).begin(data)
        cost, weight = loss.cost_of_policy(data)
        finished = []
        for row in range(4):
            for t in range(7):
                played[row].append(float(data["next", "cost"][row, t]))
                if over[row, t]:
                    finished.append(played[row])
                    played[row] = []
        if finished:
            sums = [sum(c * gamma**t for t, c in enumerate(costs)) for costs in finished]
            weights = [sum(gamma**t for t in range(len(costs))) for costs in finished]
            known = 0.8 * known + torch.tensor(
                [sum(sums), sum(weights), len(finished)], dtype=torch.float64
            )
        if not known[2]:  # what was paid so far, and the critic of the rest
            with torch.no_grad(), loss.cost_critic_params.to_module(loss.cost_critic):
                rest = loss.cost_critic(data[:, -1]["next"].select("observation"))
            rest = gamma**7 * rest["state_cost_value"].squeeze(-1)
            sums = [sum(c * gamma**t for t, c in enumerate(costs)) for costs in played]
            assert float(cost) == pytest.approx(sum(sums) / 4 + float(rest.mean()))
        else:
            expected = (known[:2] / known[2]).tolist()
            assert (float(cost), float(weight)) == pytest.approx(expected)


def test_an_episode_whose_start_was_not_seen_does_not_count():
    """And batches of another shape are others' episodes; a loss that loads the state goes on with them."""
    loss, actor = build("cpo")
    data, over = batch_of(actor), torch.zeros(4, 7, dtype=torch.bool)
    over[0, 2] = True
    drive(data, over, torch.tensor([False, True, True, True]))
    super(CPOLoss, loss).begin(data)
    loss.cost_of_policy(data)
    assert loss.ended[2] == 0  # the only end is of an episode that began before
    over = torch.zeros(4, 7, dtype=torch.bool)
    over[1, 0] = True
    drive(data, over, torch.zeros(4, dtype=torch.bool))
    other, _ = build("cpo", seed=3)
    other.load_state_dict(loss.state_dict())
    costs = [*data["next", "cost"][1].squeeze(-1).tolist(), float(data["next", "cost"][1, 0])]
    expected = sum(cost * GAMMA**t for t, cost in enumerate(costs))
    for each in (loss, other):
        assert float(each.cost_of_policy(data)[0]) == pytest.approx(expected)
    (single := batch_of(actor, envs=2))["is_init"].zero_()
    assert float(loss.cost_of_policy(single)[0]) == pytest.approx(expected)
    assert loss.running.shape == (2, 4)


def test_cost_of_long_episodes_is_not_a_guess_of_the_critic():
    """A cost of 1 in each of 500 decisions, in batches of 64: the limit is seen to be broken at once."""
    loss, actor = build("cpo", cost_limit=30.0)
    loss.make_value_estimator(ValueEstimators.GAE, gamma=0.99, lmbda=0.95)
    for number in range(9):
        data = batch_of(actor, steps=64)
        data["next", "cost"].fill_(1.0)
        step = torch.arange(64 * number, 64 * number + 64) % 500
        drive(data, (step == 499).expand(4, 64), torch.full((4,), number == 0))
        loss.begin(data)
        out = loss(data.reshape(-1))
        assert out["cost_estimate"] > 40 and out["cpo_infeasible"] + out["cpo_recoverable"] == 1
    assert float(out["cost_estimate"]) == pytest.approx((1 - 0.99**500) / 0.01)


def test_the_violation_is_stated_per_decision():
    """(J_c - d) / w goes into the step (docs/pitfalls.md, 7)."""
    loss, actor = build("cpo", cost_limit=1.2)
    given = []
    loss._step = lambda batch, violation: given.append(float(violation))
    data = batch_of(actor)
    loss.begin(data)
    costs = data["next", "cost"].squeeze(-1)
    ended = costs[0, :4].tolist(), costs[1, :3].tolist()
    mean = sum(sum(c * GAMMA**t for t, c in enumerate(each)) for each in ended) / 2
    weight = sum(sum(GAMMA**t for t in range(len(each))) for each in ended) / 2
    assert given == [pytest.approx((mean - 1.2) / weight, rel=1e-5)]


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
def test_the_search_takes_the_longest_step_that_keeps_every_promise(case, violation, step, taken):
    loss, _ = build("cpo", trust=0.01, backtrack=0.5)
    parameters = [torch.zeros(1)]
    loss._surrogates = lambda batch, old: (
        tuple(map(torch.tensor, step(float(parameters[0]))))
        if parameters[0]
        else (torch.tensor(0.0), torch.tensor(0.0), torch.tensor(0.0))
    )
    loss._search(TensorDict(), None, parameters, torch.ones(1), case, violation)
    assert float(parameters[0]) == taken == float(loss.report[2])


def test_kl_of_squashed_policies():
    """Equal to that of the Gaussians, summed over an action's dimensions, and to samples."""
    torch.manual_seed(0)
    loc, scale = torch.randn(2, 5, 2), torch.rand(2, 5, 2) + 0.5
    old, new = (TanhNormal(loc[i], scale[i]) for i in range(2))
    normal = [torch.distributions.Normal(loc[i], scale[i]) for i in range(2)]
    ours = policy_kl(old, new)
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
    super(CPOLoss, loss).begin(data)
    limit = max(float(loss.cost_of_policy(data)[0]) + above, 0.0)
    loss, actor = build("cpo", cost_limit=limit, trust=0.02, damping=0.01)
    data = batch_of(actor, envs=64)
    before = policy(loss)
    data_flat = data.reshape(-1)
    with loss.actor_network_params.to_module(loss.actor_network), torch.no_grad():
        old = loss.actor_network.get_dist(data_flat.select("observation"))
    loss.begin(data)
    out = loss(data.reshape(-1))
    (case,) = (name for name in CASES if out[f"cpo_{name}"] == 1)
    with torch.no_grad():
        reward, cost, kl = loss._surrogates(data.reshape(-1), old)
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
    super(CPOLoss, loss).begin(data)
    flat_data = data.reshape(-1)
    parameters = list(loss.actor_network_params.values(True, True))
    with loss.actor_network_params.to_module(loss.actor_network), torch.no_grad():
        old = loss.actor_network.get_dist(flat_data.select("observation"))
    reward, price, kl = loss._surrogates(flat_data, old)
    g, b = (
        flat(torch.autograd.grad(term, parameters, retain_graph=True)) for term in (reward, price)
    )
    first = flat(torch.autograd.grad(kl, parameters, create_graph=True))
    rows = [flat(torch.autograd.grad(each, parameters, retain_graph=True)) for each in first]
    H = torch.stack(rows) + 0.1 * torch.eye(len(first), dtype=torch.float64)

    tried = {}
    loss._search = lambda batch, old, parameters, step, case, c: tried.update(step=step, case=case)
    loss._step(flat_data, torch.tensor(violation))
    x = tried["step"]
    dense = constrained_direction(g, b, violation, lambda v: torch.linalg.solve(H, v), loss.trust)
    assert tried["case"] == dense.case == case
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
    surrogates, calls = loss._surrogates, []

    def broken(batch, old):
        calls.append(None)
        values = surrogates(batch, old)
        return values if len(calls) <= 2 else tuple(value * math.nan for value in values)

    loss._surrogates = broken
    loss.begin(data)
    assert torch.equal(policy(loss), before)
    out = loss(data.reshape(-1))
    assert out["step_fraction"] == 0 and out["kl"] == 0
    assert len(calls) == 2 + loss.search_steps


@pytest.mark.parametrize("kind", LOSSES)
def test_refuses(kind: str):
    loss, actor = build(kind)
    data = batch_of(actor)
    with pytest.raises(KeyError, match=r"no entry \('next', 'cost'\)"):
        loss.begin(data.exclude(("next", "cost")))
    with pytest.raises(ValueError, match=r"gamma must be in \[0, 1\], got 2"):
        loss.make_value_estimator(ValueEstimators.GAE, gamma=2, lmbda=0.9)


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
    for key, value in zip(loss.out_keys, outputs, strict=True):
        torch.testing.assert_close(value, expected[key], equal_nan=True)
    # No more and no less than these is read.
    assert set(loss(flat_data.select(*loss.in_keys)).keys()) == set(expected.keys())


@pytest.mark.parametrize("kind", LOSSES)
def test_a_batch_that_begin_has_not_seen(kind: str):
    loss, actor = build(kind)
    with pytest.raises(KeyError, match=r"no entry '\w+': loss.begin"):
        loss(batch_of(actor).reshape(-1))


def test_cpo_leaves_parameters_that_the_policy_does_not_use():
    torch.manual_seed(0)
    actor = tanh_gaussian_actor(encoder(), 8, 2, in_keys=["observation"]).double()
    spare = torch.nn.Parameter(torch.ones(3, dtype=torch.float64))
    actor.module[0].register_parameter("spare", spare)
    values = value("state_value").double(), value("state_cost_value").double()
    loss = CPOLoss(actor, *values, cost_limit=100.0)
    loss.begin(batch_of(actor))
    assert loss.report[2] > 0 and (spare == 1).all()


def test_ppo_lag_refuses():
    with pytest.raises(ValueError, match="lagrange must be a LagrangeMultiplier, got 1.0"):
        build(lagrange=1.0)
    with pytest.raises(ValueError, match="clip_epsilon must be > 0, got -1"):
        build(clip_epsilon=-1)


def test_cpo_needs_to_know_where_episodes_begin():
    loss, actor = build("cpo")
    with pytest.raises(KeyError, match=r"no entry 'is_init'.*InitTracker"):
        loss.begin(batch_of(actor).exclude("is_init"))


def test_keys_can_be_renamed():
    loss, actor = build("cpo")
    loss.set_keys(cost="price")
    data = batch_of(actor)
    data.rename_key_(("next", "cost"), ("next", "price"))
    loss.begin(data)
    assert loss(data.reshape(-1))["loss_cost"].isfinite()
