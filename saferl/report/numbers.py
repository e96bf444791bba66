"""The numbers behind a report: of each finished run what a report reads, small enough to publish."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf

from saferl.checkpoint.run import CONFIG, begun, run_config
from saferl.config.flat import MADE
from saferl.evaluation.compare import TESTED
from saferl.evaluation.rows import read
from saferl.report.curves import panels
from saferl.report.runs import CURVE, FIGURES, FINISHED, TIMING, Run
from saferl.report.text import write_csv


def publish(runs: Sequence[Run], out: Path) -> list[Path]:
    """Write ``ALGO/seedN`` of each finished run: a folder that a report reads like the run itself, without what it has learned.

    Args:
        runs: what :func:`saferl.report.runs.find` returned.
        out: folder; what it holds of other runs stays.

    Returns:
        The folders written, those of runs that lie there already left out.

    Raises:
        OSError: a file cannot be written.
        ValueError: a folder holds another run, or published numbers of other settings.
    """
    made = []
    for run in runs:
        if run.state != FINISHED:
            continue
        folder = out / run.algo / f"seed{run.seed}"
        if folder.resolve() == run.folder.resolve():
            continue
        made_by_whom = dict.fromkeys(MADE)  # where it lay tells nothing
        config = OmegaConf.to_yaml(OmegaConf.merge(run_config(run.folder), made_by_whom))
        held = folder / CONFIG
        if begun(folder) or (held.exists() and held.read_text(encoding="utf-8") != config):
            raise ValueError(
                f"--numbers: {folder} holds another run; take another folder, or remove it."
            )
        (folder / TESTED).parent.mkdir(parents=True, exist_ok=True)
        held.write_text(config, encoding="utf-8")
        told = json.loads((run.folder / TESTED).read_text(encoding="utf-8"))
        (folder / TESTED).write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")
        columns = ("route", *(figure.removesuffix("_rate") for figure in FIGURES))
        test = read((run.folder / TESTED).with_name("episodes.csv"))
        _write({name: test[name] for name in columns}, (folder / TESTED).with_name("episodes.csv"))
        counted = ("frames", "episodes", "updates", *panels(run.curve))
        curve = {name: run.curve[name] for name in counted if name in run.curve}
        _write(curve, folder / CURVE)
        _write({name: column[-1:] for name, column in run.timing.items()}, folder / TIMING)
        made.append(folder)
    return made


def _write(columns: Mapping[str, np.ndarray], path: Path) -> None:
    rows = zip(*(map(_short, column.tolist()) for column in columns.values()), strict=True)
    write_csv([dict(zip(columns, row, strict=True)) for row in rows], path)


def _short(value: float | str) -> str:
    """As few digits as the figures of a report need."""
    if isinstance(value, str):
        return value
    return "" if np.isnan(value) else f"{value:.7g}"
