"""Small runs, in this process and in others."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import hydra
import pytest
import torch
from omegaconf import DictConfig

from saferl.cli import launch
from saferl.paths import config_dir

torch.set_num_threads(1)

#: Turns any training into one of seconds.
SMALL = (
    "episodes=null",
    "frames=24",
    "warmup_frames=8",
    "batch_size=8",
    "buffer_size=64",
    "updates_per_frame=0.5",
    "record_every=8",
    "encoder.policy.width=16",
    "evaluation.episodes=1",
    "logger=none",
    "device=cpu",
)
EMPTY = ("env=batched", "env.num_envs=2", "task.vehicles=0")


def compose(*overrides: str, config: str = "config") -> DictConfig:
    """The configuration that a command line describes."""
    with hydra.initialize_config_dir(config_dir(), version_base="1.3"):
        return hydra.compose(config, list(overrides))


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Runs a command in this process, in an empty folder: ``command("train", "config", ...)``."""
    monkeypatch.chdir(tmp_path)

    def run(name: str, config: str, *arguments: str) -> None:
        monkeypatch.setattr(sys, "argv", ["saferl", *arguments])
        launch(name, config)

    return run


@pytest.fixture
def refusal(command):
    """The one line with which a command refuses its input."""

    def run(name: str, config: str, *arguments: str) -> str:
        with pytest.raises(SystemExit) as refused:
            command(name, config, *arguments)
        line = str(refused.value)
        assert line.startswith("error: ") and "\n" not in line, line
        return line

    return run


@pytest.fixture
def spawn(tmp_path: Path):
    """Starts a module in a process of its own, which does not outlive the test."""
    processes: list[subprocess.Popen] = []

    def start(module: str, *arguments: str) -> subprocess.Popen:
        processes.append(
            subprocess.Popen(
                [sys.executable, "-m", module, *arguments],
                cwd=tmp_path,
                env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"},
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
        return processes[-1]

    yield start
    for process in processes:
        process.kill()
        process.communicate()
