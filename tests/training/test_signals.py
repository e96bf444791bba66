"""What moves a multiplier, and when."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from trainers import collect, trainer_of

from saferl.training.signals import CriticSignal, EpisodeSignal


@pytest.mark.parametrize("relative", [True, False])
def test_episode_signal_uses_each_fresh_episode_once(relative: bool, tmp_path: Path):
    """Not a stale mean at every gradient step (docs/pitfalls.md, 5), nothing where none ended (docs/pitfalls.md, 10)."""
    trainer = trainer_of(
        tmp_path,
        "algo=sac_lag",
        "task.duration=1",
        "frames=200",
        "cost_limit=0.1",
        f"lagrange.signal.relative={str(relative).lower()}",
    )
    seen, times = [], []
    lagrange = trainer.learner.loss.lagrange
    lagrange.update = lambda violation, elapsed: (
        seen.append(violation.tolist()),
        times.append(elapsed),
    )
    data = collect(trainer, 12)
    expected, ends, window = [], [], []
    for number, each in enumerate(data, 1):
        costs = each["next", "episode_cost"][each["next", "done"]]
        if len(costs):
            window += costs.tolist()
            scale = max(0.1, abs(sum(window) / len(window))) if relative else 1.0
            expected.append(((costs - 0.1) / scale).tolist())
            ends.append(number * each.numel() / 200)
    assert seen == [pytest.approx(costs) for costs in expected] and len(data) > len(seen) >= 2
    assert trainer.progress.updates > len(seen)
    elapsed = [now - before for now, before in zip(ends, [0.0, *ends], strict=False)]
    assert times == (pytest.approx(elapsed) if relative else [1.0] * len(seen))


def test_signals_refuse_a_loss_without_multiplier(tmp_path: Path):
    trainer = trainer_of(tmp_path, "algo=sac")
    for signal in (CriticSignal(0.1), EpisodeSignal(0.1)):
        with pytest.raises(ValueError, match="needs a loss with a multiplier"):
            signal.register(trainer)
    with pytest.raises(ValueError, match=r"cost_limit must be >= 0, got -1"):
        EpisodeSignal(-1)


def test_critic_signal_ascends_with_every_update(tmp_path: Path):
    trainer = trainer_of(tmp_path, "algo=arsac", "lagrange.multiplier.lr=0.5", "risk_limit=0")
    collect(trainer, 3)
    value = float(trainer.learner.loss.lagrange.value)
    losses = trainer.learner.update(trainer.experience.buffer.sample())
    assert float(trainer.learner.loss.lagrange.value) == pytest.approx(
        value + 0.5 * float(losses["constraint_violation"]), rel=1e-6
    )


def test_each_of_several_multipliers_follows_its_own_limit(tmp_path: Path):
    """The first cost is within its limit, the second is not; each as a share of its own."""
    trainer = trainer_of(
        tmp_path, "algo=sac_lag", "task.duration=1", "frames=200", "task.costs=[road,comfort]",
        "cost_limit=[5,0.001]",
    )  # fmt: skip
    lagrange, seen = trainer.learner.loss.lagrange, []
    update = lagrange.update
    lagrange.update = lambda penalty, elapsed: (seen.append(penalty), update(penalty, elapsed))
    collect(trainer, 12)
    costs, first = trainer.window.values["cost_return"], seen[0]
    assert costs.shape[1:] == (2,) and first.shape[1:] == (2,)
    now = costs[: len(first)].double()
    scale = now.mean(0).abs().maximum(torch.tensor([5.0, 0.001]))
    expected = (now - torch.tensor([5.0, 0.001])) / scale
    torch.testing.assert_close(first.double(), expected)
    assert lagrange.value[0] < 1 < lagrange.value[1]
    with pytest.raises(ValueError, match="cost_limit must be a number, or 2 of them, got 3"):
        EpisodeSignal([1.0, 2.0, 3.0]).register(trainer)
