"""Trainings in processes and on Ray, as they are started from a shell."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from pathlib import Path

import pytest
from small import EMPTY, SMALL

pytestmark = pytest.mark.slow

RUN = (*SMALL, *EMPTY, "algo=rsac", "projector.start=0.5", "projector.limit=-1", "projector.steps=3")  # fmt: skip
LONG = (*RUN, "collector=multi", "frames=400", "save_every=16")


def workers(of: subprocess.Popen) -> list[int]:
    """Process numbers of a training's workers."""
    found = Path(f"/proc/{of.pid}/task/{of.pid}/children").read_text().split()
    return [n for n in map(int, found) if b"spawn_main" in Path(f"/proc/{n}/cmdline").read_bytes()]


def begun(run: Path, process: subprocess.Popen, frames: int = 32) -> None:
    """Wait until a run has saved after so many frames."""
    while not any(int(p.name[11:]) >= frames for p in run.glob("checkpoints/checkpoint-*")):
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)


def gone(processes: list[int]) -> bool:
    for _ in range(300):
        if not any(Path(f"/proc/{number}").exists() for number in processes):
            return True
        time.sleep(0.1)
    return False


def test_a_worker_and_then_the_run_are_killed(tmp_path: Path, spawn):
    """It ends in the same bits; no worker outlives its run."""
    whole = spawn("saferl", *LONG, "out=whole")
    assert whole.wait() == 0
    run = spawn("saferl", *LONG, "out=killed")
    begun(tmp_path / "killed", run)
    os.kill(workers(run)[0], signal.SIGKILL)
    begun(tmp_path / "killed", run, 160)
    others = workers(run)
    run.kill()
    assert len(others) == 2 and gone(others)
    again = spawn("saferl", "resume=killed")
    assert again.wait() == 0
    for name in ("metrics.csv", "evaluation/episodes.csv"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "killed" / name).read_bytes()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_all_processes_are_told_to_stop(number: int, tmp_path: Path, spawn):
    """As by Ctrl-C in a terminal, or by a cluster: the workers stay until the run has saved."""
    run = spawn("saferl", *LONG, "out=run")
    begun(tmp_path / "run", run)
    others = workers(run)
    for process in (*others, run.pid):
        os.kill(process, number)
    _, said = run.communicate()
    frame = re.search(r"Interrupted at frame (\d+)\. Continue with resume=", said)
    assert frame and run.returncode == 130 and gone(others)
    assert (tmp_path / f"run/checkpoints/checkpoint-{int(frame[1]):012d}").is_dir()


@pytest.mark.parametrize("options", [("algo=arppo",), ("algo=sac_lag", "env=highway", "task.vehicles=3")])  # fmt: skip
def test_the_same_again_in_processes(options, command, tmp_path: Path):
    options = (*SMALL, *options, "task=gs", "collector=multi")
    for run in ("first", "second"):
        command("train", "config", *options, f"out={run}")
    first, second = ((tmp_path / run / "metrics.csv").read_bytes() for run in ("first", "second"))
    assert first == second


def test_ray(tmp_path: Path, command, monkeypatch, capsys):
    """The same run as in processes; a worker is killed, and survived."""
    ray = pytest.importorskip("ray")
    from saferl.training.trainer import Trainer

    monkeypatch.setenv("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
    take, killed = Trainer._take, []

    def kill(trainer, data):
        if trainer.progress.frames == 40 and not killed:
            killed.append(True)
            ray.kill(trainer.collector.collector.remote_collectors[1])
        return take(trainer, data)

    options = (*RUN, "frames=64", "save_every=16")
    command("train", "config", *options, "collector=multi", "out=multi")
    monkeypatch.setattr(Trainer, "_take", kill)
    command("train", "config", *options, "collector=ray", "collector.cpus=0.5", "out=ray")
    assert killed and "worker 1 of 2 is gone" in capsys.readouterr().out
    rows = [(tmp_path / run / "metrics.csv").read_text() for run in ("multi", "ray")]
    assert rows[0] == rows[1]
