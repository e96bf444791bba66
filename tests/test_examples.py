"""The examples run as they stand, a little of them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
SHORT = {
    "cost_loss.py": (["--updates", "30"], ["return -", "(best -1.119), cost ", "(limit 0.2)"]),
    "projector_around_sb3.py": (
        ["--steps", "64", "--updates", "20", "--episodes", "4"],
        ["PPO of Stable-Baselines3, alone", "with the projector", "intervention"],
    ),
}


#: Needs an exported policy: tests/deploy/test_files.py runs it.
ELSEWHERE = {"drive_onnx.py"}


def test_every_example_is_tried():
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(SHORT) | ELSEWHERE


@pytest.mark.parametrize("name", SHORT)
def test_example(name: str):
    arguments, words = SHORT[name]
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    out = subprocess.run(command, capture_output=True, text=True)
    assert out.returncode == 0, out.stderr
    for word in words:
        assert word in out.stdout


def test_a_loop_of_fewer_than_eighty_lines():
    assert len((EXAMPLES / "cost_loss.py").read_text().splitlines()) < 80
