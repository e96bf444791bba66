"""A report of real runs, small ones, which plays them again."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from small import SMALL

from saferl.evaluation.trace import TRACE, Trace
from saferl.report.command import main

TRAIN, TEST = ("train", "config"), ("evaluate", "evaluate")


def test_each_system_plays_the_same_episodes_again(command, tmp_path: Path, capsys, monkeypatch):
    small = (*SMALL, "evaluation.episodes=4", "task.vehicles=3", "task.duration=2", "frames=8")
    command(*TRAIN, *small, "experiment=paper_comparison", "algo=arsac,sac", "seed=0", "-m")
    command(*TEST, "policy=blind", "task=lt", "episodes=3", "trace=all", "out=paper/alone")
    (tmp_path / "paper/cut").mkdir()
    whole = (tmp_path / f"paper/alone/{TRACE}").read_bytes()
    (tmp_path / f"paper/cut/{TRACE}").write_bytes(whole[:99])
    capsys.readouterr()
    main(["paper", "--out", "report", "--play", "3"])
    out = capsys.readouterr().out
    assert "Runs: 2 finished." in out and out.splitlines()[-1] == "report/report.html"
    traces = {
        path.parent.name: Trace.load(path) for path in tmp_path.glob(f"report/traces/*/{TRACE}")
    }
    assert set(traces) == {f"{name}-seed0" for name in ("arsac", "sac", "scripted", "blind")}
    seeds = [trace.episodes["seed"].tolist() for trace in traces.values()]
    assert all(each == seeds[0] for each in seeds) and len(seeds[0]) == 3
    assert traces["arsac-seed0"].about["risk_limit"] == 0.05
    html = (tmp_path / "report/report.html").read_text(encoding="utf-8")
    data = json.loads(re.search(r"const DATA = (.*?);</script>", html)[1])
    named = [(run["about"].get("label"), run["about"].get("training_seed")) for run in data["runs"]]
    assert sorted(map(str, named)) == sorted(
        map(
            str,
            [
                ("ARSAC", 0),
                ("SAC", 0),
                ("cautious driver", None),
                ("blind driver", None),
                ("blind driver", None),
            ],
        )
    )
    for words in ("Comparison on three driving tasks", "The paper's claims", "Learning curves"):
        assert words in html
    with monkeypatch.context() as patch:  # what was played is kept
        patch.setattr("saferl.report.traces.record", None)
        main(["paper", "--out", "report", "--play", "3"])
    command("train", "config", "resume=paper/sac/seed0", "frames=16")  # another policy
    capsys.readouterr()
    main(["paper", "--out", "report", "--play", "3"])
    assert "SAC plays 3 episodes again." in capsys.readouterr().out
    main(["paper", "--numbers", "published"])
    capsys.readouterr()
    with pytest.raises(SystemExit, match="--numbers: paper/sac/seed0 holds another run"):
        main(["published", "--numbers", "paper"])
    main(["published", "--out", "second", "--play", "3"])  # without checkpoints
    assert "Nothing is played: no finished run has its checkpoint" in capsys.readouterr().out
    assert (tmp_path / "second/report.html").is_file()
    with pytest.raises(SystemExit, match="--play must be >= 0, got -1"):
        main(["paper", "--play", "-1"])


def test_a_trained_policys_crashes_are_explained(command, tmp_path: Path, capsys):
    command(*TRAIN, *SMALL, "algo=arsac", "task=lt", "frames=8", "out=run")
    command(*TEST, "checkpoint=run", "episodes=4", "trace=collisions", "why=true", "out=test")
    out = capsys.readouterr().out
    rows = (tmp_path / "test/crashes.csv").read_text().splitlines()
    trace = Trace.load(tmp_path / "test")
    assert len(rows) == len(trace) + 1 and f"{len(trace)} crashes in 4 episodes" in out
    assert trace.about["policy"] == "arsac (run)" and trace.about["risk_limit"] == 0.05
    command(
        *TEST,
        "policy=scripted",
        "task.vehicles=0",
        "episodes=2",
        "trace=collisions",
        "why=true",
        "out=none",
    )
    assert "No crash in 2 episodes." in capsys.readouterr().out
    assert len((tmp_path / "none/crashes.csv").read_text().splitlines()) == 1
    assert not (tmp_path / f"none/{TRACE}").exists()


def test_a_trace_alone_is_played_without_a_run(command, tmp_path: Path, capsys):
    command(*TEST, "policy=blind", "task=lt", "episodes=2", "trace=all", "out=alone")
    capsys.readouterr()
    main(["alone", "--out", "report"])
    assert capsys.readouterr().out == "report/report.html\n"
    assert [path.name for path in (tmp_path / "report").iterdir()] == ["report.html"]
