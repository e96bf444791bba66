"""Figures against closed forms and hand-made tables."""

from __future__ import annotations

import csv
import errno
import math
import re
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from saferl.envs.intersection import Scenario
from saferl.evaluation.compare import cell
from saferl.evaluation.statistics import FIGURES, mean_interval, summarise, table, wilson
from saferl.training.records import CsvLog, EpisodeWindow, finished_episodes


@pytest.mark.parametrize(("hits", "trials"), [(0, 5), (1, 1), (3, 8), (190, 200), (500, 500)])
def test_wilson_is_the_closed_form(hits: int, trials: int):
    """(p + z^2/2n +- z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n), Wilson 1927."""
    z, p = 1.959963984540054, hits / trials
    centre = p + z * z / (2 * trials)
    half = z * math.sqrt(p * (1 - p) / trials + z * z / (4 * trials * trials))
    low, high = ((centre + sign * half) / (1 + z * z / trials) for sign in (-1, 1))
    assert wilson(hits, trials) == pytest.approx((low, high), abs=1e-12)


def test_mean_interval_by_hand():
    """1, 2, 3, 4: mean 2.5, s = sqrt(5/3), t(0.975, 3) = 3.182446."""
    half = 3.182446305284263 * math.sqrt(5 / 3) / 2
    assert mean_interval([1, 2, 3, 4]) == pytest.approx((2.5 - half, 2.5 + half), abs=1e-9)
    assert mean_interval([7.0]) == (None, None)
    assert mean_interval([2.0, 2.0]) == (2.0, 2.0)


def episode(**values: float) -> dict[str, float]:
    row = dict.fromkeys(
        ("collision", "success", "frozen", "return", "speed", "cost_return", "intervention_rate"),
        0.0,
    )
    return row | values


def test_summarise():
    rows = [episode(success=1.0, speed=8.0, intervention_rate=0.0, **{"return": 10.0})] * 3
    rows.append(episode(collision=1.0, speed=4.0, intervention_rate=1.0, **{"return": -50.0}))
    figures = summarise(rows)
    assert list(figures) == list(FIGURES)
    assert figures["success_rate"]["mean"] == 0.75
    assert (figures["success_rate"]["low"], figures["success_rate"]["high"]) == wilson(3, 4)
    assert figures["speed"]["mean"] == 7.0 and figures["return"]["mean"] == -5.0
    # A mean of shares has a t interval, which would reach below 0 here: (-0.55, 1.05).
    assert figures["intervention_rate"] == {"mean": 0.25, "low": 0.0, "high": 1.0}
    with pytest.raises(ValueError, match="at least one episode"):
        summarise([])
    text = table(figures, "title")
    assert text.startswith("title\n") and "75.00 %" in text


def test_an_interval_stays_where_its_figure_can_be():
    """Neither below 0 for a speed, nor of one episode, nor of a projector that is not there."""
    rows = [episode(speed=v, cost_return=c) for v, c in ((0.0, 0.0), (0.1, 0.0), (12.0, 2.0))]
    for row in rows:
        del row["intervention_rate"]
    figures = summarise(rows)
    assert mean_interval([0.0, 0.1, 12.0])[0] < 0 == figures["speed"]["low"]
    assert figures["cost_return"]["low"] == 0.0 and "intervention_rate" not in figures
    assert summarise([episode(**{"return": value}) for value in (-9.0, 1.0)])["return"]["low"] < -9
    single = summarise(rows[:1])
    assert single["speed"] == {"mean": 0.0, "low": None, "high": None}
    assert single["success_rate"]["high"] == wilson(0, 1)[1]
    assert re.search(r"^speed m/s +0.00 +-$", table(single), re.MULTILINE)
    assert cell([{"episodes": 1, **single}], "speed") == "0 -"
    assert cell([{"episodes": 3, **figures}, {"episodes": 1, **single}], "speed").startswith(
        "2.017 [0, "
    )


def collected(done: list[list[bool]]) -> TensorDict:
    """[B, T] transitions; the return of each is 10 b + t."""
    flags = torch.tensor(done)
    envs, steps = flags.shape
    value = 10.0 * torch.arange(envs)[:, None] + torch.arange(steps)
    no = torch.zeros_like(flags)[..., None]
    following = {
        "done": flags[..., None],
        "episode_reward": value[..., None],
        "episode_cost": value[..., None] / 100,
        "collision": no.clone(),
        "offroad": no.clone(),
        "success": no.clone(),
    }
    return TensorDict({"next": following}, [envs, steps])


def test_finished_episodes_and_window():
    data = collected([[False, True, False], [True, False, True]])
    data["next", "success"][0, 1] = True
    data["next", "offroad"][1, 0] = True
    episodes = finished_episodes(data, Scenario().outcomes)
    assert episodes["return"].tolist() == [1.0, 10.0, 12.0]
    assert episodes["cost_return"].tolist() == pytest.approx([0.01, 0.1, 0.12])
    assert episodes["success"].tolist() == [1, 0, 0]
    assert episodes["collision"].tolist() == [0, 1, 0]  # off the road counts
    assert episodes["frozen"].tolist() == [0, 0, 1]

    window = EpisodeWindow(Scenario().outcomes, length=2)
    assert window.summary() == {} and not window.short()
    window.extend(collected([[False]]))
    assert all(math.isnan(value) for value in window.summary().values()) and not window.short()
    assert "success_rate" in window.summary()
    assert len(window.extend(data)) == 3
    assert window.summary()["return"] == 11.0  # the last two
    assert window.summary()["frozen_rate"] == window.summary()["collision_rate"] == 0.5
    assert window.short() == {"return": "11.0", "cost": "0.110", "CR": "50%", "SR": "0%"}
    assert len(window.extend(collected([[False]]))) == 0  # no episode ended (docs/pitfalls.md, 10)
    assert window.summary()["return"] == 11.0


def test_csv_takes_late_columns(tmp_path: Path):
    log = CsvLog(tmp_path / "log.csv")
    log.write({"a": 1})
    log.write({"a": 2, "b": 3})
    log.write({"b": 4})
    with log.path.open() as file:
        rows = list(csv.DictReader(file))
    assert rows == [{"a": "1", "b": ""}, {"a": "2", "b": "3"}, {"a": "", "b": "4"}]
    assert log.read() == [{"a": 1.0}, {"a": 2.0, "b": 3.0}, {"b": 4.0}]
    assert CsvLog(tmp_path / "none.csv").read() == []


def test_a_log_without_room_is_named(tmp_path: Path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(CsvLog, "_write", full)
    with pytest.raises(OSError, match=r"No space left on device: .*log\.csv"):
        CsvLog(tmp_path / "log.csv").write({"a": 1.0})


def test_each_of_several_costs_has_a_row_and_a_verdict():
    rows = [
        {"return": 1.0, "cost_return_road": road, "cost_return_speed": 2.0, "success": 1}
        for road in (0.1, 0.3)
    ]
    figures = summarise(rows)
    assert [*figures] == ["success_rate", "return", "cost_return_road", "cost_return_speed"]
    assert figures["cost_return_road"]["mean"] == pytest.approx(0.2)
    lines = table(figures, cost_limit=[0.5, 1.0]).splitlines()
    assert lines[-2].startswith("cost road") and lines[-2].endswith("cost_limit.road=0.5 is kept")
    assert lines[-1].startswith("cost speed") and lines[-1].endswith("cost_limit.speed=1 is broken")
    assert "cost_limit" not in table(figures)
