"""Several constraints in whole runs: trained, continued, tested, reported, each figure under its cost's name."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from small import EMPTY, SMALL, compose

from saferl.algorithms.assemble import build_trainer
from saferl.checkpoint.run import CONFIG
from saferl.config.limits import check_limits, order_limits
from saferl.report.command import main as report

TRAIN, TEST = ("train", "config"), ("evaluate", "evaluate")
ROAD = ("task=gs", "task.costs=[collision,comfort]", "task.duration=1")
RUNS = {
    "arsac": ("risk_limit.comfort=0.2", "risk_limit.collision=0.0", "projector.start=0"),
    "sac_lag": ("cost_limit=[0.1,0.2]",),
    "ppo_lag": ("cost_limit={comfort: 0.2, collision: 0.1}",),
}


def header(path: Path) -> list[str]:
    with path.open(newline="") as file:
        return next(csv.reader(file))


@pytest.mark.parametrize("algo", RUNS)
def test_a_run_on_the_road(algo: str, command, tmp_path: Path, capsys):
    options = (*SMALL, *EMPTY, *ROAD, f"algo={algo}", *RUNS[algo])
    command(*TRAIN, *options, "out=run")
    run = tmp_path / "run"
    cfg = OmegaConf.load(run / CONFIG)
    assert (cfg.risk_limit if algo == "arsac" else cfg.cost_limit) == ([0.0, 0.2] if algo == "arsac" else [0.1, 0.2])  # fmt: skip
    assert (cfg.cost_limit if algo == "arsac" else cfg.risk_limit) is None
    columns = {f"{k}_{c}" for k in ("cost_return", "lagrange_multiplier") for c in ("collision", "comfort")}  # fmt: skip
    assert columns <= set(header(run / "metrics.csv")) and "cost_return" not in header(run / "metrics.csv")  # fmt: skip

    command(*TRAIN, f"resume={run}", "frames=40")  # the rest of a longer budget
    assert (run / "metrics.csv").read_text().splitlines()[-1].startswith("40,")

    capsys.readouterr()
    extra = ("trace=all", "why=true") if algo == "arsac" else ()
    command(*TEST, f"checkpoint={run}", "episodes=2", "out=test", "threads=1", *extra)
    figures = json.loads((tmp_path / "test/metrics.json").read_text())
    assert {"cost_return_collision", "cost_return_comfort"} <= set(figures)
    told = capsys.readouterr().out
    assert "cost comfort" in told and ("cost_limit.comfort=0.2 is " in told) == (algo != "arsac")
    report([str(run), str(tmp_path / "test"), "--out", str(tmp_path / "report")])
    page = (tmp_path / "report/report.html").read_text()
    assert (tmp_path / "report/report.md").exists() and "cost_return_comfort" in page


def test_a_checkpoint_holds_what_is_known_of_each_cost(tmp_path: Path):
    """Multipliers, windows and watches."""
    options = compose(*SMALL, "algo=sac_lag", "task=cart", "task.costs=[effort,motion]", "cost_limit=[0.1,0.2]", "task.horizon=4")  # fmt: skip
    first = build_trainer(options, tmp_path)
    first.train()
    multiplier = first.learner.loss.lagrange.value
    assert multiplier.shape == (2,) and multiplier[0] != multiplier[1]
    again = build_trainer(options, tmp_path)
    again.resume()
    assert torch.equal(again.learner.loss.lagrange.value, multiplier)
    assert again.watch.state_dict() == first.watch.state_dict()
    assert again.watch.state_dict()["each"][1]["dearest"] > 0
    assert again.window.summary() == first.window.summary()
    assert again.window.values["cost_return"].shape[1:] == (2,)


COSTS = ("collision", "comfort")
ORDERED = "cost_limit must be a limit for each of task.costs=[collision,comfort], as cost_limit=[1,2] or cost_limit.collision=1 cost_limit.comfort=2, got "  # fmt: skip
WRONG = {
    "cost_limit=0.1": f"{ORDERED}0.1.",
    "cost_limit=[0.1]": f"{ORDERED}[0.1].",
    "cost_limit=[0.1,0.2,0.3]": f"{ORDERED}[0.1, 0.2, 0.3].",
    "+cost_limit.collision=0.1": f"{ORDERED}{{'collision': 0.1}}.",
    "cost_limit={collision: 1, speed: 2}": "cost_limit.speed is of no cost: choose from collision, comfort (task.costs).",
    "cost_limit=[0.1,-1]": "cost_limit[1] must be >= 0, got -1.",
    "cost_limit=[0.1,low]": "cost_limit[1] must be a number, got 'low'.",
    "gamma=0.9": f"{ORDERED}0.1.",
}  # fmt: skip


@pytest.mark.parametrize("given", WRONG)
def test_wrong_limits_are_refused_in_one_line(given: str, refusal):
    assert WRONG[given] in refusal(*TRAIN, *SMALL, *EMPTY, *ROAD, "algo=sac_lag", given)


def test_what_has_one_constraint_says_so(refusal):
    line = refusal(*TRAIN, *SMALL, *EMPTY, *ROAD, "algo=cpo", "cost_limit=[0.1,0.2]")
    assert "cost_limit must be one number, as CPO's step has one constraint, got [0.1, 0.2]" in line
    line = refusal(*TRAIN, *SMALL, *EMPTY, "algo=sac_lag", "cost_limit=[0.1,0.2]")
    assert "cost_limit must be one number, as task.costs is cost, got [0.1, 0.2]." in line
    line = refusal(*TRAIN, *SMALL, *EMPTY, "algo=sac_lag", "task.costs=[crash]")
    assert "costs must be different names among cost, collision, road, comfort, speed" in line


def test_limits_in_order():
    """By name in any order; one number where nothing reads it is no limit; of one cost all stays as it is."""
    cfg = compose("algo=sac_lag", "cost_limit={comfort: 0.2, collision: 0.1}")
    order_limits(cfg, COSTS)
    assert cfg.cost_limit == [0.1, 0.2] and cfg.risk_limit is None
    assert cfg.lagrange.signal.cost_limit == [0.1, 0.2]
    order_limits(cfg, COSTS)  # a run's own file
    assert cfg.cost_limit == [0.1, 0.2]
    cfg = compose("algo=sac_lag", "cost_limit=[0.3]")
    check_limits(cfg, ["cost_limit=[0.3]"])
    assert cfg.cost_limit == 0.3 and cfg.risk_limit == 0.05
    cfg = compose("algo=sac", "cost_limit=0.3")
    with pytest.raises(ValueError, match="cost_limit must be a limit for each of"):
        check_limits(cfg, ["cost_limit=0.3"], COSTS)
