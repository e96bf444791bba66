"""Figures of episodes: rates, means and their intervals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from scipy import stats

from saferl.evaluation.costs import limits

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

#: With which the names of each of several costs begin (:mod:`saferl.evaluation.costs`).
COST = "cost_return_"


def short(name: str) -> str:
    """What tables call a figure.

    >>> short("cost_return"), short("cost_return_speed")
    ('cost return', 'cost speed')
    """
    return FIGURES[name][0] if name in FIGURES else f"cost {name.removeprefix(COST)}"


def is_figure(name: str) -> bool:
    """Whether a figure has this name."""
    return name in FIGURES or name.startswith(COST)


def each_cost(figure: str, there: Iterable[str]) -> list[str]:
    """The names of a figure among those that are there: its own, and of costs those of each.

    >>> each_cost("cost_return", ["cost_return_road", "return", "cost_return_speed"]), each_cost("return", ["speed"])
    (['cost_return_road', 'cost_return_speed'], [])
    """
    return [
        name
        for name in there
        if name == figure or (figure == "cost_return" and name.startswith(COST))
    ]


#: Episodes of a training that its figures are the mean of.
WINDOW = 200


def wilson(successes: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Wilson's interval of a rate.

    >>> [round(bound, 3) for bound in wilson(190, 200)]
    [0.91, 0.973]
    """
    interval = stats.binomtest(int(successes), int(trials)).proportion_ci(level, method="wilson")
    return float(interval.low), float(interval.high)


Interval = tuple[float, float] | tuple[None, None]


def mean_interval(values: Sequence[float], level: float = 0.95) -> Interval:
    """Student's t interval of a mean; None twice where one value says nothing of it.

    >>> [round(bound, 2) for bound in mean_interval([1.0, 2.0, 3.0])]
    [-0.48, 4.48]
    >>> mean_interval([1.0])
    (None, None)
    """
    array = np.asarray(values, dtype=float)
    if len(array) < 2:
        return None, None
    if np.ptp(array) == 0:
        return float(array.mean()), float(array.mean())
    half = stats.t.ppf((1 + level) / 2, len(array) - 1) * stats.sem(array)
    return float(array.mean() - half), float(array.mean() + half)


def within(name: str, interval: Interval, values: Sequence[float]) -> Interval:
    """The interval of a figure without what the figure cannot be: a share outside [0, 1], a speed below 0, or a
    cost below 0 where no value is.

    >>> within("speed", (-0.5, 1.5), [0.0, 1.0]), within("cost_return", (-9.0, 1.0), [-4.0])
    ((0.0, 1.5), (-9.0, 1.0))
    """
    low, high = interval
    if low is None or high is None:
        return None, None
    share = name.endswith("_rate")
    cost = name == "cost_return" or name.startswith(COST)
    if share or ((name == "speed" or cost) and min(values) >= 0):
        low = max(low, 0.0)
    return low, min(high, 1.0) if share else high


def as_sure_as(rate: float, trials: int, interval: Interval) -> Interval:
    """The interval of a rate over seeds, not narrower than Wilson's: seeds that agree do not make it surer than its trials.

    >>> [round(bound, 3) for bound in as_sure_as(0.0, 100, (0.0, 0.01))]
    [0.0, 0.037]
    """
    low, high = interval
    if low is None or high is None:
        return None, None
    least, most = wilson(round(rate * trials), trials)
    return min(low, least), max(high, most)


def span(low: float | None, high: float | None, form: str, scale: float = 1.0) -> str:
    """An interval in brackets; "-" where there is none.

    >>> span(0.5, 1.0, ".1f"), span(None, None, ".1f")
    ('[0.5, 1.0]', '-')
    """
    return "-" if low is None or high is None else f"[{low * scale:{form}}, {high * scale:{form}}]"


def summarise(rows: Sequence[dict[str, float]]) -> dict[str, dict[str, float | None]]:
    """Mean and 95% interval of each figure over episodes.

    Args:
        rows: one dict an episode with ``return``, ``cost_return`` (or one of each cost); with a projector ``intervention_rate`` (share of its
            decisions); on the road ``collision``, ``success``, ``frozen`` (0 or 1) and ``speed``.

    Returns:
        ``{figure: {"mean", "low", "high"}}``; Wilson's interval for rates of episodes, Student's t otherwise, within
        what the figure can be; ``low`` and ``high`` are None for a mean of one episode.

    Raises:
        ValueError: no rows.
    """
    if not rows:
        raise ValueError("summarise needs at least one episode, got none.")
    figures = {}
    for figure, (_, is_rate) in FIGURES.items():
        for column in each_cost(figure.removesuffix("_rate") if is_rate else figure, rows[0]):
            name = figure if is_rate else column
            values = [float(row[column]) for row in rows]
            found = wilson(round(sum(values)), len(values)) if is_rate else mean_interval(values)
            low, high = within(name, found, values)
            figures[name] = {"mean": sum(values) / len(values), "low": low, "high": high}
    return figures


def verdict(mean: float, low: float | None, cost_limit: float, name: str = "cost_limit") -> str:
    """Whether a mean cost keeps its limit, which is called ``name``, as far as its interval tells.

    >>> verdict(4.9, 4.5, 5), verdict(5.2, 4.9, 5), verdict(5.2, None, 5), verdict(5.3, 5.1, 5)
    ('cost_limit=5 is kept', 'cost_limit=5 is passed, perhaps by chance', 'cost_limit=5 is passed', 'cost_limit=5 is broken')
    """
    if mean <= cost_limit:
        word = "kept"
    elif low is None:
        word = "passed"
    else:
        word = "broken" if low > cost_limit else "passed, perhaps by chance"
    return f"{name}={cost_limit:g} is {word}"


def table(
    figures: dict[str, dict[str, Any]],
    title: str = "",
    cost_limit: float | Sequence[float] | None = None,
) -> str:
    """A plain-text table of :func:`summarise`'s figures; rates in percent, each cost judged by its limit.

    >>> print(table({"cost_return": {"mean": 33.4, "low": 32.1, "high": 34.7}}, cost_limit=30))
                        mean   95% interval
    cost return        33.40   [32.10, 34.70]   cost_limit=30 is broken
    """
    costs = each_cost("cost_return", figures)
    allowed = dict(zip(costs, limits(cost_limit, costs), strict=True))
    lines = [title] if title else []
    lines.append(f"{'':<14}{'mean':>10}   95% interval")
    for name, value in figures.items():
        scale = 100.0 if name.endswith("_rate") else 1.0
        unit = " %" if scale == 100.0 else ""
        interval = span(value["low"], value["high"], ".2f", scale)
        line = f"{short(name):<14}{value['mean'] * scale:>10.2f}{unit:<2} {interval}{unit * (interval != '-')}"
        if (limit := allowed.get(name)) is not None:
            setting = name.replace(COST, "cost_limit.").replace("cost_return", "cost_limit")
            line += f"   {verdict(value['mean'], value['low'], limit, setting)}"
        lines.append(line)
    return "\n".join(lines)
