"""SafetyProjector on ensembles of critics: their live values, and compiled."""

from __future__ import annotations

import functools

import pytest
import torch
from echo import EchoEnv
from plain import PlainMMAMValue
from tensordict import TensorDict
from torchrl.data import Unbounded
from torchrl.envs import Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from saferl.envs.transforms import SafetyProjector
from saferl.modules import (
    CriticEnsemble,
    MLPValue,
    MMAMValue,
    project,
    projection,
    value_operator,
)

SHARED = (projection._compiled_evaluate, projection._compiled_descend)


def test_reads_the_live_critic():
    """An ensemble's change is felt at the next step; its parameters stay without gradient."""
    torch.manual_seed(0)
    critics = [
        value_operator(
            MLPValue(2, 8, ego_scale=[1.0] * 2, vehicle_scale=[1.0] * 2),
            in_keys=["ego", "vehicles", "action"],
            out_key="state_action_cost_value",
        )
        for _ in range(2)
    ]
    ensemble = CriticEnsemble(critics)
    view = CriticEnsemble(critics[0], ensemble.params)

    class Scene(Transform):
        """The toy observation under the names and shapes of the driving environment."""

        def _call(self, next_tensordict):
            observation = next_tensordict["observation"]
            rows = observation.unsqueeze(-2).expand(*observation.shape[:-1], 2, 2).clone()
            return next_tensordict.update({"ego": observation.clone(), "vehicles": rows})

        def _reset(self, tensordict, tensordict_reset):
            return self._call(tensordict_reset)

        def transform_observation_spec(self, observation_spec):
            batch = observation_spec.shape
            observation_spec["ego"] = Unbounded((*batch, 2))
            observation_spec["vehicles"] = Unbounded((*batch, 2, 2))
            return observation_spec

    env = TransformedEnv(EchoEnv((6,)), Scene())
    env.append_transform(SafetyProjector(view, limit=-1e9, penalty=1e3, keep="safest"))
    check_env_specs(env)
    assert not list(env.transform.parameters())
    for _ in range(2):
        data = env.rollout(2)
        expected = ensemble(data.copy())["state_action_cost_value"]
        torch.testing.assert_close(data["next", "risk_before"], expected)
        executed = data.copy().set("action", data["next", "action_executed"])
        after = ensemble(executed)["state_action_cost_value"]
        torch.testing.assert_close(data["next", "risk_after"], after)
        assert (after <= expected).all() and (after < expected).any()
        assert all(p.grad is None for p in ensemble.parameters())
        with torch.no_grad():
            for p in ensemble.parameters():
                p.add_(0.3 * torch.randn_like(p))


@pytest.mark.parametrize(
    "backend",
    # The capture alone takes seconds; generating code takes up to a minute.
    ["eager", pytest.param("inductor", marks=pytest.mark.slow)],
)
@pytest.mark.parametrize("batch", [pytest.param(1, marks=pytest.mark.slow), 40])
def test_compiled_in_parts(monkeypatch, backend, batch):
    """More states than one part holds, some of them safe, corrected as without compiling."""
    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend=backend))
    for shared in SHARED:
        monkeypatch.setattr(shared, "graphs", {})
    torch.manual_seed(0)
    ensemble = CriticEnsemble([value_operator(MMAMValue(16), out_key="risk") for _ in range(2)])
    states = TensorDict(
        ego=torch.randn(batch, 9), vehicles=torch.ones(batch, 3, 6), batch_size=batch
    )
    states["action"] = torch.rand(batch, 2) * 2 - 1
    limit = ensemble(states.copy())["risk"].mean().item() - (batch == 1)
    forms = [SafetyProjector(ensemble, limit, penalty=10.0, compile=c) for c in (False, True)]
    envs = [TransformedEnv(EchoEnv(), form) for form in forms]
    plain, compiled = (form._inv_call(states.copy())["_correction"] for form in forms)
    changed = int(plain["intervened"].sum())
    assert changed == 1 if batch == 1 else batch / 4 < changed < batch
    for key, value in plain.items():
        torch.testing.assert_close(compiled[key], value, rtol=0, atol=1e-5)
    assert [len(env.transform.latencies) for env in envs] == [1, 1]


def test_compiling_needs_a_risk_that_binds():
    risk = value_operator(MLPValue(2, 8), out_key="risk")
    with pytest.raises(ValueError, match=r"needs a risk with bind\(\).*set compile=False for"):
        SafetyProjector(risk, 0.1, compile=True)
    assert not SafetyProjector(risk, 0.1).settings["compile"]


def test_a_critic_that_is_evaluated_whole_is_compiled_once(monkeypatch):
    """Whoever binds it to states anew at each decision gets the same code."""
    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend="eager"))
    for shared in SHARED:
        monkeypatch.setattr(shared, "graphs", {})
    ensemble = CriticEnsemble([value_operator(PlainMMAMValue(16), out_key="r") for _ in range(2)])
    for _ in range(3):
        states = TensorDict(ego=torch.randn(4, 9), vehicles=torch.ones(4, 3, 6), batch_size=4)
        project(ensemble.bind(states), torch.zeros(4, 2), -1.0, steps=5, compile=True)
    assert [len(shared.graphs) for shared in SHARED] == [1, 1]
