"""The best policy of a run is kept beside its newest checkpoint."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from small import EMPTY, SMALL, compose
from trainers import trainer_of

from saferl.algorithms.assemble import build_trainer, load_agent
from saferl.checkpoint.policy import EXPORTED, policy_counted
from saferl.checkpoint.run import progress, run_config
from saferl.training.best import BEST


def window(success: float, cost: float, count: int = 60) -> dict[str, torch.Tensor]:
    won = (torch.arange(count) < success * count).float()
    return {"return": won - 1, "cost_return": torch.full((count,), cost), "success": won}


def test_the_best_is_within_the_limit_and_succeeds_most(tmp_path: Path):
    trainer = trainer_of(tmp_path, "algo=rsac", "cost_limit=0.1")
    best, file = trainer.best, tmp_path / BEST / EXPORTED
    for updates, episodes in ((0, 20), (1, 40), (2, 89)):  # begun before the first update
        counted = {"frames": 1, "episodes": episodes, "updates": updates}
        best.look(window(1.0, 0.0), counted, lambda: None)
    assert not file.exists()
    kept, actor = [], next(trainer.learner.loss.actor_network_params.values(True, True))
    course = [
        (0.9, 0.5, True),  # anything is better than nothing
        (0.2, 0.05, True),  # within the limit
        (0.9, 0.2, False),
        (0.2, 0.0, False),  # no better
        (0.7, 0.09, True),
    ]
    for number, (success, cost, better) in enumerate(course):
        actor.data.fill_(number)
        counted = {"frames": number, "episodes": 100, "updates": 1}
        best.look(window(success, cost), counted, lambda: None)
        kept = number if better else kept
        assert policy_counted(file)["frames"] == kept
    best.look(
        window(1.0, 0.0, count=49), {"frames": 9, "episodes": 100, "updates": 1}, lambda: None
    )  # too few
    assert progress(tmp_path / BEST) == {"frames": 4, "episodes": 100}
    assert policy_counted(file)["within"] is True
    agent = load_agent(run_config(tmp_path / BEST), tmp_path / BEST, "checkpoint")
    assert (next(agent.loss.actor_network_params.values(True, True)) == 4).all()


def test_what_is_not_finite_does_not_become_the_best(tmp_path: Path):
    trainer = trainer_of(tmp_path, "algo=sac")
    next(trainer.learner.loss.actor_network_params.values(True, True)).data.fill_(torch.nan)
    trainer.progress.frames = 8
    trainer.best.since = 0
    with pytest.raises(ValueError, match="not finite"):
        trainer.best.look(
            window(1, 0), {"frames": 8, "episodes": 100, "updates": 1}, trainer._check_finite
        )
    assert not (tmp_path / BEST).exists()


def test_a_training_keeps_its_best_and_a_resume_goes_on_from_it(tmp_path: Path):
    short = ("task.duration=1", "task.standstill=null", "frames=400", "record_every=40")
    cfg = compose(*SMALL, *EMPTY, "algo=sac", *short)
    trainer = build_trainer(cfg, tmp_path)
    trainer.train()
    counted = policy_counted(tmp_path / BEST / EXPORTED)
    assert 0 < counted["frames"] <= 400 and counted["episodes"] >= 50 < counted["updates"]
    again = build_trainer(cfg, tmp_path)
    again.resume()
    assert again.best.score == trainer.best.score != []
