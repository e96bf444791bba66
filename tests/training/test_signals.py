"""What moves a multiplier, and when."""

from __future__ import annotations

from pathlib import Path

import pytest
from trainers import collect, trainer_of

from saferl.training.signals import CriticSignal, EpisodeSignal, episode_budget


def test_episode_signal_uses_each_fresh_episode_once(tmp_path: Path):
    """Not a stale mean at every gradient step (docs/pitfalls.md, 5), nothing where none ended (docs/pitfalls.md, 10)."""
    trainer = trainer_of(
        tmp_path,
        "algo=sac_lag",
        "task.duration=1",
        "task.cost.crash=0",
        "frames=200",
        "lagrange.multiplier.lr=0.1",
    )
    seen: list[list[float]] = []
    lagrange = trainer.learner.loss.lagrange
    update = lagrange.update
    lagrange.update = lambda violation: (seen.append(violation.tolist()), update(violation))
    data = collect(trainer, 12)
    limit = episode_budget(0.05, 0.99, horizon=5)
    ended = [each["next", "episode_cost"][each["next", "done"]] for each in data]
    expected = [(costs - limit).tolist() for costs in ended if len(costs)]
    assert seen == [pytest.approx(costs) for costs in expected] and len(data) > len(seen) >= 2
    assert trainer.progress.updates > len(seen)
    # Rounds of plain signed ascent on costs of 0 (an empty road).
    assert float(lagrange.value) == pytest.approx(1.0 - len(seen) * 0.1 * limit)


def test_signals_refuse_a_loss_without_multiplier(tmp_path: Path):
    trainer = trainer_of(tmp_path, "algo=sac")
    for signal in (CriticSignal(), EpisodeSignal(0.1)):
        with pytest.raises(ValueError, match="needs a loss with a multiplier"):
            signal.register(trainer)
    with pytest.raises(ValueError, match=r"cost_limit must be >= 0, got -1"):
        EpisodeSignal(-1)


def test_critic_signal_ascends_with_every_update(tmp_path: Path):
    trainer = trainer_of(tmp_path, "algo=arsac", "lagrange.multiplier.lr=0.5", "cost_limit=0")
    collect(trainer, 3)
    value = float(trainer.learner.loss.lagrange.value)
    losses = trainer.learner.update(trainer.experience.buffer.sample())
    assert float(trainer.learner.loss.lagrange.value) == pytest.approx(
        value + 0.5 * float(losses["constraint_violation"]), rel=1e-6
    )
