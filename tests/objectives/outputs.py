"""What the tests of a loss make of its output."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from saferl.objectives import SACLagLoss

LOSSES = ("loss_actor", "loss_qvalue", "loss_cost", "loss_alpha")
SCALARS = ("alpha", "entropy", "lagrange_multiplier")


def run(loss: SACLagLoss, batch: TensorDict, seed: int = 3) -> TensorDict:
    torch.manual_seed(seed)
    return loss(batch.clone())


def assert_same(left: TensorDict, right: TensorDict, **tolerance) -> None:
    assert set(left.keys()) == set(right.keys())
    for key, value in left.items():
        torch.testing.assert_close(value, right[key], **tolerance)
