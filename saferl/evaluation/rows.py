"""One row of figures for each episode, and the files of a test."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from saferl.envs.task import Task
from saferl.evaluation.costs import columns
from saferl.evaluation.statistics import summarise

_FALLBACK = "fallback_"  # begins the columns of a shield's fallbacks


def episode_rows(
    steps: list[TensorDictBase], seeds: Tensor, task: Task, fallbacks: Sequence[str] = ()
) -> list[dict]:
    """Figures of each episode of :func:`saferl.evaluation.play.play`: one dict an episode, in the order of ``seeds``.

    Beside those of the task stand ``return``, ``cost_return`` (of several costs one for each,
    :func:`saferl.evaluation.costs.names`) and ``decisions``; where a projector was there, also
    ``intervention_rate``, the share of decisions that it changed, and ``correction``, the mean size of such a change; behind a
    shield with ``fallbacks`` of these names ``fallback_brake`` and so on, the share of decisions in which each drove.
    """
    after = steps[0]["next"]

    def over_time(key: str) -> Tensor:
        return torch.stack([step["next", key].double().squeeze(-1) for step in steps]).cpu()

    counts = torch.stack([step["alive"] for step in steps]).sum(0).tolist()
    values = {"return": over_time("reward")}
    values |= columns("cost_return", over_time("cost"), task.costs)
    if projected := "action_executed" in after:
        shift = torch.stack(
            [
                torch.linalg.vector_norm(step["next", "action_executed"] - step["action"], dim=-1)
                for step in steps
            ]
        ).cpu()
        # A projector of one's own need not say where it intervened.
        moved = over_time("intervened") if "intervened" in after else (shift > 0).to(shift)
        values |= {"intervention_rate": moved, "correction": shift}
    if fallbacks:
        who = over_time("fallback")
        values |= {f"{_FALLBACK}{name}": who == n for n, name in enumerate(fallbacks, 1)}
    rows, own = [], task.figures(steps, counts)
    for index, (seed, count) in enumerate(zip(seeds.tolist(), counts, strict=True)):
        # Exact sums: they do not depend on how long the episodes beside this one lasted.
        total = {key: math.fsum(value[:count, index].tolist()) for key, value in values.items()}
        if projected:
            interventions = total["intervention_rate"]
            total["intervention_rate"] = interventions / count
            total["correction"] /= max(interventions, 1.0)
        total |= {k: value / count for k, value in total.items() if k.startswith(_FALLBACK)}
        rows.append({"seed": seed, **own[index], **total, "decisions": count})
    return rows


def read(path: Path) -> dict[str, np.ndarray]:
    """The columns of a file of rows, ``episodes.csv`` or a run's curve: float [rows], NaN where a cell is empty; text where
    a column holds other than numbers.

    Raises:
        ValueError: the file is damaged: it has no rows, or one that is too short or too long.
    """
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = list(csv.reader(file)) or [[]]
    if not rows or any(len(row) != len(header) for row in rows):
        raise ValueError(
            f"{path} is damaged: each row must have {len(header)} cells, at least one."
        )
    columns = {}
    for name, cells in zip(header, zip(*rows, strict=True), strict=True):
        try:
            columns[name] = np.array([cell or "nan" for cell in cells], dtype=float)
        except ValueError:
            columns[name] = np.array(cells)
    return columns


def write(rows: list[dict], out: Path, /, **about: Any) -> dict:
    """Write ``episodes.csv`` and ``metrics.json`` into a folder; returns the metrics."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / "episodes.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    figures = summarise(rows)
    part = out / ".metrics.part"  # whole or not at all: it says that a test is over
    part.write_text(json.dumps({**figures, **about}, indent=2, allow_nan=False) + "\n")
    part.replace(out / "metrics.json")
    return figures
