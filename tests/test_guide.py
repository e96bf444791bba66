"""docs/guide.md: its files are written as they stand there, and its commands train."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from small import SMALL, fitting

GUIDE = (Path(__file__).parents[1] / "docs/guide.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", GUIDE, re.DOTALL)
COMMANDS = [line for kind, text in BLOCKS if kind == "bash" for line in text.splitlines()]
BUILT_IN = "python -m saferl --config-dir examples/new_algorithm algo=cautious_sac task=gs"


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The guide's folder."""
    root = tmp_path_factory.mktemp("my_project")
    for kind, text in BLOCKS:
        if kind in ("python", "yaml"):
            name = re.search(r"^# (my_\S+)$", text, re.MULTILINE)
            assert name, text
            path = root / name[1]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
    return root


def test_the_guide_has_its_parts():
    assert len(COMMANDS) == 6 and BUILT_IN in GUIDE


@pytest.mark.parametrize("command", COMMANDS)
def test_command_of_the_guide(command: str, project: Path):
    small = [o for o in SMALL if not o.startswith("frames=") or "frames=" not in command]
    arguments = [*command.split()[3:], *small, "frames=16", "task.vehicles=2"]
    if "task=gym" in command or "task=tank" in command:
        arguments.remove("task.vehicles=2")
    paths = os.pathsep.join([str(project), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, "-m", "saferl", *fitting(arguments)],
        cwd=project,
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and "Files: " in done.stdout, done.stderr
    assert "return" in done.stdout


def test_algorithm_of_the_examples(project: Path):
    root = Path(__file__).parents[1]
    options = [o for o in SMALL if not o.startswith(("frames=", "episodes="))]
    arguments = BUILT_IN.replace("examples", f"{root}/examples").split()[3:]
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "saferl",
            *fitting([*arguments, *options, "frames=16", "task.vehicles=0"]),
        ],
        cwd=project,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and "cautious_sac on gs" in done.stdout, done.stderr
