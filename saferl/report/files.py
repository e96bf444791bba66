"""A report as files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from saferl.report.build import Report
from saferl.report.figure import draw
from saferl.report.resampling import RESAMPLES
from saferl.report.text import (
    Grid,
    effort_grid,
    effort_rows,
    latex,
    markdown,
    run_grid,
    sentence,
    states,
    table_grid,
    table_rows,
    verdicts,
    write_csv,
)


def write(report: Report, out: Path) -> Path:
    """Write ``report.md``, its tables as Markdown, LaTeX and CSV, and ``curves.png`` and ``curves.pdf``; returns ``report.md``.

    Args:
        report: what :func:`build` returned.
        out: folder, which is there.
    """
    parts = ["# Report", f"Runs: {states(report.runs)}.", READING]
    for table in report.tables:
        parts.append(f"## {table.title}")
        parts.append(_save(table.name, table.title, table_grid(table), table_rows(table), out))
    if report.efforts:
        title, grid = "What each system took", effort_grid(report.efforts, report.against)
        parts += [f"## {title}", EFFORT]
        parts.append(_save("systems", title, grid, effort_rows(report.efforts), out))
    parts += ["## The paper's claims", f"{CLAIMS} {verdicts(report.claims)}."]
    parts.append("\n".join(f"- {sentence(claim)}" for claim in report.claims))
    if report.curves:
        shaped = [system.label for system in report.systems if system.shaped]
        draw(report.curves, shaped, out)
        parts += ["## Learning curves", "![Learning curves](curves.png)", CURVES]
    parts += ["## Runs", markdown(run_grid(report.runs))]
    path = out / "report.md"
    path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    return path


def _save(name: str, title: str, grid: Grid, rows: Sequence[dict], out: Path) -> str:
    """Write a table in its three forms; returns the Markdown."""
    text = markdown(grid)
    (out / f"{name}.md").write_text(f"{text}\n", encoding="utf-8")
    (out / f"{name}.tex").write_text(latex(grid, f"{title}.", f"t_{name}"), encoding="utf-8")
    write_csv(rows, out / f"{name}.csv")
    return text


READING = f"""\
A cell is the mean ± standard deviation over seeds, and a 95% interval [low, high] from {RESAMPLES:,} resamples of seeds, then of
episodes in each task (of a driver, which learns nothing, of episodes alone). Bold is the best mean of the trained systems;
of speed none is best. MEAN gives each task the same weight. CR, SR, FR: collision, success and frozen rate; AER: mean return of an
episode; AEV: mean speed. The column "paper" is what the paper prints, on a simulator and with rewards of its own."""
EFFORT = """\
Means over seeds; minutes of training on the machine that it ran on. "Middle half" is the interquartile mean over seeds, P the
probability that a seed is better than one of the other system, a tie being half of it, with its 95% interval; both in MEAN."""
CLAIMS = """\
Differences of means in MEAN, with a 95% interval over seeds and episodes: confirmed or refuted where it leaves out 0.
"Not slower" is confirmed where ARSAC is faster. Each interval stands for itself."""
CURVES = """\
Means and 95% bands (Student's t) over three seeds or more of finished runs, of actions with exploration; not comparable with the tests above."""
