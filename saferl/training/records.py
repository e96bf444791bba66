"""What a run writes down: means over its last episodes, and files of scalars."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase

from saferl.evaluation.costs import by_name, limits, names
from saferl.evaluation.statistics import FIGURES, WINDOW

#: How episodes ended, [n] by name, from their last steps: :meth:`saferl.envs.task.Task.outcomes`.
Outcomes = Callable[[TensorDictBase], Mapping[str, torch.Tensor]]


def no_outcomes(last: TensorDictBase) -> Mapping[str, torch.Tensor]:
    """No outcomes."""
    return {}


def finished_episodes(data: TensorDictBase, outcomes: Outcomes = no_outcomes) -> TensorDict:
    """Episodes that end within collected data.

    Args:
        data: [*B, T] transitions with ``("next", ...)`` ``done``, ``episode_reward`` and
            ``episode_cost`` (TorchRL's RewardSum).
        outcomes: the task's own.

    Returns:
        [n] TensorDict of float ``return``, ``cost_return`` ([n, K] of several costs) and the outcomes.
    """
    after = data.get("next")
    ends = after[after["done"].squeeze(-1)]
    figures = {
        "return": ends["episode_reward"].squeeze(-1),
        "cost_return": ends["episode_cost"].squeeze(-1),
    }
    return TensorDict({**figures, **outcomes(ends)}, batch_size=ends.batch_size[:1])


class EpisodeWindow:
    """Means over the last episodes.

    ``return`` holds r_safe where ``shaping=risk`` adds it, and is then not to be compared with other
    algorithms'; the return of a test never does.

    Args:
        outcomes: how the task's episodes end.
        length: how many episodes.
        costs: names of the numbers of a cost.

    >>> EpisodeWindow().short()
    {}
    """

    def __init__(
        self,
        outcomes: Outcomes = no_outcomes,
        length: int = WINDOW,
        costs: Sequence[str] = ("cost",),
    ):
        self.outcomes, self.length, self.costs = outcomes, length, costs
        self.values: dict[str, torch.Tensor] = {}

    def extend(self, data: TensorDictBase) -> TensorDict:
        """Take collected data [*B, T]; returns its finished episodes [n]."""
        episodes = finished_episodes(data, self.outcomes)
        for key, new in episodes.items():
            old = self.values.get(str(key), new.cpu()[:0])
            self.values[str(key)] = torch.cat([old, new.cpu()])[-self.length :]
        return episodes

    def summary(self) -> dict[str, float]:
        """Mean return, cost return and rates of the window; NaN before the first episode."""
        return {
            f"{key}_rate" if f"{key}_rate" in FIGURES else key: round(float(value.mean()), 6)
            for key, value in by_name(self.values, self.costs).items()
        }

    def short(self, cost_limit: float | Sequence[float] | None = None) -> dict[str, str]:
        """The summary for a progress bar, each cost beside its limit, the longest last, as a narrow terminal cuts them; empty
        before the first episode."""
        if not any(map(len, self.values.values())):
            return {}
        figures = self.summary()
        rates = {"SR": "success_rate", "CR": "collision_rate"}
        bar = {name: f"{figures[key]:.0%}" for name, key in rates.items() if key in figures}
        bar["return"] = f"{figures['return']:.1f}"
        for key, limit in zip(
            names("cost_return", self.costs), limits(cost_limit, self.costs), strict=True
        ):
            beside = "" if limit is None else f" of {limit:g}"
            bar[key.replace("cost_return", "cost")] = f"{figures[key]:.3f}{beside}"
        return bar

    def state_dict(self) -> dict[str, torch.Tensor]:
        return dict(self.values)

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        self.values = {key: value.clone() for key, value in state.items()}


class Means:
    """Means of scalars by name since they were last taken; no value is fetched from a GPU before.

    >>> means = Means()
    >>> for loss in (1.0, 3.0):
    ...     means.add("loss_actor", torch.tensor(loss))
    >>> means.take(), means.take()
    ({'loss_actor': 2.0}, {})
    """

    def __init__(self):
        self.sums: dict[str, torch.Tensor] = {}
        self.counts: dict[str, int] = {}

    def add(self, name: str, value: torch.Tensor) -> None:
        """Take a value, of one element."""
        self.sums[name] = self.sums.get(name, 0.0) + value.reshape(())
        self.counts[name] = self.counts.get(name, 0) + 1

    def take(self) -> dict[str, float]:
        """The means, by name in order; from here on anew."""
        means = {name: float(self.sums[name]) / self.counts[name] for name in sorted(self.sums)}
        self.sums, self.counts = {}, {}
        return means

    def state_dict(self) -> dict:
        return {"sums": dict(self.sums), "counts": dict(self.counts)}

    def load_state_dict(self, state: dict) -> None:
        self.sums, self.counts = dict(state["sums"]), dict(state["counts"])


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
        """Append a row (keys are column names).

        Raises:
            OSError: there is no room for it; names the file.
        """
        try:
            self._write(row)
        except OSError as error:
            error.filename = str(self.path)  # which a write does not know
            raise

    def _write(self, row: dict[str, float]) -> None:
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
