"""Critics that value what no rewards and costs add up to."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
import torch
from trainers import collect, trainer_of

CRITICS = {
    "sac": ["qvalue_network"],
    "arsac": ["qvalue_network", "cost_critic"],
    "ppo": ["critic_network"],
    "cpo": ["critic_network", "cost_critic"],
    "arppo": ["critic_network", "cost_critic", "risk_critic"],
}


@pytest.mark.parametrize(
    ("algo", "critic"), [(algo, critic) for algo, names in CRITICS.items() for critic in names]
)
def test_a_critic_that_leaves_its_range_is_named_once(algo, critic, tmp_path: Path, caplog):
    trainer = trainer_of(tmp_path, f"algo={algo}")
    dog, (data,) = trainer.watchdog, collect(trainer, 1)
    with caplog.at_level(logging.WARNING):
        dog.look(data, 7)
        assert not caplog.messages and not dog.left and dog.first() == ""
        for parameter in getattr(trainer.learner.loss, f"{critic}_params").values(True, True):
            if parameter.is_floating_point():
                parameter.data.mul_(1e6).add_(1e4)
        dog.look(data, 8)
        dog.look(data, 9)
    (message,) = caplog.messages
    assert message.startswith(f"{critic} has left its range at frame 8: it values from")
    assert dog.first() == f" {critic} had left its range at frame 8."
    other = trainer_of(tmp_path / "other", f"algo={algo}")
    other.watchdog.load_state_dict(dog.state_dict())
    assert other.watchdog.left == {critic: 8}


def test_the_range_is_that_of_what_was_collected(tmp_path: Path):
    """Smallest and largest reward of all batches, 0 between them, the learner's scale, over 1 - gamma."""
    trainer = trainer_of(tmp_path, "algo=sac", "gamma=0.9", "learning.reward_scale=0.5")
    dog, data = trainer.watchdog, collect(trainer, 3)
    rewards = torch.cat([each["next", "reward"].flatten() for each in data])
    ends = dog.seen["reward"].tolist()
    assert ends == pytest.approx([min(float(rewards.min()), 0), max(float(rewards.max()), 0)])
    assert dog.gamma == 0.9 and dog.reward_scale == 0.5
    dog.gamma = 1.0  # there is no range then
    trainer.learner.loss.qvalue_network_params.apply(lambda p: p.data.fill_(1e9))
    dog.look(data[0], 1)
    assert not dog.left


def test_the_bonus_of_a_loss_is_no_divergence(tmp_path: Path):
    """CaT's value of a reward of -0.2 and a bonus of 1, for ever."""
    trainer = trainer_of(tmp_path, "algo=cat", "loss.bonus=1.0", "gamma=0.99")
    dog, (data,) = trainer.watchdog, collect(trainer, 1)
    dog.seen = {"reward": torch.tensor([-0.2, 0.0])}
    for value, left in ((80.0, {}), (250.0, {"critic_network": 7})):
        dog.values = lambda *_, value=value: torch.tensor([value])
        dog.look(data, 7)
        assert dog.left == left


def test_a_divergence_says_which_critic_left_first(tmp_path: Path):
    trainer = trainer_of(tmp_path, "algo=rsac", "frames=1000")
    trainer.save()
    trainer.progress.frames = 99
    trainer.watchdog.left = {"qvalue_network": 80, "cost_critic": 40}
    trainer.means.sums["loss_qvalue"] = torch.tensor(torch.nan)
    with pytest.raises(
        ValueError, match=r"diverged\. cost_critic had left its range at frame 40\."
    ):
        trainer.save()
