"""Environments in several copies, as workers make them."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from torchrl.envs import SerialEnv

from saferl.envs import Cart, CartEnv, GymEnvs, GymTask
from saferl.envs.intersection import BatchedIntersection, HighwayIntersection, Scenario


@pytest.mark.parametrize(
    "make",
    [
        partial(BatchedIntersection, Scenario(task="gs"), num_envs=2),
        partial(HighwayIntersection, Scenario(task="gs"), num_envs=1),
        partial(GymEnvs, GymTask("Pendulum-v1", cost_key=None), num_envs=2),
        partial(CartEnv, Cart(), num_envs=2),
    ],
    ids=lambda make: make.func.__name__,
)
def test_copies_of_a_constructor_play_other_episodes_unless_they_are_seeded(make):
    def starts(**options):
        env = SerialEnv(2, partial(make, **options))
        first = env.reset()
        env.close()
        return first

    unasked = starts()
    assert not torch.equal(*map(tensors, unasked.unbind(0)))
    asked = starts(seed=3)
    assert torch.equal(*map(tensors, asked.unbind(0)))
    assert torch.equal(tensors(asked), tensors(starts(seed=3)))


def tensors(start) -> torch.Tensor:
    """All numbers of a reset in a row."""
    return torch.cat([value.double().flatten() for value in start.values(True, True)])
