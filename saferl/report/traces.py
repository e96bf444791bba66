"""The traces that a report plays: those that lie there, and those that it makes."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import hydra
import numpy as np

from saferl.algorithms.assemble import build_env
from saferl.algorithms.policy import compiling, trained_agent
from saferl.checkpoint.run import FOLDER, latest, run_config
from saferl.envs.intersection import Scenario
from saferl.envs.intersection.true_scene import TrueScene
from saferl.evaluation.play import envs_at_once
from saferl.evaluation.rows import read
from saferl.evaluation.trace import TRACE, Trace, record
from saferl.report.drivers import DRIVERS
from saferl.report.runs import FINISHED, Run
from saferl.report.systems import LABELS

log = logging.getLogger(__name__)

_AT_ONCE = 250


def lying(folders: Sequence[Path], but: Path) -> list[Trace]:
    """All traces below these folders, ``but`` for those below another; of a damaged one a line is said."""
    paths = {path.resolve(): path for each in folders for path in sorted(each.glob(f"**/{TRACE}"))}
    traces = []
    for real, path in paths.items():
        if real.is_relative_to(but.resolve()):
            continue
        try:
            traces.append(Trace.load(path))
        except (ValueError, OSError) as error:
            log.warning("Left out: %s", error)
    return traces


def made(runs: Sequence[Run], count: int, out: Path, drivers: Path) -> list[Trace]:
    """The same episodes with each system: its first run and the scripted drivers play them again, or are read if they have.

    Args:
        runs: as found; those of one seed that most systems have are played.
        count: of episodes: first those in which most systems crashed, then from the test's beginning.
        out: folder of the traces.
        drivers: folder of the drivers' tests.
    """
    finished = [run for run in runs if run.state == FINISHED and (run.folder / FOLDER).is_dir()]
    if count < 1:
        return []
    if not finished:
        log.warning(
            "Nothing is played: no finished run has its checkpoint, as published numbers have not."
        )
        return []
    seeds = [run.seed for run in finished]
    seed = max(sorted(set(seeds)), key=seeds.count)
    chosen = [run for run in finished if run.seed == seed]
    folders = {run.algo: run.folder / "evaluation" for run in chosen}
    folders |= {name: drivers / f"{name}-seed{seed}" for name in DRIVERS}
    tests = {name: read(folder / "episodes.csv") for name, folder in folders.items()}
    crashes = sum(tests[run.algo]["collision"] for run in chosen)
    wanted = np.sort(np.argsort(-np.asarray(crashes), kind="stable")[:count])
    traces = []
    for name, test in tests.items():
        rows = [{key: column[index].item() for key, column in test.items()} for index in wanted]
        rows = [row | {key: int(row[key]) for key in ("episode", "seed")} for row in rows]
        folder, run = out / f"{name}-seed{seed}", next((r for r in chosen if r.algo == name), None)
        traces.append(_trace(name, run, chosen[0], rows, folder, seed))
    return traces


def _trace(
    name: str, run: Run | None, first: Run, rows: list[dict], folder: Path, seed: int
) -> Trace:
    """One system's trace of these episodes; of a scripted driver where there is no run."""
    about: dict[str, Any] = {"algo": name}
    if run is not None:  # a run that goes on is another policy
        about |= {"training_seed": seed, "checkpoint": latest(run.folder).name}
    try:
        trace = Trace.load(folder)
        same = all(trace.about.get(key) == value for key, value in about.items())
        if same and trace.episodes["seed"].tolist() == [row["seed"] for row in rows]:
            return trace
    except (OSError, ValueError):  # not there, or cut off
        pass
    log.info("%s plays %d episodes again.", LABELS.get(name, name), len(rows))
    cfg = compiling(run_config((run or first).folder), False)
    cfg.device = "cpu"
    scenario: Scenario = hydra.utils.instantiate(cfg.task).as_test()
    width = envs_at_once(len(rows), _AT_ONCE)
    if run is None:
        policy, transforms, critics, limit = scenario.driver(name, seed), [], None, None
    else:
        agent = trained_agent(cfg, run.folder)
        policy, transforms, critics, limit = agent.actor, agent.transforms, agent.risk, agent.limit
    with closing(build_env(cfg.env, scenario, width, 0, "cpu", [TrueScene(), *transforms])) as env:
        trace = record(policy, env, rows, critics, limit, policy=name, **about)
    trace.save(folder)
    return trace
