"""Figures of episodes: what a finished episode was, rates, intervals, files."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy import stats
from tensordict import TensorDict, TensorDictBase

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


def finished_episodes(data: TensorDictBase) -> TensorDict:
    """Episodes that end within collected data.

    Args:
        data: [*B, T] transitions with ``("next", ...)`` ``done``, ``episode_reward``,
            ``episode_cost`` (TorchRL's RewardSum) and, on the road, the outcomes ``collision``,
            ``offroad``, ``success``.

    Returns:
        [n] TensorDict of float ``return``, ``cost_return`` and, on the road, ``collision`` (with a vehicle or
        off the road), ``success`` and ``frozen``.
    """
    after = data.get("next")
    ends = after[after["done"].squeeze(-1)]
    figures = {
        "return": ends["episode_reward"].squeeze(-1),
        "cost_return": ends["episode_cost"].squeeze(-1),
    }
    if "collision" in after.keys():  # noqa: SIM118
        collision = (ends["collision"] | ends["offroad"]).squeeze(-1).float()
        success = ends["success"].squeeze(-1).float()
        figures |= {
            "collision": collision,
            "success": success,
            "frozen": 1.0 - collision - success,
        }
    return TensorDict(figures, batch_size=ends.batch_size[:1])


class EpisodeWindow:
    """Means over the last episodes.

    ``return`` holds r_safe where ``shaping=risk`` adds it, and is then not to be compared with other
    algorithms'; the return of a test never does.

    Args:
        length: how many episodes.

    >>> EpisodeWindow().short()
    {}
    """

    def __init__(self, length: int = 200):
        self.length = length
        self.values: dict[str, torch.Tensor] = {}

    def extend(self, data: TensorDictBase) -> TensorDict:
        """Take collected data [*B, T]; returns its finished episodes [n]."""
        episodes = finished_episodes(data)
        for key, new in episodes.items():
            old = self.values.get(str(key), torch.zeros(0))
            self.values[str(key)] = torch.cat([old, new.cpu()])[-self.length :]
        return episodes

    def summary(self) -> dict[str, float]:
        """Mean return, cost return and rates of the window; NaN before the first episode."""
        return {
            f"{key}_rate" if f"{key}_rate" in FIGURES else key: round(float(value.mean()), 6)
            for key, value in self.values.items()
        }

    def short(self) -> dict[str, str]:
        """The summary for a progress bar; empty before the first episode."""
        if not any(map(len, self.values.values())):
            return {}
        figures = self.summary()
        bar = {"return": f"{figures['return']:.1f}", "cost": f"{figures['cost_return']:.3f}"}
        rates = {"CR": "collision_rate", "SR": "success_rate"}
        return bar | {name: f"{figures[key]:.0%}" for name, key in rates.items() if key in figures}

    def state_dict(self) -> dict[str, torch.Tensor]:
        return dict(self.values)

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        self.values = {key: value.clone() for key, value in state.items()}


class CsvLog:
    """Rows of scalars; a new column rewrites the file's header, so no value is lost."""

    def __init__(self, path: Path):
        self.path = path

    def read(self) -> list[dict[str, float]]:
        """The rows so far, without what a row leaves empty."""
        if not self.path.exists():
            return []
        with self.path.open(newline="") as file:
            return [{k: float(v) for k, v in row.items() if v} for row in csv.DictReader(file)]

    def write(self, row: dict[str, float]) -> None:
        """Append a row (keys are column names)."""
        rows, columns = [], []
        if self.path.exists():
            with self.path.open(newline="") as file:
                columns = next(csv.reader(file), [])
        new = [key for key in row if key not in columns]
        if new and columns:
            with self.path.open(newline="") as file:
                rows = list(csv.DictReader(file))
        columns = [*columns, *new]
        with self.path.open("w" if new else "a", newline="") as file:
            writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
            if new:
                writer.writeheader()
                writer.writerows(rows)
            writer.writerow(row)


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
