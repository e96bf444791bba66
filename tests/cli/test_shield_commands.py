"""The shield on the command line: in tests, in a training, and in rows of its own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from small import EMPTY, SMALL, compose

from saferl.algorithms.assemble import build_agent
from saferl.config.flat import flat, system_name
from saferl.envs.transforms import SafetyProjector, Shield

SHORT = ("task=gs", "episodes=1", "env.num_envs=1", "task.duration=1", "task.vehicles=2")
TEST = ("evaluate", "evaluate")


def told(folder: str) -> dict:
    return json.loads((Path(folder) / "metrics.json").read_text())


def test_a_driver_behind_a_shield_has_a_row_of_its_own(command):
    command(*TEST, "policy=blind", "projector=shield", *SHORT, "trace=all", "out=test")
    figures = told("test")
    assert figures["policy"] == "blind + shield" and "intervention_rate" in figures
    assert (Path("test") / "trace.npz").is_file() and (Path("test") / "latency_ms.json").is_file()


def test_policies_keep_their_own_projector_before_it(command):
    command(*TEST, "-m", "pretrained=arsac", "projector=none,shield", *SHORT, "out=tests")
    names = {json.loads(p.read_text())["policy"] for p in Path("tests").glob("*/metrics.json")}
    assert names == {"arsac (arsac)", "arsac + shield (arsac)"}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("policy=blind", "projector=gradient"), "SafetyProjector corrects by a policy's own critics"),
        (("policy=blind", "projector=shield_simulator", "env=highway"), "which HighwayIntersection is not: take env=batched"),
        (("policy=blind", "projector=shield", "projector.horizon=0"), "horizon must be > 0, got 0"),
        (("policy=blind", "projector=shield", "projector.reach=3"), "reach"),
    ],
)  # fmt: skip
def test_what_cannot_be_meant_is_refused(given, message: str, refusal):
    assert message in refusal(*TEST, *given, *SHORT)


@pytest.mark.parametrize(
    ("algo", "projector", "first"),
    [
        ("sac", "shield", type(None)),
        ("ppo", "shield", type(None)),
        ("arsac", "gradient_shield", SafetyProjector),
    ],
)
def test_a_shield_composes_with_every_algorithm(algo: str, projector: str, first: type):
    cfg = compose(*SMALL, *EMPTY, f"algo={algo}", f"projector={projector}")
    shield = build_agent(cfg).projector
    assert isinstance(shield, Shield) and isinstance(shield.first, first)
    assert system_name(flat(cfg)) == f"{algo} + shield"


def test_a_training_behind_a_shield_is_called_so(command):
    command(
        "train",
        "config",
        *SMALL,
        "algo=sac",
        "projector=shield",
        "task=gs",
        "task.duration=2",
        "out=run",
    )
    assert told("run/evaluation")["policy"] == "sac + shield"
    assert (
        (Path("run/evaluation") / "episodes.csv")
        .read_text()
        .partition("\n")[0]
        .count("intervention_rate")
    )
