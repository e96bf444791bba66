"""Which runs count, and what is said of the others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made import EPISODES, make

from saferl.checkpoint.lock import alone, worker
from saferl.evaluation.rows import read
from saferl.report.runs import BROKEN, FINISHED, FOREIGN, INTERRUPTED, RUNNING, STATES, find


def states(folder: Path) -> dict[str, tuple[str, str]]:
    return {run.folder.name: (run.state, run.reason) for run in find([folder])}


def test_a_finished_runs_figures_by_task(tmp_path: Path):
    make(tmp_path / "run", collisions=[0, 1, 2], speed=7.5)  # lt, gs_inner, gs_outer
    (run,) = find([tmp_path])
    assert (run.state, run.reason, run.algo, run.seed) == (FINISHED, "", "arsac", 0)
    lt, gs, rt = run.test
    assert lt.tolist() == [[1, 0, 0, -100, 7.5], [0, 1, 0, 100, 7.5]]
    assert gs[:, 0].tolist() == [1, 1, 0, 0] and rt[:, 0].tolist() == [0, 0]


def test_a_run_that_somebody_works_on_is_told_from_one_that_was_left(tmp_path: Path):
    for name in ("held", "left"):
        (make(tmp_path / name) / "evaluation/metrics.json").unlink()
    (tmp_path / "left/.lock").touch()
    (tmp_path / "left/.holder").write_text("process 1 on nowhere\n")  # it was killed
    with alone(tmp_path / "held", "out"):
        found = states(tmp_path)
        assert worker(tmp_path / "left") is None
    state, reason = found["held"]
    assert state == RUNNING and reason.startswith("process ")
    assert reason.endswith("at frame 30000 of 30000")
    assert found["left"][0] == INTERRUPTED and "resume=" in found["left"][1]
    assert worker(tmp_path / "held") is None


def test_damage_is_told_with_its_file(tmp_path: Path):
    def damage(name: str, file: str, text: str | None) -> None:
        path = make(tmp_path / name) / file
        path.unlink() if text is None else path.write_text(text)

    whole = (make(tmp_path / "good") / "evaluation/episodes.csv").read_text()
    half = whole[:-30]
    damage("json", "evaluation/metrics.json", '{"episodes": ')
    damage("empty", "evaluation/metrics.json", "{}")
    damage("list", "evaluation/metrics.json", "[]")
    damage("config", "config.yaml", "seed: [")
    damage("nameless", "config.yaml", "seed: 0\n")
    damage("missing", "config.yaml", None)
    damage("cut", "evaluation/episodes.csv", half)
    damage("few", "evaluation/episodes.csv", half.rpartition("\n")[0] + "\n")
    damage("gone", "evaluation/episodes.csv", None)
    damage("route", "evaluation/episodes.csv", whole.replace(",rt,", ",uturn,"))
    damage("columns", "evaluation/episodes.csv", "episode,route\n0,lt\n")
    damage("curve", "metrics.csv", "frames,return\n")
    damage("timing", "timing.csv", None)
    damage("word", "metrics.csv", "frames,return\n1,good\n")
    damage("clock", "timing.csv", "frames,learn\n1,long\n")
    (tmp_path / "refused").mkdir()
    (tmp_path / "refused/error.txt").write_text("seed must be a whole number, got 0.5.\n")
    found = states(tmp_path)
    assert found.pop("good") == (FINISHED, "")
    assert {state for state, _ in found.values()} == {BROKEN}
    for name, (_, reason) in found.items():
        assert reason and "\n" not in reason, name
    told = {name: reason for name, (_, reason) in found.items()}
    assert "config.yaml" in told["config"] and "config.yaml" in told["nameless"]
    assert told["missing"] == "it has no config.yaml"
    assert told["refused"] == "seed must be a whole number, got 0.5."
    assert "each row must have 7 cells" in told["cut"] and f"{EPISODES} episodes" in told["few"]
    assert "'uturn'" in told["route"] and "no column collision" in told["columns"]
    assert "metrics.csv" in told["curve"] and "timing.csv" in told["timing"]
    assert "column return must hold numbers" in told["word"]
    assert "column learn must hold numbers" in told["clock"]


def test_what_does_not_go_with_the_rest_is_foreign(tmp_path: Path):
    for seed in range(3):
        make(tmp_path / f"own{seed}", seed=seed)
    make(tmp_path / "sac", "sac", options=["env.num_envs=8", "record_every=77", "threads=1"])
    make(tmp_path / "shaped", "sac_rs")  # its reward in training is its own
    make(tmp_path / "ppo", "ppo_rs", options=["frames=60000"])  # of another family
    make(tmp_path / "long", "sac", options=["frames=60000"])
    make(tmp_path / "world", "rsac", options=["task.observation=world"])
    make(tmp_path / "task", "asac", options=["task=gs"])
    make(tmp_path / "dense", "asac", options=["task.scenario=dense"])
    make(tmp_path / "narrow", "arsac", 7, options=["encoder.width=48"])
    make(tmp_path / "twice", "arsac", 1)
    make(tmp_path / "cart", "sac", options=["task=cart"])
    make(tmp_path / "slow", "sac_lag", options=["env=highway"])
    found = states(tmp_path)
    own = {"own0", "own1", "own2", "sac", "shaped", "ppo"}
    assert {name for name, (state, _) in found.items() if state == FINISHED} == own
    told = {name: reason for name, (state, reason) in found.items() if state == FOREIGN}
    assert told["long"] == "frames=60000 (the others have 30000)"
    assert told["world"] == "task.observation=world (the others have route)"
    assert told["task"] == "task.task=gs (the others have mixed)"
    assert told["dense"] == "task.scenario=dense (the others have nominal)"
    assert "encoder.width=48 (others of its algorithm have" in told["narrow"]
    assert told["twice"] == f"it repeats seed 1 of arsac, which is {tmp_path / 'own1'}"
    assert told["cart"] == "task=cart is not the road"
    assert told["slow"].startswith("env._target_=saferl.envs.intersection.HighwayIntersection (the")
    assert len(found) == len(told) + len(own) and len(STATES) == 5


def test_a_folder_that_is_not_there(tmp_path: Path):
    with pytest.raises(ValueError, match="no such folder: .*nowhere"):
        find([tmp_path / "nowhere"])


def test_columns_are_numbers_where_they_can_be(tmp_path: Path):
    path = tmp_path / "rows.csv"
    path.write_text("route,speed,late\nlt,1.5,\nrt,2,3\n")
    columns = read(path)
    assert columns["route"].tolist() == ["lt", "rt"] and columns["speed"].tolist() == [1.5, 2.0]
    assert np.isnan(columns["late"][0]) and columns["late"][1] == 3.0
