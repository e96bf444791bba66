"""Learning curves: means and bands over seeds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from saferl.report.runs import FINISHED, Run

#: Columns of ``metrics.csv``: the paper's four panels, and ours.
PANELS = (
    "collision_rate",
    "frozen_rate",
    "success_rate",
    "return",
    "cost_return",
    "lagrange_multiplier",
    "intervention_rate",
)
#: Those of which several costs have one each, by its name (:mod:`saferl.evaluation.costs`).
OF_COSTS = ("cost_return", "lagrange_multiplier")


def panels(columns: Iterable[str]) -> list[str]:
    """The panels that these columns of ``metrics.csv`` make, in order.

    >>> panels(["frames", "cost_return_speed", "return", "lagrange_multiplier_speed"])
    ['return', 'cost_return_speed', 'lagrange_multiplier_speed']
    """
    there = list(dict.fromkeys(columns))
    return [
        name
        for panel in PANELS
        for name in there
        if name == panel or (panel in OF_COSTS and name.startswith(f"{panel}_"))
    ]


@dataclass(frozen=True)
class Curve:
    """One figure of one system in training.

    Attributes:
        frames: [N].
        mean, low, high: [N], over seeds; the 95% band is Student's t, NaN of fewer than three: of two it is as wide as the panel.
        seeds: how many.
    """

    frames: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    seeds: int


def curves(runs: Sequence[Run]) -> dict[str, dict[str, Curve]]:
    """By figure and system, of the finished runs that have recorded it; figures that none has are left out."""
    found: dict[str, dict[str, Curve]] = {}
    for figure in panels(name for run in runs for name in run.curve):
        groups: dict[str, list[Mapping[str, np.ndarray]]] = {}
        for run in runs:
            if run.state == FINISHED and np.isfinite(run.curve.get(figure, np.nan)).any():
                groups.setdefault(run.algo, []).append(run.curve)
        if groups:
            found[figure] = {name: band(group, figure) for name, group in groups.items()}
    return found


def band(runs: Sequence[Mapping[str, np.ndarray]], figure: str) -> Curve:
    """Mean and band over runs, at the frames of the one with the fewest records where all have some.

    >>> runs = [{"frames": np.array([10.0, 20.0]), "return": np.array([y, y + 2.0])} for y in (0.0, 1.0, 2.0)]
    >>> curve = band(runs, "return")
    >>> curve.mean.tolist(), curve.high.round(2).tolist()
    ([1.0, 3.0], [3.48, 5.48])
    """
    recorded = [np.isfinite(run[figure]) for run in runs]
    known = [(run["frames"][r], run[figure][r]) for run, r in zip(runs, recorded, strict=True)]
    grid = min((frames for frames, _ in known), key=len)
    first, last = max(f[0] for f, _ in known), min(f[-1] for f, _ in known)
    grid = grid[(grid >= first) & (grid <= last)]
    values = np.stack([np.interp(grid, frames, column) for frames, column in known])
    mean, half = values.mean(0), np.full(len(grid), np.nan)
    if len(values) > 2:
        half = stats.t.ppf(0.975, len(values) - 1) * stats.sem(values)
    low, high = mean - half, mean + half
    if figure.endswith("_rate"):
        low, high = low.clip(0, 1), high.clip(0, 1)
    return Curve(grid, mean, low, high, len(values))
