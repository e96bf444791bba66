"""Tests of policies side by side."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from saferl.checkpoint.run import CONFIG
from saferl.evaluation.compare import conditions_side_by_side as table
from saferl.evaluation.compare import finished, side_by_side
from saferl.evaluation.compare import measured_below as below
from saferl.evaluation.statistics import wilson


def played(policy: str, crashes: int, scenario: str = "nominal", **about) -> dict:
    """What ``metrics.json`` says of a test of 50 episodes; the scenario says the traffic."""

    def rate(count: int) -> dict:
        low, high = wilson(count, 50)
        return {"mean": count / 50, "low": low, "high": high}

    rates = {
        "collision_rate": rate(crashes),
        "success_rate": rate(50 - crashes),
        "frozen_rate": rate(0),
    }
    traffic = {"gap": {"nominal": 2.0, "dense": 1.0}[scenario], "vehicles": [5, 10]}
    return {
        **rates, "policy": policy, "env": "Batched", "task": "gs", "scenario": scenario, "traffic": traffic,
        "project": False, "episodes": 50, "seed": 0, **about,
    }  # fmt: skip


def cells(text: str) -> list[list[str]]:
    return [[cell for cell in line.split("  ") if cell] for line in text.splitlines()]


def test_a_row_begins_with_what_differs_and_nothing_that_follows_from_it():
    arsac = "arsac (a run)"
    tests = [
        played(arsac, 5, project=True, cost_limit=0.1),
        played(arsac, 6, "dense", project=True, cost_limit=0.1),
        played(arsac, 7, cost_limit=0.1),
        played("scripted", 0),
        played("scripted", 1, "dense"),
    ]
    head, *rows = cells(table(tests))
    assert [each.strip() for each in head] == [
        "policy", "scenario", "project", "episodes", "CR %", "SR %", "FR %"
    ]  # fmt: skip
    assert [[each.strip() for each in row[:4]] for row in rows] == [
        ["scripted", "nominal", "False", "50"],  # drivers stand first, else the oldest
        ["scripted", "dense", "False", "50"],
        [arsac, "nominal", "True", "50"],
        [arsac, "dense", "True", "50"],
        [arsac, "nominal", "False", "50"],
    ]
    assert [row[4].split()[0] for row in rows] == ["0.0", "2.0", "10.0", "12.0", "14.0"]
    low, high = wilson(7, 50)
    assert rows[-1][4].strip() == f"14.0 [{100 * low:.1f}, {100 * high:.1f}]"


def test_traffic_of_ones_own_is_told_apart():
    tests = [played("blind", 1), played("blind", 2, traffic={"gap": 3.0, "vehicles": [5, 10]})]
    head, *rows = cells(table(tests))
    assert [each.strip() for each in head[:2]] == ["traffic.gap", "episodes"]
    assert [row[0].strip() for row in rows] == ["2.0", "3.0"]
    tests = [played("blind", 1, changed={"task.duration": time}) for time in ("9", "25")]
    head, *rows = cells(table(tests))
    assert head[0].strip() == "task.duration" and len(rows) == 2


def test_seeds_are_taken_together_and_a_repetition_counts_once():
    tests = [played("sac (x)", 1), played("sac (x)", 3, seed=1), played("sac (x)", 1)]
    head, row = cells(table([*tests, played("blind", 9)]))[0::2]
    assert head[0].strip() == "policy" and [each.strip() for each in row[:2]] == ["sac (x)", "100"]
    assert row[2].strip().startswith("4.0 [")


def test_a_shorter_test_of_the_same_episodes_counts_no_further():
    """The first three of six are these three."""
    tests = [played("sac (x)", 1, episodes=3), played("sac (x)", 3, episodes=6), played("blind", 9)]
    _, _, row = cells(table(tests))
    assert [each.strip() for each in row[:2]] == ["sac (x)", "6"]


def test_a_run_counts_once_however_often_it_is_found(tmp_path: Path):
    for place, seed in (("a/one", 0), ("a/two", 1), ("b/again", 1)):
        folder = tmp_path / place
        (folder / "evaluation").mkdir(parents=True)
        (folder / CONFIG).write_text(f"algo_name: sac\ntask: {{task: gs}}\nseed: {seed}\n")
        (folder / "evaluation/metrics.json").write_text(json.dumps(played("sac", 5)))
    runs = finished([tmp_path, tmp_path / "a"])
    assert len(runs) == 3
    _, row = cells(side_by_side(runs))
    assert row[1].strip() == "2"


@pytest.mark.parametrize("text", ["a: [1", "", "seed: 0\n"])
def test_settings_that_are_damaged_are_told(text: str, tmp_path: Path):
    (tmp_path / "evaluation").mkdir()
    (tmp_path / "evaluation/metrics.json").write_text("{}")
    (tmp_path / CONFIG).write_text(text)
    with pytest.raises(ValueError, match=f"{tmp_path / CONFIG} is damaged"):
        finished([tmp_path])


def test_measured_below_a_folder_are_all_but_those_that_close_a_run(tmp_path: Path):
    for number, place in enumerate(
        ("a/b", "evaluation/gs", "run/evaluation", "run/evaluation/blind", "run/mine")
    ):
        folder = tmp_path / place
        folder.mkdir(parents=True)
        (folder / "metrics.json").write_text(json.dumps({"policy": place, "number": number}))
    (tmp_path / "run" / CONFIG).write_text("seed: 0\n")
    (tmp_path / "metrics.json").write_text("{}")  # somebody else's
    assert [test["policy"] for test in below([tmp_path, tmp_path / "a"])] == [
        "a/b", "evaluation/gs", "run/mine"
    ]  # fmt: skip
