"""Searches for hyper-parameters: what they refuse, find, cut short and take up again."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import optuna
import pytest
import torch
from optuna.trial import TrialState
from small import SMALL

from saferl.cli import search as searching
from saferl.cli.tune import main
from saferl.config.space import split
from saferl.envs import Cart

CART = (*(s for s in SMALL if "rollout" not in s), "task=cart", "algo=sac_lag")
TAU = "learning.tau=tag(log,interval(0.001,0.1))"


@pytest.fixture(autouse=True)
def there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)


def trials(out: str = "tune") -> list[optuna.trial.FrozenTrial]:
    return optuna.load_study(study_name="saferl", storage=f"sqlite:///{out}/study.db").trials


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("algo=sac",), "Give at least one setting to search: KEY=interval(LOW,HIGH)"),
        (("learning.tau=interval(0.1,0.1)",), "is empty: its low end must be below its high end"),
        (("learning.tau=tag(log,interval(0,1))",), "the low end of a logarithm must be > 0, got 0.0"),
        (("learning.tau=tag(big,interval(0.1,1))",), "a tag must be log, got big"),
        (("learning.tau=choice(0.1)",), "has nothing to search: give two values or more"),
        (("learning.tau=range(5,5)",), "has nothing to search"),
        (("lerning.tau=0.1,0.2",), "unknown key 'lerning.tau'"),
        (("learning.tau=interval(0.1,2)",), "learning.tau must be >= 0 and <= 1, got 2.0"),
        (("encoder.width=interval(16,64)",), "encoder.width"),
        (("encoder=mlp,foo",), "encoder must be one of mlp, mmam, set, got 'foo'"),
        ((TAU, "learning.tau=0.1"), "learning.tau is searched, and given twice"),
        ((TAU, "out=x"), "out is not of a search: give the search's folder with --out DIR"),
        ((TAU, "resume=x"), "resume is not of a search: the same command goes on"),
        ((TAU, "gamma=2"), "gamma must be >= 0 and <= 1, got 2"),
        ((TAU, "--trials", "0"), "--trials must be >= 1, got 0"),
        ((TAU, "lagrange=statewise,none"), "needs lagrange, got lagrange=none"),
    ],
    ids=str,
)  # fmt: skip
def test_what_cannot_be_meant_is_refused_before_anything_starts(
    arguments: tuple[str, ...], message: str, tmp_path: Path
):
    with pytest.raises(SystemExit) as refused:
        main([*CART, *arguments])
    line = str(refused.value)
    assert line.startswith("error: ") and "\n" not in line and message in line, line
    assert not list(tmp_path.iterdir())


def test_a_space_is_written_as_hydra_sweeps():
    fixed, (tau, width, steps, algo) = split(
        ["seed=1", TAU, "encoder.width=int(interval(16,64))", "+a.b=range(2,10,2)", "algo=choice(sac,asac)"]
    )  # fmt: skip
    assert fixed == ["seed=1"] and (tau.low, tau.high, tau.log) == (0.001, 0.1, True)
    assert (width.low, width.high, width.log) == (16, 64, False) and type(width.low) is int
    assert (steps.key, steps.low, steps.high, steps.step) == ("+a.b", 2, 8, 2)
    assert algo.choices == ("sac", "asac")


@pytest.fixture
def closed_form(monkeypatch: pytest.MonkeyPatch):
    """In place of a training the policy that is best for reward - multiplier * cost, and its sums."""
    cart = Cart()

    def train_into(run: Path, cfg: Any, overrides: Any, prepare: Any = None) -> None:
        gain = cart.gain(cfg.lagrange.multiplier.init, 0.9)
        reward, cost = cart.sums(gain, 1.0, cart.horizon)
        figures = {"return": {"mean": reward}, "cost_return": {"mean": cost}}
        (run / "evaluation").mkdir(parents=True)
        (run / "evaluation/metrics.json").write_text(json.dumps(figures))

    monkeypatch.setattr(searching, "train_into", train_into)
    return cart


def test_the_best_trial_is_the_best_that_keeps_the_limit(closed_form: Cart, capsys):
    """Against the cart's constrained optimum, whose return a larger cost alone could pass."""
    space = "lagrange.multiplier.init=tag(log,interval(0.01,10))"
    main([*CART, "cost_limit=0.3", space, "--trials", "20"])
    best = closed_form.optimum(0.3, 0.9, cost_gamma=1.0, horizon=closed_form.horizon)
    reward, _ = closed_form.sums(best, 1.0, closed_form.horizon)
    (found, *_), told = trials_by_value(0.3), capsys.readouterr().out
    assert reward * 1.05 < found.value <= reward + 1e-6
    over = [t for t in trials() if t.user_attrs["cost"] > [0.3]]
    assert over and max(t.value for t in over) > found.value  # these are not taken
    lines = told[told.index("trial ") :].splitlines()
    assert lines[1].split()[0] == str(found.number) and "over" not in lines[1]
    value = found.params["lagrange.multiplier.init"]
    assert lines[-1].startswith("python -m saferl ") and f"lagrange.multiplier.init={value}" in lines[-1]  # fmt: skip


def trials_by_value(limit: float) -> list[optuna.trial.FrozenTrial]:
    within = [t for t in trials() if t.user_attrs["cost"] <= [limit]]
    return sorted(within, key=lambda t: -t.value)


def test_a_trial_behind_the_others_is_cut_short(monkeypatch: pytest.MonkeyPatch, capsys):
    """Eight trials of a rising return, the ninth costs more than it may."""
    count = iter(range(100))

    def train_into(run: Path, cfg: Any, overrides: Any, prepare: Any) -> None:
        number = next(count)
        cost = 1.0 if number == 8 else 0.1
        figures = {"return": float(number), "cost_return": cost}
        trainer = SimpleNamespace(
            after_collect=[],
            progress=SimpleNamespace(updates=1),
            window=SimpleNamespace(summary=lambda: figures),
            watch=SimpleNamespace(limit=0.2),
            costs=["cost"],
        )
        prepare(trainer)
        for step in (1, 4, 8, 12, 20):
            trainer.after_collect[0]({}, step / 20)
        (run / "evaluation").mkdir(parents=True)
        told = {name: {"mean": value} for name, value in figures.items()} | {
            "cost_return": {"mean": 0.0}
        }
        (run / "evaluation/metrics.json").write_text(json.dumps(told))

    monkeypatch.setattr(searching, "train_into", train_into)
    main([*CART, "cost_limit=0.2", TAU, "--trials", "9"])
    *others, last = trials()
    assert [t.state for t in others] == [TrialState.COMPLETE] * 8
    assert last.state is TrialState.PRUNED
    assert list(last.intermediate_values) == [1, 4, 8] and last.user_attrs["cost"] == [1.0]
    assert {t.constraints["cost_return"] for t in others} == {-0.2}  # the closing test's
    assert "cut short" in capsys.readouterr().out


def test_a_search_goes_on_where_it_was_interrupted(monkeypatch: pytest.MonkeyPatch, capsys):
    """In the middle of a training: its trial goes on from its checkpoint, with the same settings."""
    real, calls = searching.train_into, []

    def interrupted(run: Path, cfg: Any, overrides: Any, prepare: Any) -> None:
        def once(trainer: Any) -> None:
            prepare(trainer)
            calls.append((run.name, overrides))
            if len(calls) == 2:
                trainer.after_collect.append(lambda finished, spent: stop(trainer))

        def stop(trainer: Any) -> None:
            trainer.save()
            raise KeyboardInterrupt("stopped")

        real(run, cfg, overrides, prepare=once)

    monkeypatch.setattr(searching, "train_into", interrupted)
    asked = [*CART, "cost_limit=1", "frames=64", TAU, "--trials", "2"]
    with pytest.raises(SystemExit) as left:
        main(asked)
    assert left.value.code == 130 and "The same command goes on." in capsys.readouterr().err
    assert [t.state for t in trials()] == [TrialState.COMPLETE, TrialState.RUNNING]
    main(asked)
    assert "Resumed " in capsys.readouterr().out or Path("tune/trial_0001/checkpoints").is_dir()
    assert [t.state for t in trials()] == [TrialState.COMPLETE] * 2
    assert [name for name, _ in calls] == ["trial_0000", "trial_0001", "trial_0001"]
    assert calls[1] == calls[2] and all(math.isfinite(t.value) for t in trials())
    rows = Path("tune/trial_0001/metrics.csv").read_text().splitlines()
    assert rows[-1].startswith("64,")
    main(asked)  # nothing is left to do
    assert len(calls) == 3 and torch.get_num_threads() == 1
    with pytest.raises(SystemExit, match="holds a search with other settings"):
        main([*asked, "gamma=0.9"])


def test_several_costs_have_a_limit_each(monkeypatch: pytest.MonkeyPatch, capsys):
    """The second trial earns more, and its motion costs more than it may."""
    costs = iter([(0.1, 0.2), (0.1, 0.4)])

    def train_into(run: Path, cfg: Any, overrides: Any, prepare: Any) -> None:
        effort, motion = next(costs)
        figures = {"return": motion, "cost_return_effort": effort, "cost_return_motion": motion}
        (run / "evaluation").mkdir(parents=True)
        told = {name: {"mean": value} for name, value in figures.items()}
        (run / "evaluation/metrics.json").write_text(json.dumps(told))

    monkeypatch.setattr(searching, "train_into", train_into)
    two = ("task.costs=[effort,motion]", "cost_limit=[0.2,0.3]")
    main([*CART, *two, TAU, "--trials", "2"])
    assert [trial.constraints for trial in trials()] == [
        pytest.approx({"cost_return_effort": -0.1, "cost_return_motion": each})
        for each in (-0.1, 0.1)
    ]
    out = capsys.readouterr().out
    assert out[out.index("trial ") :].splitlines()[1].split()[:4] == ["0", "0.2", "0.1", "0.2"]
