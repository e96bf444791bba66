"""The set encoder and its value network."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from saferl.modules import EGO_SCALE, VEHICLE_SCALE, SetPolicyEncoder, SetValue


def scene(batch=(4,), rows=5):
    torch.manual_seed(0)
    vehicles = torch.randn(*batch, rows, 6, dtype=torch.float64) * 10
    vehicles[..., 0] = 1.0
    action = torch.rand(*batch, 2, dtype=torch.float64)
    return torch.randn(*batch, 9, dtype=torch.float64) * 10, vehicles, action


def pooled(network, ego, vehicles):
    """The scene by a loop over its vehicles."""
    ego = ego / torch.tensor(EGO_SCALE, dtype=torch.float64)
    best = torch.zeros(network.scene.vehicle.out_features, dtype=torch.float64)
    for row in vehicles:
        if row[0] > 0:
            row = row / torch.tensor(VEHICLE_SCALE, dtype=torch.float64)
            best = torch.maximum(best, network.scene.vehicle(row) + network.scene.ego(ego))
    return torch.cat([ego, best])


def test_equals_a_loop_over_the_vehicles():
    ego, vehicles, action = scene()
    vehicles[1, 2:] = 0.0
    vehicles[2] = 0.0  # an empty road
    encoder = SetPolicyEncoder(width=8, depth=2, vehicle_width=6).double()
    value = SetValue(width=8, depth=2, vehicle_width=6, outputs=3).double()
    for index in range(4):
        hidden = pooled(encoder, ego[index], vehicles[index])
        for layer in encoder.layers:
            hidden = layer(hidden)
        torch.testing.assert_close(encoder(ego, vehicles)[index], hidden)
        hidden = torch.cat([pooled(value, ego[index], vehicles[index]), action[index]])
        hidden = value.layers[0](nn.GELU()(value.first(hidden)))
        expected = value.layers[1](nn.GELU()(hidden))
        torch.testing.assert_close(value(ego, vehicles, action)[index], expected)


@pytest.mark.parametrize("batch", [(), (2, 1)])
def test_order_and_absent_rows_change_nothing(batch):
    ego, vehicles, action = scene(batch)
    vehicles[..., 3, :] = 0.0
    more = torch.cat([vehicles, torch.zeros(*batch, 4, 6, dtype=torch.float64)], -2)
    garbage = vehicles.clone()
    garbage[..., 3, 1:] = 1e6
    encoder, value = SetPolicyEncoder(width=8).double(), SetValue(width=8).double()
    for other in (vehicles[..., torch.randperm(5), :], more, garbage):
        torch.testing.assert_close(encoder(ego, other), encoder(ego, vehicles))
        torch.testing.assert_close(value(ego, other, action), value(ego, vehicles, action))


def test_a_size_below_one_is_refused():
    with pytest.raises(ValueError, match="vehicle_width must be >= 1, got 0"):
        SetPolicyEncoder(vehicle_width=0)
    with pytest.raises(ValueError, match="depth must be >= 1, got 0"):
        SetValue(depth=0)
