"""A report in words: Markdown, LaTeX and CSV."""

from __future__ import annotations

import csv
import dataclasses
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from saferl.evaluation.statistics import span
from saferl.report.claims import VERDICTS, Claim
from saferl.report.runs import FIGURES, STATES, Run
from saferl.report.systems import LABELS, Cell
from saferl.report.tables import COMPARED, Effort, Row, Table

#: Heading, scale and digits of each figure.
COLUMNS = {
    "collision_rate": ("CR (%)", 100.0, 1),
    "success_rate": ("SR (%)", 100.0, 1),
    "frozen_rate": ("FR (%)", 100.0, 1),
    "return": ("AER", 1.0, 1),
    "speed": ("AEV (m/s)", 1.0, 2),
}
_NONE = "-"


def number(value: float | None, digits: int = 1, scale: float = 1.0) -> str:
    """A number, "-" for none.

    >>> number(0.025, 1, 100), number(-0.01), number(None), number(1234567.0, 0)
    ('2.5', '0.0', '-', '1,234,567')
    """
    return _NONE if value is None or value != value else f"{value * scale:{_form(digits)}}"


def _form(digits: int) -> str:
    return f"z,.{digits}f"  # without the sign of a zero


def cell(value: Cell | None, figure: str) -> str:
    """A figure over seeds.

    >>> cell(Cell(0.02, 0.005, 0.013, 0.031), "collision_rate")
    '2.0 ± 0.5 [1.3, 3.1]'
    """
    if value is None:
        return _NONE
    _, scale, digits = COLUMNS[figure]
    std = "" if value.std is None else f" ± {number(value.std, digits, scale)}"
    interval = span(value.low, value.high, _form(digits), scale)
    return f"{number(value.mean, digits, scale)}{std} {interval}"


Grid = list[list[str]]


def table_grid(table: Table) -> Grid:
    """A table of the paper: its heading and its rows, text by text, what is best between asterisks."""
    heads = [text for figure in FIGURES for text in (COLUMNS[figure][0], "paper")]
    return [["task", "system", "seeds", *heads], *map(_row, table.rows)]


def _row(row: Row) -> list[str]:
    texts = [row.condition.upper(), row.label, str(row.seeds)]
    for figure in FIGURES:
        text = cell(row.cells[figure], figure)
        texts.append(f"**{text}**" if figure in row.best else text)
        texts.append(row.paper[figure] or _NONE)
    return texts


def effort_grid(efforts: Sequence[Effort], against: str) -> Grid:
    """What each system took and how it stands to another."""
    other = LABELS.get(against, against)
    heads = ["system", "seeds", "frames", "updates", "minutes"]
    heads += [f"{COLUMNS[figure][0]}, middle half" for figure in COMPARED]
    heads += [f"P(CR below {other}'s)", f"P(SR above {other}'s)"]
    rows = [heads]
    for each in efforts:
        texts = [each.label, str(each.seeds), number(each.frames, 0), number(each.updates, 0)]
        texts.append(number(each.minutes))
        texts += [number(each.interquartile[f], 1, 100.0) for f in COMPARED]
        for figure in COMPARED:
            value = each.improvement.get(figure)
            texts.append(f"{number(value[0], 2)} {span(*value[1:], _form(2))}" if value else _NONE)
        rows.append(texts)
    return rows


def markdown(grid: Grid) -> str:
    """A pipe table.

    >>> print(markdown([["a", "b"], ["1", "x|y"]]))
    | a | b |
    |---|---|
    | 1 | x\\|y |
    """
    lines = ["| " + " | ".join(text.replace("|", "\\|") for text in row) + " |" for row in grid]
    return "\n".join([lines[0], "|" + "---|" * len(grid[0]), *lines[1:]])


_ESCAPED = {"±": r"$\pm$", "%": r"\%", "_": r"\_", "&": r"\&", "#": r"\#"}


def latex(grid: Grid, caption: str, label: str) -> str:
    r"""A table* for booktabs and graphicx; where the first column changes, a rule.

    >>> latex([["task", "CR (%)"], ["LT", "**1 ± 2**"]], "A", "t").splitlines()[9:11]
    ['\\midrule', 'LT & \\textbf{1 $\\pm$ 2} \\\\']
    """
    heads, *rows = [[_escaped(text) for text in row] for row in grid]
    body = []
    for index, row in enumerate(rows):
        first = index == 0 or row[0] != rows[index - 1][0]
        if index and first and len({each[0] for each in rows}) < len(rows):
            body.append(r"\midrule")
        body.append(" & ".join([row[0] if first else "", *row[1:]]) + r" \\")
    lines = [
        r"% needs \usepackage{booktabs,graphicx}",
        r"\begin{table*}",
        r"\centering",
        rf"\caption{{{_escaped(caption)}}}",
        rf"\label{{{label}}}",
        r"\resizebox{\textwidth}{!}{%",
        rf"\begin{{tabular}}{{{'l' * len(heads)}}}",
        r"\toprule",
        " & ".join(heads) + r" \\",
        r"\midrule",
        *body,
        r"\bottomrule",
        r"\end{tabular}}",
        r"\end{table*}",
    ]
    return "\n".join(lines) + "\n"


def _escaped(text: str) -> str:
    text = "".join(_ESCAPED.get(letter, letter) for letter in text)
    return re.sub(r"\*\*(.+?)\*\*", r"\\textbf{\1}", text)


def write_csv(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Rows of numbers as they are; what is None is empty."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def table_rows(table: Table) -> list[dict[str, Any]]:
    """A line for each figure of each row; rates are shares of 1, the paper's text is the paper's."""
    nothing = {"mean": None, "std": None, "low": None, "high": None}
    return [
        {"task": row.condition, "system": row.name, "seeds": row.seeds, "figure": figure}
        | (dataclasses.asdict(own) if (own := row.cells[figure]) else nothing)
        | {"best": int(figure in row.best), "paper": row.paper[figure]}
        for row in table.rows
        for figure in FIGURES
    ]


def effort_rows(efforts: Sequence[Effort]) -> list[dict[str, Any]]:
    """A line for each system."""
    return [
        {key: getattr(each, key) for key in ("name", "seeds", "frames", "updates", "minutes")}
        | {f"{figure}_middle_half": value for figure, value in each.interquartile.items()}
        | {
            f"{figure}_improvement{end}": value[index] if value else None
            for figure in each.interquartile
            for value in [each.improvement.get(figure)]
            for index, end in enumerate(("", "_low", "_high"))
        }
        for each in efforts
    ]


def sentence(claim: Claim) -> str:
    """A claim and its answer.

    >>> about = ("ARSAC has fewer collisions than SAC", "arsac", "sac", "collision_rate", -1)
    >>> sentence(Claim(*about, 5, 4, -0.05, -0.07, -0.03))
    'ARSAC has fewer collisions than SAC: **confirmed**. CR differs by -5.0 points [-7.0, -3.0] (5 and 4 seeds).'
    >>> sentence(Claim(*about, 5, 0))
    'ARSAC has fewer collisions than SAC: **no data** (no run of SAC counts).'
    """
    labels = [LABELS[name] for name in (claim.system, claim.other)]
    seeds = (claim.seeds, claim.other_seeds)
    told = f"{claim.claim}: **{claim.verdict}**"
    if claim.difference is None:
        missing = [label for label, count in zip(labels, seeds, strict=True) if not count]
        return f"{told} (no run of {' nor of '.join(missing)} counts)."
    heading, scale, digits = COLUMNS[claim.figure]
    name, unit = heading.split(" ")[0], "points" if scale == 100 else "m/s"
    apart = f"{name} differs by {number(claim.difference, digits, scale)} {unit}"
    if claim.low is None:
        return (
            f"{told}. {apart}; of one seed there is no interval ({seeds[0]} and {seeds[1]} seeds)."
        )
    interval = span(claim.low, claim.high, _form(digits), scale)
    return f"{told}. {apart} {interval} ({seeds[0]} and {seeds[1]} seeds)."


def verdicts(claims: Sequence[Claim]) -> str:
    """How many claims there are of each verdict."""
    counts = Counter(claim.verdict for claim in claims)
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in VERDICTS if counts[verdict])


def states(runs: Sequence[Run]) -> str:
    """How many runs there are of each state."""
    counts = Counter(run.state for run in runs)
    return ", ".join(f"{counts[state]} {state}" for state in STATES if counts[state])


def run_grid(runs: Sequence[Run]) -> Grid:
    """Every run with its state and why it has it, those that do not count first."""
    rows = []
    for run in sorted(runs, key=lambda run: run.state == STATES[0]):
        name, seed = LABELS.get(run.algo, run.algo), str(run.settings.get("seed", _NONE))
        rows.append([run.state, name or _NONE, seed, str(run.folder), run.reason or _NONE])
    return [["state", "system", "seed", "folder", "reason"], *rows]
