"""The losses against OmniSafe 0.5.0, on the weights and batches that its own code was run on.

``tests/fixtures/omnisafe.json`` holds both, and is written by ``benchmarks/omnisafe_losses.py``. Everything
agrees to 1e-5. Where OmniSafe's form is another one, the test asks ours for that form by an option, or states
the exact factor between the two; the one difference that is more than a form is the direction of CPO's step in
its two quadratic cases (``test_omnisafe_cpo.py``).
"""

from __future__ import annotations

import math

import pytest
import torch
from omnisafe_fixture import (
    ACTION_VALUE,
    FIXTURE,
    STATE_VALUE,
    SquashedHead,
    action_value,
    actor,
    assert_agrees,
    assert_critic_gradients_agree,
    assert_gradients_agree,
    named,
    on_policy,
    set_members,
    with_their_advantages,
)
from tensordict import TensorDict
from torch import Tensor
from torchrl.objectives import SoftUpdate

from saferl.modules import DualAscent
from saferl.objectives import SACLagLoss
from saferl.objectives.adapter import PPOTerms


@pytest.fixture(autouse=True)
def float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


# SACLag.


@pytest.fixture
def draws(monkeypatch):
    """Function that says what the next draws of a standard normal distribution are."""
    queue: list[Tensor] = []

    def draw(shape, dtype, device):
        taken = queue.pop(0)
        assert taken.shape == shape and taken.dtype == dtype
        return taken

    monkeypatch.setattr("torch.distributions.normal._standard_normal", draw)
    return queue.extend


@pytest.fixture
def sac() -> tuple[SACLagLoss, TensorDict]:
    found = FIXTURE["sac_lag"]
    settings, weights, batch = found["settings"], found["weights"], found["batch"]
    loss = SACLagLoss(
        actor(SquashedHead(), weights["actor"]),
        action_value("state_action_value"),
        action_value("state_action_cost_value"),
        num_qvalue_nets=2,
        num_cost_critics=1,  # OmniSafe has one
        alpha_init=settings["alpha"],
        target_entropy=settings["target_entropy"],
        # OmniSafe penalises the cost itself and divides the loss by 1 + lambda.
        lagrange=DualAscent(init=settings["lagrangian_multiplier"], signed=True),
        risk_limit=0.0,
        rescale=True,
    )
    loss.make_value_estimator(gamma=settings["gamma"])
    SoftUpdate(loss, tau=0.1)
    set_members(loss.qvalue_network_params, weights["reward_critic"])
    set_members(loss.cost_critic_params, weights["cost_critic"])
    set_members(loss.target_qvalue_network_params, weights["target_reward_critic"])
    set_members(loss.target_cost_critic_params, weights["target_cost_critic"])

    ended = torch.tensor(batch["done"]).bool()[:, None]  # OmniSafe's done is our terminated
    truncated = (torch.arange(len(ended)) % 4 == 2)[:, None]  # which changes no loss
    following = {
        "observation": torch.tensor(batch["next_obs"]),
        "reward": torch.tensor(batch["reward"])[:, None],
        "cost": torch.tensor(batch["cost"])[:, None],
        "terminated": ended,
        "truncated": truncated,
        "done": ended | truncated,
    }
    state = {"observation": torch.tensor(batch["obs"]), "action": torch.tensor(batch["act"])}
    return loss, TensorDict({**state, "next": following}, [len(ended)])


def test_sac_lag(sac, draws):
    """The reward critics', the actor's and the temperature's loss, and their gradients."""
    found, (loss, batch) = FIXTURE["sac_lag"], sac
    draws([torch.tensor(found["noise"]["next"]), torch.tensor(found["noise"]["now"])])
    out = loss(batch)
    theirs, gradients = found["losses"], found["gradients"]
    assert_agrees(out["loss_actor"], theirs["actor"])
    assert_agrees(2 * out["loss_qvalue"], theirs["reward_critic"])  # E12 has a factor 1/2
    # OmniSafe weighs with log alpha where E14 has alpha.
    alpha = found["settings"]["alpha"]
    assert_agrees(out["loss_alpha"] * math.log(alpha) / alpha, theirs["alpha"])
    sum(out[f"loss_{term}"] for term in ("actor", "qvalue", "alpha")).backward()
    assert_gradients_agree(loss.actor_network_params, gradients["actor"])
    assert_critic_gradients_agree(
        loss.qvalue_network_params, gradients["reward_critic"], ACTION_VALUE, 2.0
    )
    assert_agrees(loss.log_alpha.grad / alpha, gradients["log_alpha"][0])


def test_sac_lag_cost_critic(sac, draws):
    """Its next action is the policy's mean at OmniSafe, not the draw that the reward critics have."""
    found, (loss, batch) = FIXTURE["sac_lag"], sac
    noise = torch.tensor(found["noise"]["now"])
    draws([torch.zeros_like(noise), noise])
    out = loss(batch)
    assert_agrees(2 * out["loss_cost"], found["losses"]["cost_critic"])  # E13 has a factor 1/2
    out["loss_cost"].backward()
    theirs = found["gradients"]["cost_critic"]
    assert_critic_gradients_agree(loss.cost_critic_params, theirs, ACTION_VALUE, 2.0)


def test_advantages():
    """Of reward and cost, before OmniSafe standardises each of them for itself."""
    loss, data = on_policy("ppo_lag", lagrange=DualAscent())
    loss.begin(data)
    theirs = FIXTURE["ppo_lag"]["buffer"]
    for ours, name in (("advantage", "adv_r"), ("cost_advantage", "adv_c")):
        assert_agrees(data[ours][0, :, 0], theirs["before_standardising"][name])
    for ours, name in (("value_target", "target_value_r"), ("cost_value_target", "target_value_c")):
        assert_agrees(data[ours][0, :, 0], theirs[name])


def test_ppo_lag(monkeypatch):
    found = FIXTURE["ppo_lag"]
    loss, data = on_policy(
        "ppo_lag",
        lagrange=DualAscent(init=found["settings"]["lagrangian_multiplier"]),
        clip_epsilon=found["settings"]["clip"],
        # OmniSafe standardises the reward's advantage and centres the cost's, in its buffer, and weighs them
        # then; we weigh first and standardise the sum.
        normalize_advantage=False,
    )
    data = with_their_advantages(data, "ppo_lag")
    for name, leaf in named(loss.actor_network_params).items():
        leaf.data.copy_(torch.tensor(found["weights"]["actor_after"][name]))
    seen = []
    clipped = PPOTerms.forward

    def listen(self, tensordict):
        seen.append(tensordict["advantage"].squeeze(-1))
        return clipped(self, tensordict)

    monkeypatch.setattr(PPOTerms, "forward", listen)
    out = loss(data)
    assert_agrees(seen[0], found["advantage"])
    ratio = torch.tensor(found["ratio"])
    share = ((ratio - 1).abs() > found["settings"]["clip"]).double().mean()
    assert 0.2 < share < 0.8
    theirs, gradients = found["losses"], found["gradients"]
    assert_agrees(out["loss_objective"], theirs["actor"])
    assert_agrees(out["loss_critic"], theirs["reward_critic"])
    assert_agrees(2 * out["loss_cost"], theirs["cost_critic"])  # ours has a factor 1/2
    sum(value for key, value in out.items() if key.startswith("loss_")).backward()
    assert_gradients_agree(loss.actor_network_params, gradients["actor"])
    for params, name, factor in (
        (loss.critic_network_params, "reward_critic", 1.0),
        (loss.cost_critic_params, "cost_critic", 2.0),
    ):
        assert_critic_gradients_agree(params, gradients[name], STATE_VALUE, factor)


def test_multiplier():
    """OmniSafe's optimiser is Adam by default; with plain gradient ascent it is our dual ascent."""
    found = FIXTURE["multiplier"]
    lagrange = DualAscent(init=found["init"], lr=found["lr"], signed=True)
    for cost, value in zip(found["costs"], found["values"], strict=True):
        lagrange.update(torch.tensor(cost - found["cost_limit"]))
        assert float(lagrange.value) == pytest.approx(value, rel=1e-5, abs=1e-12)
