"""A training whose numbers are not finite stops, and keeps what was good."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from small import EMPTY, SMALL, compose
from trainers import collect, trainer_of

from saferl.algorithms.assemble import build_trainer


@pytest.mark.parametrize("algo", ["sac", "arsac", "ppo_lag", "cpo"])
def test_a_training_that_diverges_stops_and_keeps_its_last_good_checkpoint(algo, tmp_path: Path):
    """By steps of a size that no network survives."""
    rates = [f"learning.lr.{name}=[1e30,1e30]" for name in ("actor", "critic")]
    fresh = algo in ("ppo_lag", "cpo")  # their first update follows their first batch
    late = () if fresh else ("learning.warmup_frames=40",)
    cfg = compose(*SMALL, *EMPTY, f"algo={algo}", "frames=400", "save_every=8", *rates, *late)
    with pytest.raises(ValueError, match=r"at frame \d+: the training diverged.*checkpoint-\d+;"):
        build_trainer(cfg, tmp_path).train()
    kept = build_trainer(cfg, tmp_path)
    kept.resume()
    assert kept.progress.frames == (0 if fresh else 40)
    assert all(p.isfinite().all() for p in kept.learner.loss.parameters())


def test_nothing_that_is_not_finite_is_kept(tmp_path: Path):
    """Buffers and sums, too: the checkpoint before stays the newest."""
    trainer = trainer_of(tmp_path, "algo=rsac", "frames=1000")
    trainer.save()
    newest = trainer.checkpoint.rotation.latest()
    trainer.progress.frames = 8
    trainer.means.sums["loss_qvalue"] = torch.tensor(torch.nan)
    with pytest.raises(ValueError, match="loss_qvalue is not finite at frame 8: .*checkpoint-0"):
        trainer.save()
    trainer.means.sums.clear()
    trainer.learner.loss.lagrange.value.fill_(torch.inf)
    with pytest.raises(ValueError, match="lagrange.value is not finite at frame 8: .*checkpoint-0"):
        trainer.save()
    assert trainer.checkpoint.rotation.latest() == newest


@pytest.mark.parametrize(
    "task", [("task=gs",), ("task=gs", "env=highway"), ("task=gym", "task.id=Pendulum-v1")]
)
def test_an_action_that_is_not_finite_is_the_policys(task: tuple[str, ...], tmp_path: Path):
    extra = ["task.cost_key=null"] if "task=gym" in task else ["task.vehicles=0"]
    options = (*SMALL, "algo=sac", *task, *extra, "learning.exploration=0")
    trainer = build_trainer(compose(*options), tmp_path)
    next(trainer.learner.loss.actor_network_params.values(True, True)).data.fill_(torch.nan)
    trainer.collector.init_random_frames = 0
    with pytest.raises(ValueError, match="policy.*action.* not finite"):
        collect(trainer, 1)
