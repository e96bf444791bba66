"""CriticEnsemble: values, gradients, live parameters."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import ValueOperator
from torchrl.objectives import SACLoss

from saferl.modules import (
    BoundCritics,
    CriticEnsemble,
    MLPPolicyEncoder,
    MLPValue,
    MMAMValue,
    tanh_gaussian_actor,
    value_operator,
)

KEY = "state_action_cost_value"


def critics(kind="mmam", n=2):
    torch.manual_seed(0)
    make = {"mmam": lambda: MMAMValue(16), "mlp": lambda: MLPValue(3, 16)}[kind]
    return [value_operator(make(), out_key=KEY) for _ in range(n)]


def plain_critics():
    """Critics that are not split, whose action is not the last input."""
    torch.manual_seed(0)
    nets = [nn.Bilinear(2, 9, 1) for _ in range(2)]
    return [TensorDictModule(net, ["action", "ego"], [KEY]) for net in nets]


def scene(batch=(5,), seed=1):
    torch.manual_seed(seed)
    vehicles = torch.randn(*batch, 3, 6)
    vehicles[..., 0] = 1
    return TensorDict(
        ego=torch.randn(*batch, 9),
        vehicles=vehicles,
        action=torch.rand(*batch, 2) * 2 - 1,
        batch_size=batch,
    )


def values_of(members, td):
    return torch.stack([member(td.copy())[KEY] for member in members])


@pytest.mark.parametrize("reduce", ["max", "min", "mean"])
@pytest.mark.parametrize("members", [critics("mmam", 3), critics("mlp"), plain_critics()])
@pytest.mark.parametrize("batch", [(), (5,), (2, 1)])
def test_equals_members_one_by_one(reduce, members, batch):
    ensemble, td = CriticEnsemble(members, reduce=reduce), scene(batch)
    values = values_of(members, td)
    expected = {"max": values.amax(0), "min": values.amin(0), "mean": values.mean(0)}[reduce]
    torch.testing.assert_close(ensemble.values(td), values)
    torch.testing.assert_close(ensemble(td.copy())[KEY], expected)
    assert ensemble.out_keys == [KEY] and ensemble.in_keys == members[0].in_keys
    assert set(td.keys()) == {"ego", "vehicles", "action"}

    action = td["action"].clone().requires_grad_()
    bound = ensemble.bind(td.exclude("action"))(action)
    torch.testing.assert_close(bound, expected)
    (slope,) = torch.autograd.grad(bound.sum(), action)
    (full,) = torch.autograd.grad(ensemble(td.copy().set("action", action))[KEY].sum(), action)
    torch.testing.assert_close(slope, full)


class Pair(MLPValue):
    """Its scene is a tuple, with as many parts as there are members."""

    def encode(self, *observed):
        scene = super().encode(*observed)
        return scene.pop("first"), scene

    def value(self, scene, action):
        first, scene = scene
        return super().value({"first": first, **scene}, action)


MEMBERS = [
    *(critics("mmam", 3), critics("mlp"), plain_critics()),
    [value_operator(Pair(rows=3, width=16), out_key=KEY) for _ in range(2)],
]


@pytest.mark.parametrize("members", MEMBERS)
def test_at_once_and_one_by_one(members):
    """The members stacked, as on a GPU, give the values and gradients that they give in turn."""
    ensemble, td = CriticEnsemble(members), scene()
    results = []
    for vmap in (True, False):
        bound = BoundCritics.of(ensemble.template, ensemble.params, td, vmap=vmap)
        action = td["action"].clone().requires_grad_()
        (bound.values(action) * bound.detach().values(action)).sum().backward()
        grads = [leaf.grad for leaf in ensemble.parameters()]
        ensemble.zero_grad(set_to_none=True)
        results.append([bound.values(action), action.grad, *grads])
    torch.testing.assert_close(*results)


def test_owned_parameters_are_a_copy_that_trains():
    members = critics()
    ensemble, td = CriticEnsemble(members), scene()
    before = values_of(members, td)
    count = sum(p.numel() for p in ensemble.parameters())
    assert count == sum(p.numel() for m in members for p in m.parameters())
    ensemble(td.copy())[KEY].sum().backward()
    torch.optim.SGD(ensemble.parameters(), lr=0.1).step()
    assert not torch.allclose(ensemble.values(td), before)
    torch.testing.assert_close(values_of(members, td), before)

    other = CriticEnsemble(critics())
    other.load_state_dict(ensemble.state_dict())
    torch.testing.assert_close(other.values(td), ensemble.values(td))
    twin = copy.deepcopy(ensemble)
    torch.testing.assert_close(twin.values(td), ensemble.values(td))


def make_loss():
    actor = tanh_gaussian_actor(MLPPolicyEncoder(3, 8), width=8)
    members = [ValueOperator(m.module, in_keys=m.in_keys) for m in critics()]
    return SACLoss(actor, members, action_spec=actor.spec["action"]), members


def view_of(loss):
    return CriticEnsemble(loss.qvalue_network, loss.qvalue_network_params, reduce="max")


def test_view_follows_a_loss():
    """Through an optimizer step, load_state_dict and a cast (as `.to(device)` is done)."""
    loss, members = make_loss()
    view, td = view_of(loss), scene()
    assert list(view.parameters()) == [] and view.state_dict() == {}

    def expected():
        weights = loss.qvalue_network_params.data.unbind(0)
        out = []
        for params in weights:
            member = copy.deepcopy(members[0]).to(params["module", "w_attn", "weight"].dtype)
            params.to_module(member, preserve_module_state=False)
            out.append(member(td.copy())["state_action_value"])
        return torch.stack(out)

    torch.testing.assert_close(view.values(td), expected())
    first = view.values(td).detach()

    optimizer = torch.optim.Adam(loss.parameters(), lr=0.05)
    view.values(td).sum().backward()
    optimizer.step()
    assert not torch.allclose(view.values(td), first)
    torch.testing.assert_close(view.values(td), expected())

    torch.manual_seed(9)
    other, _ = make_loss()
    loss.load_state_dict({k: v + 0.1 for k, v in other.state_dict().items()})
    torch.testing.assert_close(view.values(td), expected())
    torch.testing.assert_close(view.bind(td)(td["action"]), expected().amax(0))

    loss.to(torch.float64)
    td = td.to(torch.float64)
    assert view.values(td).dtype == torch.float64
    torch.testing.assert_close(view.values(td), expected())
    torch.testing.assert_close(view.bind(td)(td["action"]), expected().amax(0))


def test_binding_leaves_no_trace():
    """Detached: no gradient on a parameter. The template keeps its own weights."""
    loss, members = make_loss()
    view, td = view_of(loss), scene()
    own = members[0].module.w_attn.weight
    action = td["action"].clone().requires_grad_()
    view.bind(td).detach()(action).sum().backward()
    assert action.grad.abs().sum() > 0
    assert all(p.grad is None for p in loss.parameters())
    assert members[0].module.w_attn.weight is own


def test_compiles():
    ensemble, td = CriticEnsemble(critics("mlp")), scene()
    torch._dynamo.reset()
    compiled = torch.compile(lambda td: ensemble(td)[KEY], backend="eager")
    torch.testing.assert_close(compiled(td.copy()), ensemble(td.copy())[KEY])


def test_errors():
    one, two = critics()
    with pytest.raises(ValueError, match=r"reduce must be one of .* got 'median'"):
        CriticEnsemble([one, two], reduce="median")
    with pytest.raises(ValueError, match=r"or a function, got None"):
        CriticEnsemble([one, two], reduce=None)  # type: ignore
    with pytest.raises(ValueError, match=r"to?.*one number .* got \(5, 1\) of \(2, 5, 1, 1\)"):
        CriticEnsemble([one, two], reduce=lambda v: v.amax(0).squeeze(-1))(scene())
    with pytest.raises(ValueError, match="at least one critic"):
        CriticEnsemble([])
    with pytest.raises(ValueError, match="needs its stacked params"):
        CriticEnsemble(one)
    with pytest.raises(ValueError, match="without params"):
        CriticEnsemble([one, two], CriticEnsemble([one, two]).params)
    with pytest.raises(ValueError, match="same keys"):
        CriticEnsemble([one, value_operator(MMAMValue(16), out_key="other")])


def test_a_view_stays_in_its_process(monkeypatch: pytest.MonkeyPatch):
    """Where it would read a copy for ever; an ensemble of its own parameters goes anywhere."""
    owner = CriticEnsemble(critics())
    view = CriticEnsemble(owner.template, owner.params)
    td = scene()
    for twin in (copy.copy(view), copy.deepcopy(view)):
        assert torch.equal(twin(td.copy())[KEY], owner(td.copy())[KEY])
    with pytest.raises(RuntimeError, match="in another process it would read a copy for ever"):
        pickle.dumps(view)
    monkeypatch.setattr("os.getpid", lambda: -1)  # as after a fork
    with pytest.raises(RuntimeError, match="Put the SafetyProjector around the workers'"):
        view(td.copy())
    assert torch.equal(pickle.loads(pickle.dumps(owner))(td.copy())[KEY], owner(td.copy())[KEY])
