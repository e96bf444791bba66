"""Every key that ``set_keys`` accepts, renamed: in the data, by the networks and in the loss."""

from __future__ import annotations

from dataclasses import asdict, fields
from typing import Any

import pytest
import torch
from on_policy import GAMMA, LAMBDA, SIZE, batch_of
from tensordict import TensorDict
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import SoftUpdate, ValueEstimators

from saferl.modules import DualAscent
from saferl.objectives import CPOLoss, PPOLagLoss, RiskPPOLoss, SACLagLoss, TrustRegionStep

LOSSES = {each.__name__: each for each in (SACLagLoss, PPOLagLoss, RiskPPOLoss, CPOLoss)}
#: Where an entry lies that a batch brings along; the loss or a network writes the others.
AT_THE_ROOT = ("action", "log_prob", "sample_log_prob", "priority_weight", "is_init")
UNDER_NEXT = ("reward", "cost", "done", "terminated")
#: What the loss writes into it.
WRITTEN = ("priority", "value", "state_cost_value", "advantage", "value_target", "cost_advantage")
WRITTEN += ("cost_value_target",)

CASES = [
    pytest.param(kind, field.name, id=f"{kind}-{field.name}")
    for kind, loss in LOSSES.items()
    for field in fields(loss._AcceptedKeys)
]


@pytest.fixture
def build(make_actor, make_critic):
    """Function that builds a loss whose networks use the given names; the same parameters for all names."""

    def make(kind: str, names: dict[str, NestedKey], told: bool = True):
        torch.manual_seed(0)
        name = asdict(LOSSES[kind].default_keys()) | names
        log_prob = name.get("log_prob", name.get("sample_log_prob"))

        def action_value(key: str) -> ValueOperator:
            return make_critic(name[key], action=name["action"])

        def state_value(key: str) -> ValueOperator:
            net = MLP(in_features=SIZE, out_features=1, num_cells=[6], activation_class=nn.Tanh)
            return ValueOperator(net, in_keys=["observation"], out_keys=[name[key]])

        parts: list[Any] = [make_actor(action=name["action"], log_prob=log_prob)]
        if kind == "SACLagLoss":
            parts += [action_value("state_action_value"), action_value("state_action_cost_value")]
        else:
            parts += [state_value("value"), state_value("state_cost_value")]
        if kind == "RiskPPOLoss":
            parts.append([action_value("state_action_cost_value") for _ in range(2)])
        options = {} if kind == "CPOLoss" else {"lagrange": DualAscent(init=0.7)}
        loss = LOSSES[kind](*parts, **options).double()
        if kind == "SACLagLoss":
            SoftUpdate(loss, tau=0.1)
        else:
            loss.make_value_estimator(ValueEstimators.GAE, gamma=GAMMA, lmbda=LAMBDA)
        if told:
            loss.set_keys(**names)
        return loss

    return make


@pytest.fixture
def data(make_actor) -> TensorDict:
    """Transitions [B, T] of every kind, by the usual names."""
    torch.manual_seed(0)
    data = batch_of(make_actor().double())
    data["priority_weight"] = torch.rand(data.shape, dtype=torch.float64) + 0.1
    data["next", "action_executed"] = torch.rand_like(data["action"])
    return data


def rename(data: TensorDict, field: str, default: NestedKey, name: NestedKey) -> TensorDict:
    data = data.clone()
    if field in AT_THE_ROOT:
        data.rename_key_(default, name)
    elif field in UNDER_NEXT:
        data.rename_key_(("next", default), unravel_key(("next", name)))
    elif field == "action_executed":  # says where it lies by itself
        data.rename_key_(default, name)
    return data


def run(loss, data: TensorDict) -> dict[str, Tensor]:
    """All that the loss returns, the gradients of its terms, and the policy that a step leaves."""
    torch.manual_seed(3)
    if hasattr(loss, "begin"):
        loss.begin(data)
    if isinstance(loss, CPOLoss):
        TrustRegionStep(loss).step(data)
    flat = data.reshape(-1)
    out = loss(flat)
    data.update(flat.reshape(data.shape))
    sum(value.sum() for key, value in out.items() if key.startswith("loss_")).backward()
    found = {key: value.detach() for key, value in out.items()}
    for key, parameter in loss.named_parameters():
        found[key] = parameter.detach()
        found[f"gradient of {key}"] = torch.zeros(()) if parameter.grad is None else parameter.grad
    return found


@pytest.mark.parametrize("name", ["other", ("nested", "other")], ids=["flat", "nested"])
@pytest.mark.parametrize(("kind", "field"), CASES)
def test_a_renamed_key_changes_nothing(build, data, kind: str, field: str, name: NestedKey):
    default = asdict(LOSSES[kind].default_keys())[field]
    expected = run(build(kind, {}), data.clone())
    assert any(key.startswith("gradient") and value.any() for key, value in expected.items())
    renamed = rename(data, field, default, name)
    loss = build(kind, {field: name})
    assert getattr(loss.tensor_keys, field) == name
    found = run(loss, renamed)
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        assert torch.equal(found[key], value) or (found[key].isnan() & value.isnan()).all(), key
    # In the batch it is called by its new name, and by that one alone.
    keys = {unravel_key(key) for key in renamed.keys(True)}
    if field in WRITTEN and (kind, field) != ("SACLagLoss", "value"):
        assert name in keys and default not in keys
    # ``None`` is the usual name again, where the networks write that.
    if field not in ("value", "state_cost_value"):
        loss.set_keys(**{field: None})
        assert getattr(loss.tensor_keys, field) == default


@pytest.mark.parametrize("name", ["other", ("nested", "other")], ids=["flat", "nested"])
@pytest.mark.parametrize("field", ["value", "state_cost_value"])
@pytest.mark.parametrize("kind", ["PPOLagLoss", "RiskPPOLoss", "CPOLoss"])
def test_a_value_is_called_what_its_network_writes(
    build, data, kind: str, field: str, name: NestedKey
):
    """Without a word to the loss, in its constructor and behind it."""
    expected = run(build(kind, {}), data.clone())
    loss = build(kind, {field: name}, told=False)
    assert getattr(loss.tensor_keys, field) == name
    found = run(loss, data)
    for key, value in expected.items():
        assert torch.equal(found[key], value) or (found[key].isnan() & value.isnan()).all(), key


def test_a_key_that_no_network_writes_is_refused(build):
    with pytest.raises(KeyError, match="'other' not found in value network out_keys"):
        build("CPOLoss", {}).set_keys(state_cost_value="other")
