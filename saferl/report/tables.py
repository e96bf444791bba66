"""The paper's two tables, and one of what each system took."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from saferl.report.runs import FIGURES
from saferl.report.systems import CONDITIONS, LABELS, Cell, System

TITLES = {
    "comparison": "Comparison on three driving tasks",
    "ablation": "Ablation on three driving tasks",
}
#: What is better: less or more of a figure. Speed has no better: who drives through others is fast.
BETTER = {"collision_rate": min, "success_rate": max, "frozen_rate": min, "return": max}
#: By which seeds of two systems are compared.
COMPARED = ("collision_rate", "success_rate")
#: Not in the paper's table, but of the same question.
_ABLATED = ("arsac_unprojected",)


@dataclass(frozen=True)
class Row:
    """One system in one task.

    Attributes:
        condition: of :data:`CONDITIONS`.
        name, label: of the system.
        seeds: how many; of a driver, of how many tests; 0 if there is no run of it.
        cells: by figure; None without data.
        best: the figures in which no trained system has a better mean.
        paper: the printed value by figure, "" where the paper has none.
    """

    condition: str
    name: str
    label: str
    seeds: int
    cells: Mapping[str, Cell | None]
    best: frozenset[str]
    paper: Mapping[str, str]


@dataclass(frozen=True)
class Table:
    """A table of the paper: rows task by task, the drivers first in each."""

    name: str
    title: str
    rows: Sequence[Row]


@cache
def printed() -> Mapping[tuple[str, str, str], Mapping[str, str]]:
    """The paper's values, figures as printed by table, task and system.

    >>> printed()["comparison", "mean", "arsac"]["collision_rate"]
    '1.6±0.9'
    """
    with Path(__file__).with_name("paper.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    return {
        (row["table"], row["task"], row["algo"]): {figure: row[figure] for figure in FIGURES}
        for row in rows
    }


def tables(systems: Sequence[System]) -> list[Table]:
    """Both tables: the systems of the paper, with or without runs, and of ours those that there are; a system that is in
    no table of the paper stands in the comparison."""
    return [_table(name, title, systems) for name, title in TITLES.items()]


def _table(table: str, title: str, systems: Sequence[System]) -> Table:
    there = {system.name: system for system in systems}
    inside = {name: {key[2] for key in printed() if key[0] == name} for name in TITLES}
    inside["ablation"].update(_ABLATED)
    drivers = [system.name for system in systems if not system.trained]
    names = inside[table] | set(drivers)
    if table == "comparison":
        names |= there.keys() - inside["ablation"]
    order = [*LABELS, *there]
    rows = []
    for condition in CONDITIONS:
        cells = {
            name: {
                figure: there[name].cell(condition, figure) if name in there else None
                for figure in FIGURES
            }
            for name in sorted(names, key=order.index)
        }
        trained = [own for name, own in cells.items() if name not in drivers]
        best = {
            figure: better(means)
            for figure, better in BETTER.items()
            if len(means := [cell.mean for own in trained if (cell := own[figure])]) > 1
        }
        rows += [
            Row(
                condition,
                name,
                LABELS.get(name, name),
                len(there[name].seeds) if name in there else 0,
                own,
                frozenset(
                    figure
                    for figure, value in best.items()
                    if name not in drivers and (cell := own[figure]) and cell.mean == value
                ),
                printed().get((table, condition, name), dict.fromkeys(FIGURES, "")),
            )
            for name, own in cells.items()
        ]
    return Table(table, title, rows)


@dataclass(frozen=True)
class Effort:
    """What a system took, and how its seeds stand to another system's, in the mean of the tasks.

    Attributes:
        name, label, seeds, frames, updates, minutes: see :class:`System`.
        interquartile: mean of the middle half of seeds, by figure.
        improvement: probability that a seed of it is better than one of the other system, with its 95% interval, by figure;
            empty for that system itself, or if it has no run.
    """

    name: str
    label: str
    seeds: int
    frames: float | None
    updates: float | None
    minutes: float | None
    interquartile: Mapping[str, float]
    improvement: Mapping[str, tuple[float, float, float]]


def efforts(systems: Sequence[System], against: str) -> list[Effort]:
    """One row for each trained system; ``against`` is the one that they are compared with."""
    other = next((system for system in systems if system.name == against), None)
    return [
        Effort(
            system.name,
            system.label,
            len(system.seeds),
            system.frames,
            system.updates,
            system.minutes,
            {figure: system.interquartile_mean(figure) for figure in COMPARED},
            {
                figure: system.improvement(other, figure, BETTER[figure] is min)
                for figure in COMPARED
                if other is not None and other is not system
            },
        )
        for system in systems
        if system.trained
    ]
