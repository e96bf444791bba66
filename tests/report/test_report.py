"""A report from runs whose every episode is known: its numbers, its words, its files."""

from __future__ import annotations

import csv
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from made import EPISODES, make

from saferl.evaluation.statistics import wilson
from saferl.report import drivers
from saferl.report.build import Report, build
from saferl.report.claims import CONFIRMED, NO_DATA, OPEN, REFUTED
from saferl.report.command import main
from saferl.report.curves import band
from saferl.report.files import write
from saferl.report.numbers import publish
from saferl.report.runs import FIGURES, FINISHED, find
from saferl.report.systems import CONDITIONS
from saferl.report.tables import printed
from saferl.report.text import latex, markdown, sentence, table_grid

#: Which episodes crash, by system and seed; routes take turns: lt, gs_inner, gs_outer, rt.
CRASHES = {
    "arsac": [[], [], [0]],
    "asac": [[0, 1, 2, 4], [0, 1, 2, 5], [0, 1, 2, 6]],
    "sac": [[0, 1, 2, 3, 4], [0, 1, 2, 3, 5, 6], [0, 1, 2, 3]],
    "sac_rs": [[0, 1]],
}


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> tuple[Report, Path]:
    folder = tmp_path_factory.mktemp("runs")
    for algo, seeds in CRASHES.items():
        for seed, collisions in enumerate(seeds):
            # The drivers' tests are played on an empty road, in which none of them crashes.
            speed = 8.0 + seed if algo == "arsac" else 12.0
            make(folder / f"{algo}{seed}", algo, seed, collisions, speed, ["task.vehicles=0"])
    make(folder / "foreign", "asac", 9, options=["task.vehicles=0", "frames=10"])
    (folder / "broken").mkdir()
    (folder / "broken/metrics.csv").write_text("frames\n")
    out = folder / "out"  # among the runs, where it is none
    return build([folder], out), out


def rows(report: Report, table: int, condition: str):
    return {row.name: row for row in report.tables[table].rows if row.condition == condition}


def test_the_table_by_hand(report):
    own = rows(report[0], 0, "lt")["arsac"]
    cell = own.cells["collision_rate"]
    rates = [0.0, 0.0, 0.5]  # two left turns in each test
    assert cell.mean == pytest.approx(1 / 6)
    assert cell.std == pytest.approx(np.std(rates, ddof=1))
    assert 0.0 == cell.low <= wilson(1, 6)[0] and wilson(1, 6)[1] <= cell.high <= 1.0
    assert own.cells["speed"].mean == pytest.approx(9.0) and own.seeds == 3
    assert own.cells["return"].mean == pytest.approx(100 - 200 / 6)

    mean = rows(report[0], 0, "mean")["arsac"].cells["collision_rate"]
    assert mean.mean == pytest.approx((1 / 6 + 0 + 0) / 3)  # each task weighs the same
    assert [system.name for system in report[0].systems if system.shaped] == ["sac_rs"]
    single = rows(report[0], 0, "mean")["sac_rs"].cells["collision_rate"]
    assert single.mean == pytest.approx((1 / 2 + 1 / 4) / 3) and single.std is None


def test_rows_stand_in_order_and_the_best_is_that_of_what_was_trained(report):
    comparison, ablation = report[0].tables
    names = [row.name for row in comparison.rows if row.condition == "gs"]
    assert names == ["scripted", "blind", "cpo", "ppo_rs", "sac_rs", "sac_lag", "arsac"]
    names = [row.name for row in ablation.rows if row.condition == "gs"]
    assert names == ["scripted", "blind", "sac", "rsac", "asac", "arsac_unprojected", "arsac"]
    assert [row.condition for row in ablation.rows[:: len(names)]] == list(CONDITIONS)
    best = {row.name: row.best for row in ablation.rows if row.condition == "mean"}
    assert best["arsac"] == {"collision_rate", "success_rate", "frozen_rate", "return"}
    assert best["sac"] == best["asac"] == {"frozen_rate"}  # all have none
    assert not best["scripted"] and not best["rsac"]


def test_drivers_play_the_tests_of_the_runs_once(report, monkeypatch):
    done, out = report
    folders = sorted(path.name for path in (out / "drivers").iterdir())
    assert folders == [f"{name}-seed{seed}" for name in ("blind", "scripted") for seed in range(3)]
    scripted = done.systems[0]
    assert scripted.name == "scripted" and not scripted.trained
    assert sum(map(len, scripted.tests[0])) == 3 * EPISODES
    cell = scripted.cell("mean", "success_rate")
    assert cell.mean == 1.0 and cell.std is None
    assert cell.low == pytest.approx(wilson(3 * EPISODES, 3 * EPISODES)[0])  # of its episodes

    def played_again(*_):
        raise AssertionError("played again")

    monkeypatch.setattr(drivers, "evaluate", played_again)
    again = drivers.drive(done.runs, out / "drivers")
    assert np.array_equal(again[0].tests[0][1], scripted.tests[0][1])
    (out / "drivers/blind-seed1/metrics.json").write_text("{")  # cut off
    with pytest.raises(AssertionError, match="played again"):
        drivers.drive(done.runs, out / "drivers")


def test_runs_that_do_not_count_are_told_and_do_not(report):
    done, _ = report
    told = {run.folder.name: run for run in done.runs if run.state != FINISHED}
    assert told.keys() == {"foreign", "broken"}
    assert told["foreign"].reason == "frames=10 (the others have 30000)"
    asac = next(system for system in done.systems if system.name == "asac")
    assert list(asac.seeds) == [0, 1, 2]


def test_claims_are_answered_by_their_intervals(report):
    claims = {(claim.system, claim.other, claim.figure): claim for claim in report[0].claims}
    attention = claims["arsac", "asac", "collision_rate"]
    assert attention.verdict == CONFIRMED and (attention.seeds, attention.other_seeds) == (3, 3)
    mine, theirs = (
        rows(report[0], 1, "mean")[name].cells["collision_rate"] for name in ("arsac", "asac")
    )
    assert attention.difference == pytest.approx(mine.mean - theirs.mean)
    assert attention.high < 0
    assert claims["arsac", "sac", "speed"].verdict == REFUTED
    assert claims["arsac", "cpo", "speed"].verdict == NO_DATA
    assert claims["arsac", "arsac_unprojected", "collision_rate"].verdict == NO_DATA
    single = claims["arsac", "sac_rs", "collision_rate"]
    assert single.verdict == OPEN and single.low is None and single.difference < 0
    assert "no interval (3 and 1 seeds)" in sentence(single)
    assert len({claim.claim for claim in report[0].claims}) == len(report[0].claims) == 17


def test_what_each_system_took(report):
    by_name = {each.name: each for each in report[0].efforts}
    assert list(by_name) == ["sac_rs", "sac", "asac", "arsac"]
    sac = by_name["sac"]
    assert (sac.frames, sac.updates, sac.minutes) == (30000, 900, 3.0)
    value, low, high = sac.improvement["success_rate"]
    assert value == 0.0 and low == 0.0 and high == pytest.approx(wilson(0, 3)[1])
    assert by_name["arsac"].improvement == {}
    assert by_name["arsac"].interquartile["collision_rate"] == pytest.approx(1 / 36)


def test_the_paper_is_transcribed_without_a_contradiction():
    """Rates of a row sum to 100, MEAN is that of the tasks, and the system in both tables has one row, but for rounding and
    where the paper contradicts itself."""
    values = printed()
    assert len(values) == 36
    number = {
        key: {figure: float(text.split("±")[0]) for figure, text in row.items()}
        for key, row in values.items()
    }
    wrong = set()
    for (table, task, algo), row in number.items():
        rates = [row[f"{name}_rate"] for name in ("collision", "success", "frozen")]
        assert sum(rates) == pytest.approx(100, abs=0.11)
        if algo == "arsac":
            assert values["comparison", task, algo] == values["ablation", task, algo]
        if task == "mean":
            for figure, digits in zip(FIGURES, (0.06, 0.06, 0.06, 0.021, 0.011), strict=True):
                tasks = [number[table, each, algo][figure] for each in ("lt", "gs", "rt")]
                if row[figure] != pytest.approx(np.mean(tasks), abs=digits):
                    wrong.add((algo, figure))
    assert wrong == {("arsac", "speed"), ("sac", "collision_rate"), ("sac", "success_rate")}


def test_a_band_by_hand():
    """Of 0, 1, 2: 1 +- t(0.975, 2) / sqrt(3); between records a line; only frames that all have."""
    runs = [
        {"frames": np.array([0.0, 10.0, 20.0]), "speed": np.array([np.nan, y, y])}
        for y in (0.0, 1.0)
    ]
    runs.append({"frames": np.array([5.0, 15.0, 25.0, 35.0]), "speed": np.array([2.0, 2, 2, 2])})
    curve = band(runs, "speed")
    half = 4.302652729911275 / math.sqrt(3)
    assert curve.frames.tolist() == [10.0, 20.0] and curve.seeds == 3
    assert curve.mean.tolist() == [1.0, 1.0]
    assert curve.high == pytest.approx([1 + half] * 2) and curve.low == pytest.approx(
        [1 - half] * 2
    )
    for few in (1, 2):
        assert np.isnan(band(runs[:few], "speed").low).all()


def test_the_files(report):
    done, out = report
    text = write(done, out).read_text()
    order = ["Comparison on", "Ablation on", "What each", "claims", "curves.png", "## Runs"]
    places = [text.index(part) for part in order]
    assert places == sorted(places)
    for name in ("comparison", "ablation", "systems"):
        assert all((out / f"{name}.{kind}").is_file() for kind in ("md", "tex", "csv"))
    assert (out / "curves.png").stat().st_size > 10_000
    assert (out / "curves.pdf").read_bytes().startswith(b"%PDF")
    assert "frames=10 (the others have 30000)" in text and "| broken |" in text
    with (out / "comparison.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 4 * 7 * 5
    own = [x for x in lines if (x["task"], x["system"], x["figure"]) == ("lt", "arsac", "speed")]
    assert float(own[0]["mean"]) == pytest.approx(9.0) and own[0]["paper"] == "8.51±0.76"
    missing = [x for x in lines if x["system"] == "cpo"]
    assert all(
        x["mean"] == "" and x["paper"] for x in missing
    )  # the paper's number is in its own column


def test_each_row_of_a_table_has_each_column(report):
    grid = table_grid(report[0].tables[0])
    assert {len(row) for row in grid} == {13}
    lines = markdown(grid).splitlines()
    assert {line.count("|") for line in lines} == {14}
    body = [line for line in latex(grid, "A & B.", "t").splitlines() if line.endswith(r"\\")]
    assert len(body) == len(grid) and {line.count(" & ") for line in body} == {12}
    assert latex(grid, "A & B.", "t").count(r"\midrule") == 1 + 3


def test_the_command(report, capsys, monkeypatch, tmp_path: Path):
    """The same report again, and mistakes in one line, which leave nothing behind."""
    monkeypatch.chdir(tmp_path)
    out = report[1]
    folder = str(out.parent)
    monkeypatch.setattr(sys, "argv", ["report"])
    main([folder, "--out", str(out), "--against", "sac"])
    told = capsys.readouterr().out
    assert told.startswith("Runs: 10 finished, 1 broken, 1 foreign.\nClaims: ")
    assert told.rstrip().endswith("report.html")
    assert "P(CR below SAC's)" in (out / "report.md").read_text()
    for arguments, line in (
        ([folder, "--against", "scripted"], "--against must be among cpo, "),
        ([f"{folder}/nowhere"], "no such folder"),
        ([str(out)], "no run and no trace below"),
        ([folder, "--out", str(out / "report.md")], ".*File exists"),
    ):
        with pytest.raises(SystemExit, match=f"^error: {line}"):
            main(arguments)
    assert not [*tmp_path.iterdir()]


def test_runs_that_have_only_begun_make_a_report_too(tmp_path: Path):
    run = make(tmp_path / "run")
    (run / "evaluation/metrics.json").unlink()
    done = build([tmp_path], tmp_path / "out")
    text = write(done, tmp_path / "out").read_text()
    assert "1 interrupted" in text and {claim.verdict for claim in done.claims} == {NO_DATA}
    assert not done.systems and not done.curves


def test_published_numbers_make_the_same_report(report, tmp_path: Path):
    """Without the runs; what lies there already is kept, and runs may stand beside it."""
    made = publish(report[0].runs, tmp_path / "numbers")
    assert len(made) == sum(map(len, CRASHES.values()))
    assert not any("foreign" in path.name for path in made)
    again = build([tmp_path / "numbers"], report[1])
    assert again.tables == report[0].tables and again.efforts == report[0].efforts
    assert [str(claim) for claim in again.claims] == [str(claim) for claim in report[0].claims]
    assert {run.state for run in again.runs} == {FINISHED}
    mine = make(tmp_path / "mine", "asac", 3, [0], 12.0, ["task.vehicles=0"])
    more = find([tmp_path / "numbers", mine])
    assert publish(more, tmp_path / "numbers") == [tmp_path / "numbers/asac/seed3"]
    assert "runs" not in (tmp_path / "numbers/sac/seed0/config.yaml").read_text()
