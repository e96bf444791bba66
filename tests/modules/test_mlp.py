"""The MLP encoder and value network."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from saferl.modules import (
    EGO_SCALE,
    VEHICLE_SCALE,
    GaussianHead,
    MLPPolicyEncoder,
    MLPValue,
    StateValue,
)


def scene(batch=(4,), rows=3):
    torch.manual_seed(0)
    vehicles = torch.randn(*batch, rows, 6, dtype=torch.float64)
    vehicles[..., 0] = 1.0
    action = torch.rand(*batch, 2, dtype=torch.float64)
    return torch.randn(*batch, 9, dtype=torch.float64), vehicles, action


def flatten(ego, vehicles):
    ego = ego / torch.tensor(EGO_SCALE, dtype=torch.float64)
    vehicles = vehicles / torch.tensor(VEHICLE_SCALE, dtype=torch.float64)
    return torch.cat([ego, vehicles.flatten(-2)], -1)


@pytest.mark.parametrize("batch", [(), (2, 1)])
@pytest.mark.parametrize("depth", [1, 3])
@pytest.mark.parametrize("activation", [nn.GELU, nn.Tanh])
def test_equals_a_sequential(batch, depth, activation):
    ego, vehicles, action = scene(batch)
    options = {"rows": 3, "width": 8, "depth": depth, "activation": activation}

    encoder = MLPPolicyEncoder(**options).double()
    layers = [m for m in encoder.modules() if isinstance(m, nn.Linear)]
    assert len(layers) == depth
    hidden = flatten(ego, vehicles)
    for layer in layers:
        hidden = activation()(layer(hidden))
    torch.testing.assert_close(encoder(ego, vehicles), hidden)

    value = MLPValue(**options).double()
    *layers, head = (m for m in value.modules() if isinstance(m, nn.Linear))
    assert len(layers) == depth
    hidden = torch.cat([flatten(ego, vehicles), action], -1)
    for layer in layers:
        hidden = activation()(layer(hidden))
    torch.testing.assert_close(value(ego, vehicles, action), head(hidden))


def test_absent_rows_are_not_read():
    ego, vehicles, action = scene()
    vehicles[:, 1] = 0.0
    garbage = vehicles.clone()
    garbage[:, 1, 1:] = torch.nan
    for net, rest in ((MLPPolicyEncoder(3, 8), ()), (MLPValue(3, 8), (action,))):
        net.double()
        torch.testing.assert_close(net(ego, garbage, *rest), net(ego, vehicles, *rest))


@pytest.mark.parametrize("given", [0, 2, 4])
def test_wrong_number_of_rows_names_both(given):
    ego, vehicles, action = scene(rows=given)
    with pytest.raises(ValueError, match=f"rows=3 rows, got {given}"):
        MLPPolicyEncoder(rows=3).double()(ego, vehicles)
    with pytest.raises(ValueError, match=f"rows=3 rows, got {given}"):
        MLPValue(rows=3).double()(ego, vehicles, action)


@pytest.mark.parametrize("kind", [MLPPolicyEncoder, MLPValue])
def test_depth_is_checked(kind):
    with pytest.raises(ValueError, match="depth must be >= 1, got 0"):
        kind(depth=0)


def test_heads_on_an_encoder():
    ego, vehicles, _ = scene()
    encoder = MLPPolicyEncoder(3, 8).double()
    state_value = StateValue(encoder, width=8).double()
    torch.testing.assert_close(state_value(ego, vehicles), state_value.head(encoder(ego, vehicles)))
    gaussian = GaussianHead(encoder, width=8, action_dim=2, scale_lb=0.1).double()
    loc, scale = gaussian(ego, vehicles)
    raw = gaussian.head(encoder(ego, vehicles))
    torch.testing.assert_close(loc, raw[..., :2])
    assert ((scale >= 0.1) & (raw[..., 2:].sign() == (scale - 1).sign())).all()
