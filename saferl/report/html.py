"""A report as one HTML file: tables, curves and replays."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from plotly.offline import get_plotlyjs

from saferl.evaluation.trace import Trace
from saferl.report.build import Report
from saferl.report.files import CLAIMS, CURVES, EFFORT, READING
from saferl.report.player import page
from saferl.report.systems import LABELS
from saferl.report.text import (
    Grid,
    effort_grid,
    run_grid,
    sentence,
    states,
    table_grid,
    verdicts,
)

_BOLD = "**"


def write_page(report: Report, traces: Sequence[Trace], path: Path) -> Path:
    """Write the page; returns its path.

    Args:
        report: what :func:`saferl.report.build.build` returned.
        traces: what it plays.
        path: of the file.
    """
    curves = _curves(report)
    body = _body(report, bool(curves)) if report.runs else ""
    scripts = [get_plotlyjs()] if curves else []
    html = page("saferl report", body, traces, scripts=scripts, curves=curves)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(html, encoding="utf-8")
    return path


def _body(report: Report, curves: bool) -> str:
    parts = [f"<p>Runs: {escape(states(report.runs))}.</p>", _text(READING)]
    for table in report.tables:
        parts += [f"<h2>{escape(table.title)}</h2>", _table(table_grid(table))]
    if report.efforts:
        parts += ["<h2>What each system took</h2>", _text(EFFORT)]
        parts.append(_table(effort_grid(report.efforts, report.against)))
    parts += ["<h2>The paper's claims</h2>", _text(f"{CLAIMS} {verdicts(report.claims)}."), "<ul>"]
    parts += [f"<li>{_bold(sentence(claim))}</li>" for claim in report.claims] + ["</ul>"]
    if curves:
        parts += ["<h2>Learning curves</h2>", _text(CURVES), '<div id="curves"></div>']
    return "\n".join([*parts, "<h2>Runs</h2>", _table(run_grid(report.runs), words=5)])


def _text(text: str) -> str:
    return f'<p class="small">{_bold(text)}</p>'


def _bold(text: str) -> str:
    pieces = escape(text).split(_BOLD)
    return "".join(f"<b>{each}</b>" if odd % 2 else each for odd, each in enumerate(pieces))


def _table(grid: Grid, words: int = 2) -> str:
    """A table of which the first columns are words."""

    def row(texts: Sequence[str], tag: str) -> str:
        cells = (
            f"<{tag}{' class=word' if place < words else ''}>{_bold(text)}</{tag}>"
            for place, text in enumerate(texts)
        )
        return f"<tr>{''.join(cells)}</tr>"

    heads, *rows = grid
    body = "".join(row(texts, "td") for texts in rows)
    return f'<div class="wide"><table><thead>{row(heads, "th")}</thead><tbody>{body}</tbody></table></div>'


def _curves(report: Report) -> list[dict[str, Any]]:
    """For plotly: a panel for each figure, a line with its band for each system."""

    def numbers(values: np.ndarray) -> list[float | None]:
        return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values]

    return [
        {
            "figure": figure,
            "systems": [
                {
                    "name": LABELS.get(name, name),
                    "seeds": curve.seeds,
                    **{
                        key: numbers(getattr(curve, key))
                        for key in ("frames", "mean", "low", "high")
                    },
                }
                for name, curve in found.items()
            ],
        }
        for figure, found in report.curves.items()
    ]
