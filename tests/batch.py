"""Batched environments for tests: an empty road, reset and stepped by hand."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict

from saferl.envs.intersection import BatchedIntersection, Scenario
from saferl.envs.intersection.base import OUTCOMES

NORTH = -math.pi / 2
OBSERVATION = ("ego", "vehicles", "route", *OUTCOMES)
COAST, BRAKE, HARD_LEFT = (0.0, 0.0), (-1.0, 0.0), (0.0, -1.0)


def make(num_envs=1, seed=0, **settings):
    """An empty road by default, observed by coordinates that a test can read off."""
    usual = {"vehicles": 0, "observation": "world"}
    return BatchedIntersection(Scenario(**usual | settings), num_envs, seed)


def reset(env, seeds=None):
    """Reset all environments, maybe to given episodes."""
    return env.reset(seeds=seeds)


def reset_rows(env, view, rows):
    """Reset the environments in the mask ``rows``; ``view`` is what the last step gave."""
    mask = torch.as_tensor(rows).reshape(*env.batch_size, 1)
    return env.reset(view.exclude("reward", "cost").set("_reset", mask))


def step(env, action):
    """One step of all environments with ``action`` [2] or [B, 2]."""
    action = torch.as_tensor(action).expand(*env.batch_size, 2)
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


def equal(a, b, keys=OBSERVATION):
    return all(torch.equal(a[key], b[key]) for key in keys)


def noise(count, *shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand((count, *shape, 2), generator=generator) * 2 - 1
