"""docs/pitfalls.md: the tests that it names exist, and those that no other file has."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from small import EMPTY, SMALL, compose
from tensordict.nn import TensorDictModule
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import TransformedEnv

from saferl.algorithms.assemble import build_trainer
from saferl.envs import Cart, CartEnv
from saferl.envs.transforms import SafetyProjector
from saferl.modules import MLPPolicyEncoder, tanh_gaussian_actor
from saferl.training.experience import Epochs

ROOT = Path(__file__).parents[1]
NAMED = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", (ROOT / "docs/pitfalls.md").read_text())


def test_every_fault_has_a_test():
    rows = re.findall(r"^\| (\d+) \|.*::", (ROOT / "docs/pitfalls.md").read_text(), re.M)
    assert [int(row) for row in rows] == list(range(1, 21))


@pytest.mark.parametrize(("file", "name"), sorted(set(NAMED)))
def test_named_test_exists(file: str, name: str):
    assert f"\ndef {name}(" in (ROOT / file).read_text(encoding="utf-8")


@pytest.mark.parametrize("algo", ["sac_lag", "ppo_lag", "cpo"])
def test_costs_are_stored_as_they_are(algo: str, tmp_path: Path):
    """Where there is none, the critics learn from 0; the reward alone is scaled."""
    options = (
        *SMALL,
        f"algo={algo}",
        "task=cart",
        "cost_limit=1",
        "learning.reward_scale=0.5",
        "frames=16",
    )
    trainer = build_trainer(compose(*options), tmp_path)
    data = next(iter(trainer.collector))
    batches = list(trainer.experience.batches(data, frames=8))
    sample = batches[0] if batches else trainer.experience.buffer.sample()
    torch.testing.assert_close(sample["next", "cost"], sample["action"].square())
    flat = data.reshape(-1)
    for row in sample:
        (same,) = (flat["action"] == row["action"]).all(-1).nonzero()[0]
        torch.testing.assert_close(row["next", "reward"], 0.5 * flat["next", "reward"][same])

    road = build_trainer(compose(*SMALL, *EMPTY, f"algo={algo}"), tmp_path / "road")
    assert (next(iter(road.collector))["next", "cost"] == 0).all()


@pytest.mark.parametrize("algo", ["ppo", "ppo_lag", "cpo"])
def test_on_policy_batches_without_an_end(algo: str, tmp_path: Path):
    options = (
        *SMALL,
        f"algo={algo}",
        "task=cart",
        "cost_limit=1",
        "task.horizon=1000",
        "frames=32",
    )
    trainer = build_trainer(compose(*options), tmp_path)
    trainer.train()
    assert trainer.progress.episodes == 0 and trainer.progress.updates > 0
    for name, parameter in trainer.learner.loss.named_parameters():
        assert parameter.isfinite().all(), name


def test_log_probabilities_are_of_the_proposed_action():
    """On-policy data under a projector keeps the action that the policy drew."""
    torch.manual_seed(0)
    actor = tanh_gaussian_actor(MLPPolicyEncoder(size=2, width=8), 8, 1, in_keys=["observation"])

    risk = TensorDictModule(lambda state, action: action, ["observation", "action"], ["risk"])
    projector = SafetyProjector(risk, limit=-0.5, penalty=100.0)
    env = TransformedEnv(CartEnv(Cart(), num_envs=8, seed=0), projector)
    data = env.rollout(5, actor)
    moved = (data["next", "action_executed"] != data["action"]).any(-1)
    assert moved.any()
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(40), sampler=SamplerWithoutReplacement(), batch_size=40
    )
    keys = ("observation", "action", "action_log_prob")
    (batch,) = Epochs(buffer, keys, begin=lambda data: None, epochs=1).batches(data, 40)
    with torch.no_grad():
        again = actor.get_dist(batch).log_prob(batch["action"])
    torch.testing.assert_close(again, batch["action_log_prob"], rtol=1e-4, atol=1e-4)
