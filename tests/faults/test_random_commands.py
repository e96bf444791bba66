"""Command lines at random: each trains, or is refused in one line that names a setting."""

from __future__ import annotations

import os
import re
import shutil
import sys
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from small import SMALL, compose, fitting

from saferl.checkpoint.run import latest
from saferl.cli.launch import launch
from saferl.config.catalog import GROUPS, options
from saferl.config.flat import flat

#: Of a training of three updates, which what is drawn may replace.
FEW = (*SMALL, "task.vehicles=1", "task.duration=2")
CHOSEN = {group: sorted(options(group)) for group in GROUPS}
#: What takes minutes, needs a package that may be missing, or another's service.
LONG = {("experiment", name) for name in ("speed", "paper_ablation", "paper_comparison")}
LONG |= {
    ("logger", "wandb"),
    ("task", "gym"),
    ("env", "gym"),
    ("collector", "multi"),
    ("collector", "ray"),
}
EDGES = [
    "0",
    "1",
    "-1",
    "2",
    "3",
    "0.5",
    "1e-9",
    "1e9",
    "1e30",
    "-0.0",
    "null",
    "true",
    "false",
    "nan",
    "inf",
]
EDGES += [
    "abc",
    "''",
    "[]",
    "[0]",
    "[1,1]",
    "{}",
    "9999999999999999999",
    "-1e-300",
    "[1,null]",
    "${gamma}",
]
#: How long or where, not what.
ELSEWHERE = re.compile(
    r"out|resume|init|seed|frames|episodes|device|compile|evaluation\.episodes|hydra.*|env\.num_envs"
)


def keys() -> list[str]:
    """The settings of a few compositions."""
    found: dict[str, None] = {}
    for algo in ("arsac_plus", "sac_lag", "cpo", "arppo", "ppo_rs"):
        for task in ("gs", "cart"):
            with_shape = () if task == "gs" else ("shaping=none",)
            cfg = compose(f"algo={algo}", f"task={task}", *with_shape)
            found |= dict.fromkeys(flat(OmegaConf.to_container(cfg, resolve=False)))
    return [key for key in found if "_target_" not in key and not ELSEWHERE.fullmatch(key)]


CHOICES = st.sampled_from(
    [f"{g}={o}" for g, names in CHOSEN.items() for o in names if (g, o) not in LONG]
)
SETTINGS = st.builds("{}={}".format, st.sampled_from(keys()), st.sampled_from(EDGES))
LINES = st.lists(st.one_of(CHOICES, SETTINGS), min_size=1, max_size=4)


def run(line: list[str]) -> None:
    here, argv, folder = Path.cwd(), sys.argv, Path(tempfile.mkdtemp())
    os.chdir(folder)
    arguments = [*FEW, *line]
    experiment = [each for each in line if each.startswith("experiment=")]
    if experiment:
        arguments.append("episodes=null" if "frames" not in line else "")
    sys.argv = ["saferl", *fitting([each for each in arguments if each]), "out=run"]
    try:
        launch("train", "config")
        assert latest(folder / "run").exists() and (folder / "run/evaluation/metrics.json").exists()
    except SystemExit as refused:
        said = str(refused.code)
        assert said.startswith("error: ") and "\n" not in said, said
        assert "Traceback" not in said and len(said) < 1500, said
        assert re.search(
            r"[a-z_]+[.=]|[a-z]+_[a-z]+|must|unknown|needs|takes|missing|frame", said
        ), said
    finally:
        os.chdir(here)
        sys.argv = argv
        shutil.rmtree(folder, ignore_errors=True)


CHECKS = [HealthCheck.too_slow, HealthCheck.data_too_large]


@settings(max_examples=5, deadline=None, suppress_health_check=CHECKS, derandomize=True)
@given(LINES)
def test_a_random_command_line_trains_or_is_refused(line: list[str]):
    run(line)


@pytest.mark.slow
@settings(max_examples=400, deadline=None, suppress_health_check=CHECKS)
@given(LINES)
def test_many_random_command_lines_train_or_are_refused(line: list[str]):
    run(line)
