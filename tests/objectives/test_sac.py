"""What every loss of TorchRL passes: gradients, keys, state, vmap and compilation."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch
from outputs import LOSSES, SCALARS, assert_same, run
from torch import nn
from torchrl.objectives import SoftUpdate, ValueEstimators
from torchrl.objectives.value import TD0Estimator

from saferl.modules import BoundCritics, DualAscent, PIDMultiplier
from saferl.objectives import SACLagLoss

# Gradients and state


@pytest.mark.parametrize(
    ("term", "owner"),
    [
        ("loss_actor", "actor_network_params"),
        ("loss_qvalue", "qvalue_network_params"),
        ("loss_cost", "cost_critic_params"),
        ("loss_alpha", "log_alpha"),
    ],
)
def test_each_loss_trains_its_own_parameters_only(make_loss, make_batch, term, owner):
    loss = make_loss(risk_limit=0.0)
    output = run(loss, make_batch())
    assert output["constraint_violation"] > 0
    before = {name: value.clone() for name, value in loss.state_dict().items()}
    output[term].backward()
    grads = {name: leaf.grad is not None for name, leaf in loss.named_parameters()}
    assert any(grads.values())
    assert grads == {name: name.startswith(owner) for name in grads}
    assert all(leaf.grad is None for leaf in loss.buffers())
    # Neither does computing a loss move a target, the multiplier or anything else.
    for name, value in loss.state_dict().items():
        torch.testing.assert_close(value, before[name])


def test_metrics_carry_no_gradient_and_the_batch_gains_only_its_priority(make_loss, make_batch):
    loss, batch = make_loss(), make_batch()
    before = batch.clone()
    output = loss(batch)
    assert all(value.requires_grad == (key in LOSSES) for key, value in output.items())
    assert set(batch.keys(True)) == {*before.keys(True), "td_error"}
    assert batch["td_error"].shape == batch.shape
    for key, value in before.items(True, True):
        torch.testing.assert_close(batch[key], value)


def test_state_dict_fills_a_fresh_loss(make_loss, make_batch):
    loss, batch = make_loss(seed=0), make_batch()
    run(loss, batch)
    loss.lagrange.update(torch.tensor(3.0))
    state = deepcopy(loss.state_dict())
    for part in ("target_qvalue_network_params", "target_cost_critic_params", "lagrange.value"):
        assert any(name.startswith(part) for name in state)
    fresh = make_loss(seed=7, gamma=0.5, risk_limit=0.9, lagrange=DualAscent(init=0.1))
    view = fresh.cost_value
    fresh.load_state_dict(state, strict=True)
    assert_same(run(loss, batch), run(fresh, batch))
    torch.testing.assert_close(
        view(batch.clone())["state_action_cost_value"],
        loss.cost_value(batch.clone())["state_action_cost_value"],
    )


def test_a_loss_loads_before_its_first_call_and_its_first_make_value_estimator(
    make_loss, make_actor, make_critic, make_batch
):
    loss, batch = make_loss(), make_batch()
    fresh = SACLagLoss(
        make_actor(),
        make_critic("state_action_value"),
        make_critic("state_action_cost_value"),
        lagrange=DualAscent(),
    )
    SoftUpdate(fresh, tau=0.1)
    fresh.load_state_dict(loss.state_dict(), strict=True)
    assert_same(run(loss, batch), run(fresh, batch))


def test_state_of_another_multiplier_is_kept(make_loss):
    loss = make_loss(lagrange=PIDMultiplier(kp=1.0, ki=0.5))
    loss.lagrange.update(torch.tensor(0.4))
    fresh = make_loss(lagrange=PIDMultiplier(kp=1.0, ki=0.5))
    fresh.load_state_dict(loss.state_dict(), strict=True)
    for name, value in loss.lagrange.state_dict().items():
        torch.testing.assert_close(fresh.lagrange.state_dict()[name], value)


def test_cost_value_reads_the_live_members_and_adds_no_state(make_loss, make_batch):
    loss, batch = make_loss(), make_batch()
    names = [name for name, _ in loss.named_parameters()], list(loss.state_dict())
    view = loss.cost_value
    assert names == ([name for name, _ in loss.named_parameters()], list(loss.state_dict()))
    assert not list(view.parameters()) and not view.state_dict()
    for _ in range(2):
        value = view(batch.clone())["state_action_cost_value"]
        members = []
        for params in loss.cost_critic_params.data.unbind(0):
            with params.to_module(loss.cost_critic, preserve_module_state=False):
                members.append(loss.cost_critic(batch.clone())["state_action_cost_value"])
        torch.testing.assert_close(value, torch.maximum(*members))
        optimizer = torch.optim.SGD(loss.parameters(), lr=0.5)
        run(loss, batch)["loss_cost"].backward()
        optimizer.step()
        assert not torch.allclose(view(batch.clone())["state_action_cost_value"], value)


def test_soft_update_moves_both_kinds_of_target(make_loss, make_batch):
    loss = make_loss()
    updater = SoftUpdate(loss, tau=0.25)  # starts from targets equal to the critics
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.1)
    for kind in ("qvalue_network", "cost_critic"):
        before = getattr(loss, f"target_{kind}_params").data.clone()
        run(loss, make_batch())[{"qvalue_network": "loss_qvalue"}.get(kind, "loss_cost")].backward()
        optimizer.step()
        source = getattr(loss, f"{kind}_params").data.clone()
        updater.step()
        after = getattr(loss, f"target_{kind}_params").data
        for key, value in after.items(True, True):
            torch.testing.assert_close(value, 0.75 * before[key] + 0.25 * source[key])
            assert not torch.equal(value, before[key])


def test_lists_of_critics_keep_their_initial_parameters(make_loss, make_critic):
    reward = [make_critic("state_action_value") for _ in range(3)]
    cost = [make_critic("state_action_cost_value") for _ in range(4)]
    loss = make_loss(qvalue_network=reward, cost_critic=cost, num_qvalue_nets=3, num_cost_critics=4)
    for params, members in (
        (loss.qvalue_network_params, reward),
        (loss.cost_critic_params, cost),
    ):
        for i, member in enumerate(members):
            for name, value in member.named_parameters():
                torch.testing.assert_close(params[tuple(name.split("."))][i], value)


def test_members_made_from_one_module_differ(make_loss, make_batch):
    loss = make_loss()
    values = loss.cost_value.values(make_batch())
    assert not torch.allclose(values[0], values[1])


@pytest.mark.parametrize("separate", [True, False])
def test_separate_losses_leave_shared_parameters_to_the_policy(
    make_loss, make_actor, make_critic, make_batch, separate
):
    policy, cost_critic = make_actor(), make_critic("state_action_cost_value")
    # A critic that reads the policy's hidden layer, as one with a shared encoder does.
    shared = policy.get_submodule("module.0.module.hidden")

    class Shared(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.encoder, self.head = shared, nn.Linear(8, 1)

        def forward(self, observation, action):
            return self.head(torch.cat([self.encoder(observation).tanh(), action], -1))

    cost_critic.module = Shared()
    loss = make_loss(actor_network=policy, cost_critic=cost_critic, separate_losses=separate)
    run(loss, make_batch())["loss_cost"].backward()
    trained = {
        key[1] for key, leaf in loss.cost_critic_params.items(True, True) if leaf.requires_grad
    }
    assert trained == ({"head"} if separate else {"head", "encoder"})
    assert shared.weight.grad is None


def test_without_delay_the_targets_are_the_critics(make_actor, make_critic, make_batch):
    loss = SACLagLoss(
        make_actor(),
        make_critic("state_action_value"),
        make_critic("state_action_cost_value"),
        lagrange=DualAscent(),
        delay_qvalue=False,
    )
    assert not any(name.startswith("target_") for name in loss.state_dict())
    loss.cost_critic_params.data.zero_()
    batch = make_batch()
    value, _ = loss.cost_loss(batch)
    torch.testing.assert_close(value, (batch["next", "cost"] ** 2).mean())


# Keys


def test_renamed_keys_reach_both_value_estimators(make_loss, make_actor, make_critic, make_batch):
    names = {
        "reward": "profit",
        "cost": ("info", "price"),
        "terminated": ("info", "final"),
        "done": "over",
        "action": "move",
        "state_action_value": "q",
        "state_action_cost_value": "qc",
        "priority": "surprise",
    }
    loss = make_loss(
        actor_network=make_actor(action="move"),
        qvalue_network=make_critic("q", action="move"),
        cost_critic=make_critic("qc", action="move"),
    )
    loss.set_keys(**names)
    loss.load_state_dict(make_loss().state_dict())
    batch = make_batch()
    renamed = batch.clone()
    renamed.rename_key_("action", "move")
    for key in ("reward", "cost", "terminated", "done"):
        renamed.rename_key_(("next", key), ("next", names[key]))
    assert_same(run(loss, renamed), run(make_loss(), batch))
    # A later make_value_estimator keeps them; None restores a default.
    loss.make_value_estimator(gamma=0.9)
    assert_same(run(loss, renamed), run(make_loss(), batch))
    for estimator, key in ((loss.value_estimator, "profit"), (loss._cost_value_estimator, "price")):
        assert key in estimator.tensor_keys.reward
        assert estimator.tensor_keys.terminated == ("info", "final")
        assert estimator.tensor_keys.done == "over"
    assert {"move", ("next", "profit"), ("next", "info", "price")} <= set(loss.in_keys)
    assert ("next", "cost") not in loss.in_keys
    loss.set_keys(cost=None)
    assert loss._cost_value_estimator.tensor_keys.reward == "cost"
    output = loss(renamed.set(("next", "cost"), renamed["next", "info", "price"]))
    assert "surprise" in renamed and set(LOSSES) <= set(output.keys())


def test_default_keys(make_loss):
    loss = make_loss()
    assert loss.tensor_keys.cost == "cost"
    assert loss.tensor_keys.state_action_cost_value == "state_action_cost_value"
    assert loss.tensor_keys.reward == "reward"
    with pytest.raises(ValueError, match="price is not an accepted"):
        loss.set_keys(price="cost")


# Execution


@pytest.mark.parametrize("reduction", ["mean", "none"])
def test_a_loop_over_members_equals_vmap(make_loss, make_batch, monkeypatch, reduction):
    """Where the members are stacked, as on a GPU, and where they are not."""
    losses = [make_loss(reduction=reduction, num_cost_critics=3) for _ in range(2)]
    looped = run(losses[1], make_batch())
    bind = BoundCritics.of
    monkeypatch.setattr(BoundCritics, "of", lambda *args, **kw: bind(*args, **kw | {"vmap": True}))
    vmapped = run(losses[0], make_batch())
    assert_same(vmapped, looped)
    for output in (vmapped, looped):
        sum(output[key].sum() for key in LOSSES).backward()
    pairs = zip(losses[0].named_parameters(), losses[1].named_parameters(), strict=True)
    for (name, left), (other, right) in pairs:
        assert name == other
        torch.testing.assert_close(left.grad, right.grad)


def test_dropout_in_the_cost_critic_alone(make_loss, make_critic, make_batch):
    loss = make_loss(cost_critic=make_critic("state_action_cost_value", dropout=0.5))
    assert run(loss, make_batch())["loss_cost"].isfinite()


@pytest.mark.parametrize(
    "backend",
    # The capture alone takes seconds; generating code takes up to a minute.
    ["eager", pytest.param("inductor", marks=pytest.mark.slow)],
)
def test_compiled_equals_eager(make_loss, make_batch, backend):
    """The loss is one graph, which keeps reading the buffers."""
    eager, loss = make_loss(), make_loss()
    # A scalar of float64 among the inputs makes the compiler analyse everything twice.
    loss.lagrange.float()
    # The generated code would draw its own numbers.
    options = {"fallback_random": True} if backend == "inductor" else None
    compiled = torch.compile(loss, fullgraph=True, backend=backend, options=options)
    for step in range(2):
        batch = make_batch(seed=step)
        torch.manual_seed(step)
        output, expected = compiled(batch.clone()), run(eager, batch, seed=step)
        for key in (*LOSSES, *SCALARS, "constraint_violation"):
            assert output[key].item() == pytest.approx(expected[key].item(), rel=1e-5, abs=1e-5)
        for values in (output, expected):
            sum(values[key] for key in LOSSES).backward()
        for left, right in zip(loss.parameters(), eager.parameters(), strict=True):
            torch.testing.assert_close(left.grad, right.grad, rtol=1e-5, atol=1e-5)
        for module in (eager, loss):
            module.lagrange.update(torch.tensor(5e3))
    torch._dynamo.reset()


def test_to_double_after_use(make_loss, make_batch):
    loss = make_loss()
    run(loss, make_batch())
    output = run(
        loss.double(), make_batch().apply(lambda x: x.double() if x.is_floating_point() else x)
    )
    assert all(output[key].dtype == torch.float64 for key in LOSSES)


# Errors


def test_a_batch_without_cost_is_told_apart(make_loss, make_batch):
    batch = make_batch()
    del batch["next", "cost"]
    with pytest.raises(KeyError, match=r"set_keys\(cost=...\)"):
        make_loss()(batch)


def test_value_estimators(make_loss, make_batch):
    loss, batch = make_loss(gamma=0.7), make_batch()
    expected = run(loss, batch)
    loss.make_value_estimator(TD0Estimator(gamma=0.7, value_network=None))
    assert_same(run(loss, batch), expected)
    loss.make_value_estimator(TD0Estimator, gamma=0.7, value_network=None)
    assert_same(run(loss, batch), expected)
    with pytest.raises(NotImplementedError, match="TD0"):
        loss.make_value_estimator(ValueEstimators.TDLambda)
