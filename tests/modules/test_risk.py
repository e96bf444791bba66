"""Risks of an ensemble's values against numpy, and critics with options."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from plain import PlainMMAMValue
from tensordict import TensorDict

from saferl.modules import (
    CriticEnsemble,
    CVaR,
    Largest,
    MeanStd,
    MLPValue,
    MMAMValue,
    value_operator,
    zero_output,
)

SHAPES = [(), (2, 1)]


@pytest.mark.parametrize("batch", SHAPES)
def test_risks_match_numpy(batch):
    torch.manual_seed(0)
    one = torch.randn(4, *batch, 1, dtype=torch.float64)
    assert torch.equal(Largest()(one), one.amax(0))
    expected = one.numpy().mean(0) + 1.5 * one.numpy().std(0)
    np.testing.assert_allclose(MeanStd(1.5)(one), expected, rtol=1e-9)
    many = torch.randn(3, *batch, 8, dtype=torch.float64)
    for level in (0.0, 0.5, 0.7, 0.9, 0.99):
        # The same by integrating the step function of sorted quantiles over [level, 1].
        fine = np.repeat(np.sort(many.numpy(), -1), 10_000, -1)
        worst = fine[..., round(level * fine.shape[-1]) :].mean(-1, keepdims=True)
        np.testing.assert_allclose(CVaR(level)(many), worst.max(0), rtol=1e-6)
    torch.testing.assert_close(CVaR(0.0)(many), Largest()(many))


def test_equal_members_have_a_gradient():
    values = torch.ones(4, 5, 1, requires_grad=True)
    MeanStd(2.0)(values).sum().backward()
    assert values.grad is not None and values.grad.isfinite().all()


def test_cvar_refuses():
    with pytest.raises(ValueError, match=r"level must be in \[0, 1\), got 1.0"):
        CVaR(1.0)


@pytest.mark.parametrize("kind", [MLPValue, MMAMValue, PlainMMAMValue])
@pytest.mark.parametrize("layer_norm", [False, True])
def test_critics_with_quantiles_and_norms(kind, layer_norm: bool):
    torch.manual_seed(1)
    options = {"rows": 3} if kind is MLPValue else {}
    network = kind(width=16, outputs=5, layer_norm=layer_norm, **options)
    scene = torch.randn(7, 9), torch.ones(7, 3, 6), torch.randn(7, 2)
    assert network(*scene).shape == (7, 5)
    assert (zero_output(network)(*scene) == 0).all()
    other = kind(width=16, outputs=5, layer_norm=not layer_norm, **options)
    torch.manual_seed(1)
    fresh = kind(width=16, outputs=5, layer_norm=layer_norm, **options)
    other.load_state_dict(fresh.state_dict())
    assert not torch.allclose(other(*scene), fresh(*scene))


def test_plain_and_folded_agree_with_options():
    torch.manual_seed(2)
    options = {"width": 16, "outputs": 4, "layer_norm": True}
    folded, plain = MMAMValue(**options).double(), PlainMMAMValue(**options).double()
    plain.load_state_dict(folded.state_dict())
    scene = [torch.randn(6, 9), torch.ones(6, 3, 6), torch.randn(6, 2)]
    scene = [tensor.double() for tensor in scene]
    torch.testing.assert_close(folded(*scene), plain(*scene), rtol=1e-10, atol=1e-10)


def test_an_ensemble_takes_a_risk():
    critics = [
        value_operator(MLPValue(size=3, width=8), ["observation", "action"]) for _ in range(4)
    ]
    ensemble = CriticEnsemble(critics, reduce=MeanStd(2.0))
    td = TensorDict({"observation": torch.randn(5, 3), "action": torch.randn(5, 2)}, [5])
    values = torch.stack([critic(td.copy())["state_action_value"] for critic in critics])
    torch.testing.assert_close(ensemble(td)["state_action_value"], MeanStd(2.0)(values))
