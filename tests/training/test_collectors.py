"""Workers act by what the learner has learned, play other episodes each, and can be lost."""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import time
from functools import partial
from pathlib import Path

import pytest
import torch
from small import EMPTY, SMALL, compose
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from saferl.algorithms.assemble import build_agent, build_trainer, worker_seat
from saferl.algorithms.base import Agent
from saferl.cli import train as door
from saferl.envs.intersection import BatchedIntersection
from saferl.training import collectors
from saferl.training.collector import Worker
from saferl.training.trainer import Trainer

TRAIN = ("train", "config")
LATE = ("algo=rsac", "projector.start=0.5", "projector.limit=-1", "projector.steps=3")


def worker(index: int, *options: str, workers: int = 2) -> Worker:
    """A worker in this process."""
    return Worker(
        partial(worker_seat, compose(*SMALL, *EMPTY, *options), workers=workers),
        create_env_kwargs={"index": index},
        patience=60.0,
        frames_per_batch=8,
        total_frames=-1,
        auto_register_policy_transforms=False,
    )


def risk_of(agent: Agent, data: TensorDictBase) -> torch.Tensor:
    """By the learner's live critics."""
    assert agent.risk is not None
    return agent.risk(data.copy()).get(agent.risk.out_keys[0])


@pytest.fixture
def forked():
    """Processes that need no imports: seconds less for each."""
    multiprocessing.set_start_method("fork", force=True)
    yield
    multiprocessing.set_start_method(None, force=True)


@pytest.fixture(autouse=True)
def own_numbers():
    """Workers seed their process, which is this one here."""
    with torch.random.fork_rng():
        yield


@pytest.mark.parametrize("algo", ["rsac", "arppo"])
def test_a_worker_acts_by_what_it_is_told(algo: str):
    """Its own networks began elsewhere; its projector begins when the learner's does."""
    options = (*LATE, f"algo={algo}")
    agent, seat = build_agent(compose(*SMALL, *EMPTY, *options)), worker(0, *options)
    assert agent.projector is not None
    batches = iter(seat)
    for enabled in (False, True):
        agent.projector.set_progress(float(enabled))
        with torch.no_grad():
            for parameter in agent.loss.parameters():
                parameter.add_(0.1 * torch.randn_like(parameter))
        data = next(batches)
        assert not torch.equal(risk_of(agent, data), data["next", "risk_before"])
        seat.take(agent.learned())
        data = next(batches)
        risk = risk_of(agent, data)
        torch.testing.assert_close(data["next", "risk_before"], risk, rtol=0, atol=1e-6)
        after = risk_of(agent, data.copy().set("action", data["next", "action_executed"]))
        torch.testing.assert_close(data["next", "risk_after"], after, rtol=0, atol=1e-6)
        assert bool(data["next", "intervened"].any()) is enabled
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            ours, theirs = (act(data.copy())["action"] for act in (agent.actor, seat.policy))
        assert torch.equal(ours, theirs)


def test_workers_play_other_episodes_and_a_seed_the_same_again():
    def data(index: int, *options: str) -> torch.Tensor:
        seat = worker(index, "algo=sac", "env.num_envs=4", *options)
        return next(iter(seat))["ego"]

    first = data(0)
    assert torch.equal(first, data(0))
    others = [data(1), data(0, "seed=1"), data(1, "seed=1")]
    starts = torch.cat([first, *others])[:, 0]
    assert len(starts.unique(dim=0)) == 8  # of each environment of each worker


@pytest.mark.parametrize(
    "options",
    [("algo=rsac", "task.vehicles=3"), ("algo=ppo_lag",), ("algo=sac", "env=highway", "env.num_envs=4")],
)  # fmt: skip
def test_a_worker_goes_on_from_its_snapshot(options):
    """In mid-episode and in the same bits, with exploration that is held over several decisions."""
    options = (*options, "task.duration=2")
    options += () if "algo=ppo_lag" in options else ("learning.exploration=0.5",)
    first, second = worker(1, *options), worker(1, *options)
    batches = iter(first)
    next(batches)
    snapshot = first.snapshot()
    expected = [next(batches).clone() for _ in range(2)]
    torch.manual_seed(7)
    second.restore(snapshot)
    for ours, theirs in zip(expected, second, strict=False):
        assert all((ours[k] == theirs[k]).all() for k in ours.keys(True, True))


def test_a_killed_worker_is_survived(command, forked, tmp_path: Path, monkeypatch, capsys):
    """Twice the same run in processes; of one a worker is killed, in the middle between two checkpoints.

    Each risk that a worker reports is that of the learner's critics at the time.
    """
    options = (*SMALL, *EMPTY, *LATE, "collector=multi", "frames=64", "save_every=16")
    take, checked, killed = Trainer._take, [], []

    def look(trainer: Trainer, data):
        risk = trainer.learner.loss.cost_value(data.copy()).get("state_action_cost_value")
        torch.testing.assert_close(data["next", "risk_before"], risk, rtol=0, atol=1e-6)
        checked.append(bool(data["next", "intervened"].any()))
        assert not torch.equal(data["ego"][0], data["ego"][1])
        return take(trainer, data)

    def kill(trainer: Trainer, data):
        if trainer.progress.frames == 40 and not killed:
            killed.append(trainer.collector.collector.procs[1].pid)
            os.kill(killed[0], signal.SIGKILL)
        return take(trainer, data)

    for run, act in (("whole", look), ("killed", kill)):
        monkeypatch.setattr(Trainer, "_take", act)
        command(*TRAIN, *options, f"out={run}")
    assert killed and len(checked) == 32 and checked[0] is False and checked[-1] is True
    told = "worker 1 of 2 was killed by SIGKILL. The run goes on from its checkpoint of frame 32."
    assert told in capsys.readouterr().out
    for name in ("metrics.csv", "evaluation/episodes.csv"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "killed" / name).read_bytes()


@pytest.mark.slow
def test_a_worker_that_hangs_is_named(command, forked, monkeypatch, capfd):
    """It ends, and says where it was; the run ends with one line, and goes on where it was."""
    mother, step, left = os.getpid(), BatchedIntersection._step, [3]

    def hang(self, tensordict):
        left[0] -= os.getpid() != mother
        time.sleep(60 if left[0] < 0 else 0)
        return step(self, tensordict)

    monkeypatch.setattr(BatchedIntersection, "_step", hang)
    options = (*SMALL, *EMPTY, "algo=sac", "collector=multi", "collector.patience=5", "out=mine")
    with pytest.raises(SystemExit) as left_with:
        command(*TRAIN, *options)
    line = str(left_with.value)
    assert re.search(r"worker [01] of 2 ended .*collector\.patience.* Continue with resume=", line)
    assert "in hang" in capfd.readouterr().err
    monkeypatch.setattr(BatchedIntersection, "_step", step)
    command(*TRAIN, "resume=mine")


class Lost:
    """A trainer whose worker is lost after so many frames of each try."""

    def __init__(self, tries: list[int], killed: bool):
        self.tries, self.killed = tries, killed

    def __call__(self, cfg, run):
        self.trainer = build_trainer(cfg, run)
        batches = iter(self.trainer.collector)
        count = self.tries.pop(0) if self.tries else 1000

        class Watched:
            def __iter__(this):
                for _ in range(count):
                    yield next(batches)
                raise door.WorkerLost("worker 0 of 2 is gone.", self.killed)

            shutdown = self.trainer.collector.shutdown

        self.trainer.collector = Watched()
        return self.trainer


@pytest.mark.parametrize(
    ("tries", "killed", "message"),
    [
        ([5, 5], True, None),
        ([3, 0], True, "worker 0 of 2 is gone. Continue with resume=.*mine"),
        ([3], False, "worker 0 of 2 is gone. Continue with resume=.*mine"),
    ],
)
def test_a_run_goes_on_as_long_as_it_gets_on(command, monkeypatch, tries, killed, message):
    """A worker may be killed again after another checkpoint; a mistake of its own would come again."""
    options = (*SMALL, *EMPTY, "algo=sac", "save_every=8", "out=mine")
    monkeypatch.setattr(door, "build_trainer", Lost(tries, killed))
    if message is None:
        command(*TRAIN, *options)
        assert tries == []
        return
    with pytest.raises(SystemExit, match=f"^error: {message}$"):
        command(*TRAIN, *options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("env.num_envs=5",), r"env.num_envs must be a multiple of collector.workers, .*got 5 and 2"),
        (("collector.workers=0",), r"collector.workers must be >= 1, got 0"),
        (("collector.patience=0",), r"collector.patience must be > 0, got 0"),
        (("collector.workers=64", "env.num_envs=64"), r"collector.workers must be <= 2, the cores.*got 64"),
        (("collector=ray", "collector.cpus=0"), r"collector.cpus must be > 0, got 0"),
        (("collector=ray",), r"collector=ray needs Ray: pip install 'saferl\[ray\]'"),
        (("collector=many",), r"collector must be one of multi, ray, single, got 'many'"),
    ],
)  # fmt: skip
def test_what_cannot_collect_is_refused(options, message: str, refusal, monkeypatch):
    monkeypatch.setattr(collectors, "cores", lambda: 2)
    monkeypatch.setattr(collectors, "find_spec", lambda name: None)
    line = refusal(*TRAIN, *SMALL, *EMPTY, "collector=multi", *options)
    assert re.search(message, line)
