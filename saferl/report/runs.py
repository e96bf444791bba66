"""The runs below some folders: which are whole, which belong together, and what is the matter with the others."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from saferl.checkpoint.lock import worker
from saferl.checkpoint.run import CONFIG, run_config
from saferl.config.flat import MADE, flat, system_name
from saferl.envs.intersection.geometry import ROUTES, TASK_OF_ROUTE
from saferl.evaluation.compare import REPETITION, TESTED
from saferl.evaluation.rows import read

#: The paper's tasks, as :data:`TASK_OF_ROUTE` numbers them.
TASKS = ("lt", "gs", "rt")
#: Figures of the paper's tables, by their names in ``metrics.json``.
FIGURES = ("collision_rate", "success_rate", "frozen_rate", "return", "speed")
FINISHED, RUNNING, INTERRUPTED, BROKEN, FOREIGN = STATES = (
    "finished", "running", "interrupted", "broken", "foreign",
)  # fmt: skip
CURVE, TIMING, FAILED = "metrics.csv", "timing.csv", "error.txt"
_ROAD = "saferl.envs.intersection.Scenario"
#: What may differ between repetitions: it changes where, how fast or how often something is done, and no result.
_FREE = (*REPETITION, *MADE, "record_every", "collector")
#: What systems that are compared have in common: the task, but for a reward of their own in training, and the test.
_COMMON = ("task", "env._target_", "env.drivers", "evaluation.episodes")
#: And those of a family, off-policy or on-policy: an update of one is dearer than of the other.
_BUDGET = ("frames", "episodes")
_OWN = "task.reward.risk_shaping"


@dataclass(frozen=True)
class Run:
    """A run's folder and what is in it.

    Attributes:
        folder: where.
        state: one of :data:`STATES`; only finished runs count.
        reason: why it is not finished, in words.
        settings: its configuration by dotted keys; empty if it cannot be read.
        test: its closing test, the figures [episodes, 5] (:data:`FIGURES`) of each of :data:`TASKS`.
        curve, timing: columns of ``metrics.csv`` and ``timing.csv``.
    """

    folder: Path
    state: str
    reason: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    test: Sequence[np.ndarray] = ()
    curve: Mapping[str, np.ndarray] = field(default_factory=dict)
    timing: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def algo(self) -> str:
        """Name of its algorithm, with that of a projector that has one (a shield); "" if its configuration cannot be read."""
        return system_name(self.settings)

    @property
    def seed(self) -> int:
        """Its seed, which is its test's, too."""
        return int(self.settings["seed"])


def find(folders: Sequence[Path]) -> list[Run]:
    """All runs below these folders, seeds in order.

    A run is ``foreign`` if it is none of the road, if its task, observation or test is not that of most finished runs, its budget not that of most of its family, if
    it differs in another setting from most of its own algorithm, or if it repeats a seed.

    Raises:
        ValueError: a folder is not there.
    """
    for folder in folders:
        if not folder.is_dir():
            raise ValueError(f"no such folder: {folder}")
    marks = (CONFIG, FAILED, CURVE, TESTED)
    found = {
        (run := path.parents[mark.count("/")]).resolve(): run
        for folder in folders
        for mark in marks
        for path in folder.glob(f"**/{mark}")
    }
    runs = [
        look(folder) for folder in sorted(found.values(), key=lambda path: (len(str(path)), path))
    ]
    return sorted(_strangers(runs), key=lambda run: run.algo)


def look(folder: Path) -> Run:
    """One run by itself, whatever the others are."""
    settings: dict[str, Any] = {}
    try:
        if not (folder / CONFIG).is_file():
            failed = folder / FAILED
            told = failed.read_text(encoding="utf-8").strip() if failed.is_file() else ""
            return Run(folder, BROKEN, told.rpartition("\n")[2] or f"it has no {CONFIG}")
        settings = flat(OmegaConf.to_container(run_config(folder)))
        if not isinstance(settings.get("seed"), int) or not settings.get("algo_name"):
            raise ValueError(f"{folder / CONFIG} is damaged: it names no seed or no algo_name.")
        if not (folder / TESTED).is_file():
            if (who := worker(folder)) is not None:
                return Run(folder, RUNNING, f"{who}, {_progress(folder, settings)}", settings)
            again = f"{_progress(folder, settings)}; resume={folder} goes on"
            return Run(folder, INTERRUPTED, again, settings)
        if settings.get("task._target_") != _ROAD:
            return Run(
                folder, FOREIGN, f"task={settings.get('task.task')} is not the road", settings
            )
        played = json.loads((folder / TESTED).read_text(encoding="utf-8"))["episodes"]
        test = read_test((folder / TESTED).with_name("episodes.csv"), played)
        curve, timing = (_numbers(folder / name) for name in (CURVE, TIMING))
        return Run(folder, FINISHED, "", settings, test, curve, timing)
    except KeyError as error:
        return Run(folder, BROKEN, f"{TESTED} names no {error}", settings)
    except (ValueError, TypeError, OSError) as error:
        return Run(folder, BROKEN, " ".join(str(error).split()), settings)


def _numbers(path: Path) -> dict[str, np.ndarray]:
    """The columns of a file of numbers.

    Raises:
        ValueError: one holds something else.
    """
    columns = read(path)
    if wrong := [name for name, column in columns.items() if column.dtype.kind not in "biuf"]:
        raise ValueError(f"{path} is damaged: its column {wrong[0]} must hold numbers.")
    return columns


def read_test(path: Path, played: int) -> list[np.ndarray]:
    """The figures [episodes, 5] (:data:`FIGURES`) of each of :data:`TASKS` in an ``episodes.csv``.

    Raises:
        ValueError: it is damaged, or not of ``played`` episodes.
    """
    columns = read(path)
    names = [figure.removesuffix("_rate") for figure in FIGURES]
    if missing := [name for name in ("route", *names) if name not in columns]:
        raise ValueError(f"{path} is damaged: it has no column {missing[0]}.")
    figures = np.stack([columns[name] for name in names], -1)
    if len(figures) != played or figures.dtype != float or not np.isfinite(figures).all():
        raise ValueError(f"{path} is damaged: it must hold {played} episodes, all of numbers.")
    if unknown := set(columns["route"]) - set(ROUTES):
        raise ValueError(f"{path} is damaged: it has a route {unknown.pop()!r}.")
    task = np.array([TASK_OF_ROUTE[ROUTES.index(route)] for route in columns["route"]])
    return [figures[task == number] for number in range(len(TASKS))]


def _progress(folder: Path, settings: Mapping[str, Any]) -> str:
    """How far a run is that is not finished."""
    curve = folder / CURVE
    if not curve.is_file():
        return "before its first record"
    frames = curve.read_text(encoding="utf-8").rstrip().rpartition("\n")[2].partition(",")[0]
    budget = settings.get("frames")
    return f"at frame {frames}" + (f" of {budget}" if budget else "")


def _strangers(runs: list[Run]) -> list[Run]:
    """The same runs, those foreign that do not go with the rest."""
    runs = _apart(runs, lambda run: "", _those(_COMMON), "the others have")
    runs = _apart(runs, _family, _those(_BUDGET), "the others have")
    runs = _apart(runs, lambda run: run.algo, _composition, "others of its algorithm have")
    first: dict[tuple[str, int], Path] = {}
    for index, run in enumerate(runs):
        if run.state == FINISHED:
            same = first.setdefault((run.algo, run.seed), run.folder)
            if same != run.folder:
                reason = f"it repeats seed {run.seed} of {run.algo}, which is {same}"
                runs[index] = replace(run, state=FOREIGN, reason=reason)
    return runs


def _family(run: Run) -> str:
    return str(run.settings.get("learning._target_"))


def _those(names: Sequence[str]) -> Callable[[Run], dict[str, Any]]:
    """The settings of a run of these names, or below them."""

    def settings(run: Run) -> dict[str, Any]:
        return {
            key: value
            for key, value in run.settings.items()
            if key != _OWN and any(f"{key}.".startswith(f"{name}.") for name in names)
        }

    return settings


def _composition(run: Run) -> dict[str, Any]:
    return {
        key: value
        for key, value in run.settings.items()
        if key.partition(".")[0] not in (*_FREE, "evaluation") and "compile" not in key
    }


def _apart(
    runs: list[Run],
    group: Callable[[Run], str],
    settings: Callable[[Run], dict[str, Any]],
    others: str,
) -> list[Run]:
    """Call those finished runs foreign whose settings are not those of most in their group."""
    votes: dict[str, Counter[str]] = {}
    said: dict[str, dict[str, Any]] = {}
    for run in runs:
        if run.state == FINISHED:
            text = repr(sorted(settings(run).items()))
            said[text] = settings(run)
            votes.setdefault(group(run), Counter())[text] += 1
    result = []
    for run in runs:
        if run.state == FINISHED:
            mine, most = settings(run), said[votes[group(run)].most_common(1)[0][0]]
            keys = [k for k in most | mine if most.get(k) != mine.get(k)]
            if keys:
                told = ", ".join(
                    f"{key}={mine.get(key)} ({others} {most.get(key)})" for key in keys
                )
                run = replace(run, state=FOREIGN, reason=told)
        result.append(run)
    return result
