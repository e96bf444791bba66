"""Figures of episodes: rates, means and their intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

#: Name of each figure in ``metrics.json``, its short name in tables, and whether it counts episodes.
FIGURES = {
    "collision_rate": ("CR", True),
    "success_rate": ("SR", True),
    "frozen_rate": ("FR", True),
    "return": ("return", False),
    "speed": ("speed m/s", False),
    "cost_return": ("cost return", False),
    "intervention_rate": ("intervention", False),
}


def wilson(successes: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Wilson's interval of a rate.

    >>> [round(bound, 3) for bound in wilson(190, 200)]
    [0.91, 0.973]
    """
    interval = stats.binomtest(int(successes), int(trials)).proportion_ci(level, method="wilson")
    return float(interval.low), float(interval.high)


def mean_interval(values: Sequence[float], level: float = 0.95) -> tuple[float, float]:
    """Student's t interval of a mean; the mean itself when there is one value.

    >>> [round(bound, 2) for bound in mean_interval([1.0, 2.0, 3.0])]
    [-0.48, 4.48]
    """
    array = np.asarray(values, dtype=float)
    if len(array) < 2 or np.ptp(array) == 0:
        return float(array.mean()), float(array.mean())
    half = stats.t.ppf((1 + level) / 2, len(array) - 1) * stats.sem(array)
    return float(array.mean() - half), float(array.mean() + half)


def summarise(rows: Sequence[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Mean and 95% interval of each figure over episodes.

    Args:
        rows: one dict an episode with ``return``, ``cost_return``, ``intervention_rate`` (share of its
            decisions) and, on the road, ``collision``, ``success``, ``frozen`` (0 or 1) and ``speed``.

    Returns:
        ``{figure: {"mean", "low", "high"}}``; Wilson's interval for rates of episodes, Student's t
        otherwise (within [0, 1] for the intervention rate, a mean of shares).

    Raises:
        ValueError: no rows.
    """
    if not rows:
        raise ValueError("summarise needs at least one episode, got none.")
    figures = {}
    for name, (_, is_rate) in FIGURES.items():
        column = name.removesuffix("_rate") if is_rate else name
        if column not in rows[0]:
            continue
        values = [float(row[column]) for row in rows]
        low, high = wilson(round(sum(values)), len(values)) if is_rate else mean_interval(values)
        if name.endswith("_rate"):
            low, high = max(low, 0.0), min(high, 1.0)
        figures[name] = {"mean": sum(values) / len(values), "low": low, "high": high}
    return figures


def table(figures: dict[str, dict[str, float]], title: str = "") -> str:
    """A plain-text table of :func:`summarise`'s figures; rates in percent."""
    lines = [title] if title else []
    lines.append(f"{'':<14}{'mean':>10}   95% interval")
    for name, value in figures.items():
        short, scale = FIGURES[name][0], 100.0 if name.endswith("_rate") else 1.0
        unit = " %" if scale == 100.0 else ""
        mean, low, high = (value[key] * scale for key in ("mean", "low", "high"))
        lines.append(f"{short:<14}{mean:>10.2f}{unit:<2} [{low:.2f}, {high:.2f}]{unit}")
    return "\n".join(lines)
