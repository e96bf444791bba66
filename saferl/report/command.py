"""The command line of a report."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path


def main(arguments: list[str] | None = None) -> None:
    """Write the report of all runs below these folders."""
    parser = argparse.ArgumentParser(
        "python -m saferl.report",
        description="The paper's tables, claims and learning curves from all runs below some folders, as report.md, "
        "with tables in Markdown, LaTeX and CSV, and as report.html, which also plays traces (python -m saferl.evaluate trace=all). Unfinished, damaged and foreign runs are listed with their reason.",
    )
    parser.add_argument("folders", nargs="+", type=Path, metavar="RUNS", help="runs lie below it")
    parser.add_argument("--out", type=Path, default=Path("report"), help="folder (report)")
    parser.add_argument(
        "--against", default="arsac", help="the system that others are compared with (arsac)"
    )
    parser.add_argument(
        "--play", type=int, default=0, metavar="N",
        help="let each system play N episodes of one test again for report.html, crashes first (0)",
    )  # fmt: skip
    parser.add_argument(
        "--numbers", type=Path, metavar="FOLDER",
        help="keep there what a report reads of each finished run, to publish it, or to add runs to it later",
    )  # fmt: skip
    given = parser.parse_args(arguments)
    if given.play < 0:
        raise SystemExit(f"error: --play must be >= 0, got {given.play}.")
    logging.basicConfig(level=logging.INFO, format="%(message)s")  # says when a driver plays
    import torch  # late: help needs none of these

    from saferl.report.build import build
    from saferl.report.files import write
    from saferl.report.html import write_page
    from saferl.report.numbers import publish
    from saferl.report.text import states, verdicts
    from saferl.report.traces import lying, made

    torch.set_num_threads(1)  # of a few episodes at once; more threads wait for each other
    try:
        report = build(given.folders, given.out, given.against)
        traces = lying(given.folders, given.out / "traces")
        if not report.runs and not traces:
            names = ", ".join(map(str, given.folders))
            raise ValueError(f"no run and no trace below {names}: give folders of runs or tests.")
        if report.runs:
            print(f"Runs: {states(report.runs)}.\nClaims: {verdicts(report.claims)}.")
            print(write(report, given.out), flush=True)
        if given.numbers is not None:
            print(f"{given.numbers}: {len(publish(report.runs, given.numbers))} runs.")
        made_now = made(report.runs, given.play, given.out / "traces", given.out / "drivers")
        print(write_page(report, [*made_now, *traces], given.out / "report.html"))
    except (ValueError, OSError) as error:
        raise SystemExit(f"error: {error}") from None
