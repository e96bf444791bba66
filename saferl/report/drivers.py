"""The scripted drivers on the tests of the runs, played once and kept."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import hydra
import numpy as np

from saferl.checkpoint.run import run_config
from saferl.envs.intersection import BatchedIntersection, Scenario
from saferl.evaluation.play import envs_at_once, evaluate
from saferl.evaluation.rows import write
from saferl.report.runs import FINISHED, Run, read_test
from saferl.report.systems import System

log = logging.getLogger(__name__)

#: By the names that commands give them, as they stand in tables.
DRIVERS = ("scripted", "blind")
_AT_ONCE = 250


def drive(runs: Sequence[Run], out: Path) -> list[System]:
    """The drivers as systems, on the tests of all finished runs together.

    Args:
        runs: of one task.
        out: folder in which ``NAME-seedN`` holds what was played, now or before.
    """
    finished = [run for run in runs if run.state == FINISHED]
    if not finished:
        return []
    settings = finished[0].settings
    cfg = run_config(finished[0].folder).task
    task = hydra.utils.instantiate(cfg).as_test()
    count, seeds = settings["evaluation.episodes"], sorted({run.seed for run in finished})
    systems = []
    for name in DRIVERS:
        tests = [_test(name, task, seed, count, out) for seed in seeds]
        # Nothing is drawn in a driver: its episodes are one sample.
        together = [np.concatenate(episodes) for episodes in zip(*tests, strict=True)]
        systems.append(System(name, [together], seeds))
    return systems


def _test(name: str, task: Scenario, seed: int, count: int, out: Path) -> list[np.ndarray]:
    """A driver's test, read if it is there."""
    folder = out / f"{name}-seed{seed}"
    about = json.loads(json.dumps({"played": dataclasses.asdict(task), "episodes": count}))
    try:
        metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
        if {key: metrics.get(key) for key in about} == about:
            return read_test(folder / "episodes.csv", count)
    except (OSError, ValueError):  # not there, or cut off
        pass
    log.info("The %s driver plays the %d episodes of seed %d.", name, count, seed)
    width = envs_at_once(count, _AT_ONCE)
    with closing(BatchedIntersection(task, num_envs=width, seed=seed)) as env:
        rows = evaluate(task.driver(name, seed), env, count, seed)
    write(rows, folder, policy=name, seed=seed, **about)
    return read_test(folder / "episodes.csv", count)
