"""Critics: what they begin with."""

from __future__ import annotations

import pytest
import torch
from test_ensemble import scene
from torch import nn

from saferl.modules import MLPValue, MMAMValue, zero_output


@pytest.mark.parametrize("make", [lambda: MMAMValue(16), lambda: MLPValue(3, 16)])
def test_a_zeroed_output_is_zero_and_learns(make):
    torch.manual_seed(0)
    network, td = zero_output(make()), scene()
    value = network(td["ego"], td["vehicles"], td["action"])
    assert torch.equal(value, torch.zeros(5, 1))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    for _ in range(300):
        loss = (network(td["ego"], td["vehicles"], td["action"]) - 1.0).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss < 1e-2


def test_a_network_without_a_readout_is_refused():
    with pytest.raises(ValueError, match="Identity has no linear layer with one output"):
        zero_output(nn.Identity())
