"""The closing tests of runs side by side."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from saferl.config.flat import flat

#: Not the composition: what tells its repetitions apart.
REPETITION = ("seed", "out")
COLUMNS = ("success_rate", "collision_rate", "return", "cost_return")


#: A run's closing test, once it is over.
TESTED = "evaluation/metrics.json"


class Summary(Callback):
    """Hydra's callback that prints :func:`side_by_side` of all runs of a sweep."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        runs = finished([Path(config.hydra.sweep.dir)])
        if len(runs) > 1:
            print(side_by_side(runs))


def finished(folders: Sequence[Path]) -> list[tuple[Mapping, Mapping]]:
    """Configuration and figures of every run below these folders whose closing test is over."""
    from saferl.checkpoint.run import CONFIG  # late: help and most mistakes need no torch

    tests = [test for folder in folders for test in folder.glob(f"**/{TESTED}")]
    return [
        (OmegaConf.to_container(OmegaConf.load(config)), _figures(test))  # pyright: ignore
        for test in sorted(tests, key=lambda path: (len(str(path)), path))  # 2 before 10
        if (config := test.parents[1] / CONFIG).is_file()
    ]


def _figures(test: Path) -> Mapping:
    try:
        return json.loads(test.read_text())
    except ValueError as error:
        raise ValueError(f"{test} is damaged: {error}; remove it and repeat the test.") from error


def names(configs: Sequence[Mapping]) -> list[str]:
    """What to call each configuration: its algorithm and task, and the keys that differ among those of
    one name; the same for repetitions that differ in their seed alone.

    >>> run = {"algo_name": "sac", "task": {"task": "gs"}, "tau": 0.1, "seed": 0}
    >>> names([run, {**run, "seed": 1}, {**run, "tau": 0.2}, {**run, "algo_name": "asac"}])
    ['sac gs tau=0.1', 'sac gs tau=0.1', 'sac gs tau=0.2', 'asac gs']
    """
    settings = [flat(config) for config in configs]
    titles = [f"{each['algo_name']} {each['task.task']}" for each in settings]
    called = []
    for title, mine in zip(titles, settings, strict=True):
        others = [s for t, s in zip(titles, settings, strict=True) if t == title]
        keys = dict.fromkeys(key for other in others for key in other if key not in REPETITION)
        differing = [k for k in keys if any(o.get(k) != mine.get(k) for o in others)]
        called.append(" ".join([title, *(f"{key}={mine.get(key)}" for key in differing)]))
    return called


def side_by_side(runs: Sequence[tuple[Mapping, Mapping]], columns: Sequence[str] = COLUMNS) -> str:
    """A table of closing tests, one row for each composition, its seeds taken together.

    Args:
        runs: configuration and figures (``metrics.json``) of each.
        columns: names of figures, of which those are shown that some run has.

    Returns:
        Means with 95% intervals: over seeds (Student's t, wide for few; of rates never narrower than Wilson's of
        all their episodes), of a single seed over its episodes.
    """
    from saferl.evaluation.statistics import FIGURES

    groups: dict[str, list[Mapping]] = {}
    for name, (_, figures) in zip(names([config for config, _ in runs]), runs, strict=True):
        groups.setdefault(name, []).append(figures)
    columns = [name for name in columns if any(name in figures for _, figures in runs)]
    titles = [FIGURES[name][0] + " %" * name.endswith("_rate") for name in columns]
    rows = [["", "runs", *titles]]
    for name, tests in groups.items():
        row = [name, str(len(tests))]
        for column in columns:
            row.append(cell([figures for figures in tests if column in figures], column))
        rows.append(row)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


def cell(tests: Sequence[Mapping[str, Any]], name: str) -> str:
    """Mean and interval of one figure; "-" where no test has it.

    >>> cell([{"return": {"mean": mean}} for mean in (1.0, 2.0, 3.0)], "return")
    '2 [-0.4841, 4.484]'
    >>> cell([{"episodes": 50, "success_rate": {"mean": 1.0}}] * 2, "success_rate")
    '100.0 [96.3, 100.0]'
    """
    from saferl.evaluation.statistics import as_sure_as, mean_interval, span, within

    if not tests:
        return "-"
    means = [test[name]["mean"] for test in tests]
    mean = sum(means) / len(means)
    rate = name.endswith("_rate")
    if len(means) > 1:
        interval = within(name, mean_interval(means), means)
    else:
        interval = tests[0][name]["low"], tests[0][name]["high"]
    if not rate:
        return f"{mean:.4g} {span(*interval, '.4g')}"
    interval = as_sure_as(mean, sum(test["episodes"] for test in tests), interval)
    return f"{100 * mean:.1f} {span(*interval, '.1f', 100)}"


def main(arguments: list[str] | None = None) -> None:
    """Print the table of all runs below these folders."""
    parser = argparse.ArgumentParser("python -m saferl.summary", description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="runs lie below it")
    folders = parser.parse_args(arguments).folders
    try:
        runs = finished(folders)
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None
    if not runs:
        raise SystemExit(
            f"error: no run below {', '.join(map(str, folders))} has been tested: give folders of runs, "
            "as python -m saferl.summary multirun runs."
        )
    try:
        print(side_by_side(runs), flush=True)
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
