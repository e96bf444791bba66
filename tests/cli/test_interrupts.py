"""Ctrl-C, once and twice, in a training and in its closing test."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest
from small import EMPTY, SMALL, compose

from saferl.algorithms.assemble import build_trainer
from saferl.training.trainer import _interrupts

TRAIN, TEST, EXPORT = ("train", "config"), ("evaluate", "evaluate"), ("export", "export")


def test_interrupt_leaves_a_checkpoint_that_loads(spawn, tmp_path: Path):
    """Ctrl-C once; exit 130 and a line that says how to go on, which then works."""
    options = (*SMALL, *EMPTY, "algo=sac", "frames=1000000", "save_every=1000000", "out=run")
    process = spawn("saferl", *options)
    metrics = tmp_path / "run/metrics.csv"
    while not metrics.exists() or metrics.read_text().count("\n") < 3:
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=300)
    assert process.returncode == 130
    assert "Traceback" not in err
    assert "Continue with resume=" in err.splitlines()[-1]

    trainer = build_trainer(compose(*options[:-1]), tmp_path / "run")
    trainer.resume()
    assert trainer.progress.updates > 0 and trainer.progress.frames >= 16
    assert len(trainer.experience.buffer) == min(64, trainer.progress.frames)


def test_interrupt_of_the_closing_test_tells_how_to_repeat_it(command, monkeypatch, capsys):
    def interrupted(*args):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as left:
        patch.setattr("saferl.cli.evaluate.play_episodes", interrupted)
        command(*TRAIN, *SMALL, *EMPTY, "algo=sac", "out=run")
    assert left.value.code == 130
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith("Interrupted in the closing test. Repeat it with resume=")
    command(*TRAIN, line.split()[-1])
    assert Path("run/evaluation/metrics.json").is_file()


def test_second_interrupt_ends_at_once(tmp_path: Path):
    """Even while a step lasts for ever; then the handler is what it was."""
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt, match="twice"), _interrupts() as received:
        signal.raise_signal(signal.SIGINT)
        assert received == [signal.SIGINT]
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
