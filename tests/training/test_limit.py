"""A run says what becomes of its limit."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
import torch
from trainers import collect, trainer_of

from saferl.training.limit import CostWatch


def told(caplog, action) -> list[str]:
    caplog.clear()
    with caplog.at_level(logging.INFO):
        action()
    return caplog.messages


def costs(*values: float, count: int = 200) -> torch.Tensor:
    return torch.tensor(values).repeat(count // len(values))


def test_what_is_said_on_the_way(caplog):
    watch = CostWatch(5.0)
    watch.take(torch.tensor([1.0, 4.0]))
    assert not told(caplog, lambda: watch.look(None, 1, 0.5))
    assert not told(caplog, lambda: watch.look(costs(1.0, 2.0), 100, 0.05))  # early
    (idle,) = told(caplog, lambda: watch.look(costs(1.0, 4.0), 200, 0.1))
    assert idle == "cost_limit=5 has limited nothing so far: no episode cost more than 4."
    assert not told(caplog, lambda: watch.look(costs(1.0, 4.0), 300, 0.2))  # once
    watch.take(torch.tensor([1.0, 12.0]))  # it binds
    assert not told(caplog, lambda: watch.look(costs(1.0, 12.0), 400, 0.3))
    assert not told(caplog, lambda: watch.look(costs(1.0, 6.0, count=100), 500, 0.4))  # too few
    (met,) = told(caplog, lambda: watch.look(costs(1.0, 6.0), 600, 0.5))
    assert met == "cost_limit=5 is met at frame 600: the last 200 episodes cost 3.5 in the mean."
    other = CostWatch(5.0)
    other.load_state_dict(watch.state_dict())
    assert not told(caplog, lambda: other.look(costs(1.0, 6.0), 700, 0.6))


@pytest.mark.parametrize(
    ("values", "dearest", "level", "begins"),
    [
        ((4.0, 6.0), 9.0, "INFO", "In training cost_limit=5 is kept: the last 200 episodes cost 5"),
        ((5.0, 5.1), 9.0, "WARNING", "In training cost_limit=5 is broken: the last 200 episodes"),
        (
            (4.0, 6.01),
            9.0,
            "INFO",
            "In training cost_limit=5 is passed, perhaps by chance: the last 200",
        ),
        (
            (1.0, 2.0),
            4.0,
            "WARNING",
            "In training cost_limit=5 never bound, no episode cost as much",
        ),
    ],
)
def test_what_is_said_at_the_end(values, dearest, level, begins, caplog):
    watch = CostWatch(5.0)
    watch.take(torch.tensor([dearest]))
    (message,) = told(caplog, lambda: watch.judge(costs(*values)))
    assert message.startswith(begins) and caplog.records[0].levelname == level
    assert not told(caplog, lambda: CostWatch(None).judge(costs(*values)))


def test_a_limit_of_the_risk_that_limits_nothing(tmp_path: Path, caplog):
    trainer = trainer_of(tmp_path, "algo=arsac", "risk_limit=1000", "frames=100")
    messages = told(caplog, lambda: collect(trainer, 30))
    assert [m for m in messages if m.startswith("risk_limit=1000 has limited nothing so far")]
    trainer = trainer_of(tmp_path / "other", "algo=arsac", "risk_limit=0", "frames=100")
    trainer.learner.loss.lagrange.value.fill_(1.1)  # it has risen
    messages = told(caplog, lambda: collect(trainer, 30))
    assert not [m for m in messages if "limited nothing" in m]


def test_a_resumed_run_does_not_repeat_itself(tmp_path: Path, caplog):
    """Neither of what an episode costs nor of the risk in a state."""
    options = ("algo=arsac", "risk_limit=1000", "frames=100", "task.duration=1")
    trainer = trainer_of(tmp_path, *options)
    trainer.save()
    messages = told(caplog, lambda: collect(trainer, 20))
    for limit in ("risk_limit=1000", "cost_limit=0.1"):
        assert len([m for m in messages if m.startswith(f"{limit} has limited nothing")]) == 1
    trainer.save()
    resumed = trainer_of(tmp_path, *options)
    resumed.resume()
    assert not [m for m in told(caplog, lambda: collect(resumed, 5)) if "limited nothing" in m]


def test_the_limit_stands_beside_the_cost(tmp_path: Path):
    trainer = trainer_of(tmp_path, "algo=sac_lag", "cost_limit=0.25", "task.duration=1")
    collect(trainer, 20)
    assert trainer.window.short(trainer.watch.limit)["cost"].endswith(" of 0.25")
    assert " of " not in trainer.window.short()["cost"]
