"""Commands run in this process and in others."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from small import fitting

from saferl.cli.launch import launch

torch.set_num_threads(1)


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Runs a command in this process, in an empty folder: ``command("train", "config", ...)``."""
    monkeypatch.chdir(tmp_path)

    def run(name: str, config: str, *arguments: str) -> None:
        monkeypatch.setattr(sys, "argv", ["saferl", *fitting(arguments)])
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
                [sys.executable, "-m", module, *fitting(arguments)],
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
