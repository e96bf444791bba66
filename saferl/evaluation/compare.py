"""Tests side by side: the closing ones of runs, and those of ``python -m saferl.evaluate``."""

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

from saferl.config.flat import flat, system_name

#: Not the composition: what tells its repetitions apart.
REPETITION = ("seed", "out")
COLUMNS = ("success_rate", "collision_rate", "return", "cost_return")
RATES = ("collision_rate", "success_rate", "frozen_rate")
#: What a table of tests names first of what tells them apart.
FIRST = ("policy", "task", "scenario", "env", "project")

#: A run's closing test, once it is over.
TESTED = "evaluation/metrics.json"


class Summary(Callback):
    """Hydra's callback that prints :func:`side_by_side` of all runs of a sweep."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        runs = finished([Path(config.hydra.sweep.dir)])
        if len(runs) > 1:
            print(side_by_side(runs))


class SummaryOfTests(Callback):
    """Hydra's callback that prints :func:`conditions_side_by_side` of all tests of a sweep."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        tests = measured_below([Path(config.hydra.sweep.dir)])
        if len(tests) > 1:
            print(conditions_side_by_side(tests))


def finished(folders: Sequence[Path]) -> list[tuple[Mapping, Mapping]]:
    """Configuration and figures of every run below these folders whose closing test is over."""
    from saferl.checkpoint.run import CONFIG  # late: help and most mistakes need no torch

    tests = {test.resolve() for folder in folders for test in folder.glob(f"**/{TESTED}")}
    return [
        (_settings(config), _figures(test))
        for test in sorted(tests, key=lambda path: (len(str(path)), path))  # 2 before 10
        if (config := test.parents[1] / CONFIG).is_file()
    ]


def measured_below(folders: Sequence[Path]) -> list[Mapping]:
    """What ``metrics.json`` says of every test below these folders but the closing ones of runs, the oldest first."""
    from saferl.checkpoint.run import CONFIG

    def closing(test: Path) -> bool:
        return any(
            folder.name == "evaluation" and (folder.parent / CONFIG).is_file()
            for folder in test.parents
        )

    tests = [test for folder in folders for test in folder.glob("**/metrics.json")]
    tests = sorted({test for test in tests if not closing(test)}, key=_age)
    return [figures for figures in map(_figures, tests) if "policy" in figures]


def _age(path: Path) -> tuple[int, str]:
    return path.stat().st_mtime_ns, str(path)


def _settings(path: Path) -> Mapping:
    try:
        config: Any = OmegaConf.to_container(OmegaConf.load(path))
    except Exception as error:  # of the YAML parser's own kinds
        raise ValueError(f"{path} is damaged: {' '.join(str(error).split())}") from error
    if not isinstance(config, Mapping) or not config.keys() >= {"algo_name", "task", "seed"}:
        raise ValueError(f"{path} is damaged: it holds no run's settings.")
    return config


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
    titles = [f"{system_name(each)} {each['task.task']}" for each in settings]
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
    groups: dict[str, dict[Any, Mapping]] = {}  # by seeds: what is repeated says nothing new
    for name, (config, figures) in zip(names([config for config, _ in runs]), runs, strict=True):
        groups.setdefault(name, {})[config.get("seed")] = figures
    rows = {(name, str(len(seeds))): [*seeds.values()] for name, seeds in groups.items()}
    return _laid_out(("", "runs"), rows, columns)


def conditions_side_by_side(tests: Sequence[Mapping]) -> str:
    """A table of tests, one row for each policy and setting, its seeds taken together.

    Args:
        tests: what ``metrics.json`` says of each.

    Returns:
        The settings in which the tests differ, unless those before them in the row tell them; scripted drivers stand first;
        rates with intervals as in :func:`side_by_side`, or return and cost where there are none. What one test
        repeats of another (a policy has no projector to leave out; a shorter test, the same episodes) counts once.
    """
    from saferl.evaluation.statistics import is_figure

    settings = [flat({k: v for k, v in test.items() if not is_figure(k)}) for test in tests]

    def told(keys: Sequence[str]) -> list[tuple[str, ...]]:
        return [tuple(str(each.get(key, "-")) for key in keys) for each in settings]

    heads: list[str] = []
    for key in dict.fromkeys([*FIRST, *(key for each in settings for key in each)]):
        new = len({*told([*heads, key])}) > len({*told(heads)})
        if new and key not in (*REPETITION, "episodes"):
            heads.append(key)
    once: dict[str, int] = {}
    for k, each in enumerate(settings):
        same = str({key: value for key, value in each.items() if key != "episodes"})
        if tests[k]["episodes"] >= tests[once.get(same, k)]["episodes"]:
            once[same] = k
    policies = list(dict.fromkeys(each["policy"] for each in settings))
    policies.sort(key=lambda policy: " (" in policy)  # of a checkpoint
    groups: dict[tuple[str, ...], list[Mapping]] = {}
    for k in sorted(once.values(), key=lambda k: policies.index(settings[k]["policy"])):
        groups.setdefault(told(heads)[k], []).append(tests[k])
    rows = {
        (*label, str(sum(test["episodes"] for test in some))): some
        for label, some in groups.items()
    }
    heads = [head.removeprefix("changed.") for head in heads]
    rated = any(name in test for test in tests for name in RATES)
    return _laid_out((*heads, "episodes"), rows, RATES if rated else ("return", "cost_return"))


def _laid_out(
    heads: Sequence[str], rows: Mapping[tuple[str, ...], Sequence[Mapping]], columns: Sequence[str]
) -> str:
    """A table of labels and, of the tests of each, the figures that some test has, that of costs for each cost."""
    from saferl.evaluation.statistics import each_cost, short

    there = dict.fromkeys(name for some in rows.values() for test in some for name in test)
    columns = [name for figure in columns for name in each_cost(figure, there)]
    lines = [(*heads, *(short(name) + " %" * name.endswith("_rate") for name in columns))]
    for label, tests in rows.items():
        cells = (cell([test for test in tests if name in test], name) for name in columns)
        lines.append((*label, *cells))
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
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
    """Print a table of all runs, and one of all other tests, below these folders."""
    parser = argparse.ArgumentParser("python -m saferl.summary", description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="runs lie below it")
    folders = parser.parse_args(arguments).folders
    try:
        runs, tests = finished(folders), measured_below(folders)
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None
    if not runs and not tests:
        raise SystemExit(
            f"error: no run below {', '.join(map(str, folders))} has been tested: give folders of runs or tests, "
            "as python -m saferl.summary multirun runs."
        )
    tables = [side_by_side(runs)] if runs else []
    tables += [conditions_side_by_side(tests)] if tests else []
    try:
        print("\n\n".join(tables), flush=True)
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
