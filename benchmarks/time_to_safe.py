"""From nothing to safe: minutes and frames until a policy for all tasks succeeds in 90, 95 and 97.9% of its tests.

    python benchmarks/time_to_safe.py OUT [--runs "algo=arsac" "algo=sac task.observation=world" ...]
        [--seeds 0 1 2] [--minutes 30] [--every 3] [--episodes 500] [--set KEY=VALUE ...] [--jobs 2]
        [--peers intersection-v1 ours] [--peer-minutes 10] [--json PATH]

Trains each composition with each seed on ``task=mixed``, ``--jobs`` at once with one thread each, and tests it every
few minutes on left, straight and right, 500 episodes each at 10 Hz, with its projector. Minutes are of collecting,
compiling and learning; tests do not count. A run ends with its budget of frames, or with the first test after the minutes.
What is in OUT already is not run again.

``--peers`` are what a user would take instead, each trained for the minutes and then tested once, in ``--episodes``
in all: ``intersection-v1`` is Stable-Baselines3's SAC on highway-env's own intersection with continuous actions,
``ours`` the same SAC on our gymnasium environment. OmniSafe needs an environment of its own with old packages, on which
ours does not run: ``benchmarks/omnisafe_sac_lag.py`` compares what its updates cost.

Prints a row for each run: frames and minutes at each mark, and what it had reached at the end.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import os
import re
import shutil
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium
import hydra
import numpy as np
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from side_by_side import belongs, write

from saferl.algorithms.assemble import build_env, build_trainer
from saferl.algorithms.parts import make
from saferl.algorithms.policy import compiling
from saferl.cli.train import claim
from saferl.config.locate import config_dir
from saferl.envs.transforms import SafetyProjector
from saferl.evaluation.play import evaluate

MARKS = (0.90, 0.95, 0.979)
TASKS = ("lt", "gs", "rt")
ENDS = ("success", "collision", "frozen")


class Over(Exception):
    """The minutes are spent."""


def test_projector(cfg: Any, loss: Any) -> list[SafetyProjector]:
    """What corrects in the tests of a training, compiled where the losses are; none where it has none."""
    cfg = compiling(cfg, cfg.compile)
    if cfg.projector._target_ is None:
        return []
    projector = make(cfg.projector, risk=loss.cost_value)
    projector.set_progress(1.0)
    return [projector]


def test(cfg: Any, trainer: Any, projector: list, episodes: int) -> dict[str, float]:
    """Rates on the three tasks and their means, by ``END`` and ``END_TASK``."""
    scenario = hydra.utils.instantiate(cfg.task)
    cfg = compiling(cfg, False)
    figures: dict[str, float] = {}
    for task in TASKS:
        one = dataclasses.replace(scenario, task=task).as_test()
        env = build_env(cfg.env, one, min(episodes, 250), 0, transforms=projector)
        rows = evaluate(trainer.collector.policy, env, episodes, seed=0, progress=False)
        for transform in projector:
            transform.reset_parent()  # for the next environment
        figures |= {f"{end}_{task}": sum(row[end] for row in rows) / len(rows) for end in ENDS}
    means = {end: sum(figures[f"{end}_{task}"] for task in TASKS) / len(TASKS) for end in ENDS}
    return means | figures


def train(out: Path, overrides: list[str], minutes: float, every: float, episodes: int) -> None:
    """One training in this process; ``tests.csv`` in ``out`` gets a row for each test."""
    with initialize_config_dir(config_dir(), version_base="1.3"):
        cfg = compose("config", [*overrides, "threads=1", "logger=none", "save_minutes=null"])
    shutil.rmtree(out, ignore_errors=True)  # of a run that was stopped
    begin, testing, due = time.monotonic(), 0.0, every
    OmegaConf.resolve(cfg)  # so that its policy can be tested
    trainer = build_trainer(cfg, out)
    projector = test_projector(cfg, trainer.learner.loss)
    claim(out, cfg)
    rows: list[dict] = []

    def elapsed() -> float:
        return (time.monotonic() - begin - testing) / 60

    def look(*_: object) -> None:
        if elapsed() >= due and trainer.spent < 1.0:  # the end has a test of its own
            measure()

    def measure() -> None:
        nonlocal testing, due
        spent = elapsed()
        started = time.monotonic()
        due = spent + every
        progress = trainer.progress
        row = {"minutes": round(spent, 3), "frames": progress.frames, "updates": progress.updates}
        rows.append(row | test(cfg, trainer, projector, episodes))
        with (out / "tests.part").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        testing += time.monotonic() - started
        if spent >= minutes:
            raise Over

    trainer.after_collect.append(look)
    try:
        trainer.train()
        measure()
    except Over:
        pass
    (out / "tests.part").rename(out / "tests.csv")


def peer(out: Path, name: str, minutes: float, episodes: int) -> None:
    """Stable-Baselines3's SAC for so many minutes, then tested; ``tests.csv`` gets one row."""
    from stable_baselines3 import SAC
    from stable_baselines3.common.callbacks import BaseCallback

    torch.set_num_threads(1)

    def environment(task: str = "mixed", policy_frequency: int = 5) -> gymnasium.Env:
        if name == "ours":
            import saferl.envs  # noqa: F401  (registers it)

            settings = {"task": task, "policy_frequency": policy_frequency}
            return gymnasium.wrappers.FlattenObservation(
                gymnasium.make("saferl/Intersection-Mixed-v0", **settings)
            )
        import highway_env  # noqa: F401  (registers it)

        config = {"action": {"type": "ContinuousAction"}}
        return gymnasium.wrappers.FlattenObservation(
            gymnasium.make("intersection-v1", config=config)
        )

    class Clock(BaseCallback):
        def _on_step(self) -> bool:
            return time.monotonic() - begin < 60 * minutes

    begin = time.monotonic()
    model = SAC("MlpPolicy", environment(), seed=0, device="cpu")
    model.learn(10**9, callback=Clock())
    row: dict[str, float] = {"minutes": minutes, "frames": model.num_timesteps}
    row["updates"] = model._n_updates
    ends = dict.fromkeys(ENDS, 0)
    tasks = TASKS if name == "ours" else ("",)
    for task in tasks:
        env = environment(task or "mixed", 10)
        for number in range(episodes // len(tasks)):
            observation, done = env.reset(seed=number)[0], False
            while not done:
                action, _ = model.predict(observation, deterministic=True)
                observation, _, terminated, truncated, info = env.step(action)
                done = terminated or truncated
            if name == "ours":
                success, crash = info["success"], info["collision"] or info["offroad"]
            else:
                road: Any = env.unwrapped
                # It asks for the nearest lane alone: whoever has left the road may be said to have arrived.
                crash = info["crashed"] or not road.vehicle.on_road
                success = road.has_arrived(road.vehicle)
            end = "collision" if crash else "success" if success else "frozen"
            ends[end] += 1
    count = sum(ends.values())
    row |= {end: value / count for end, value in ends.items()}
    out.mkdir(parents=True, exist_ok=True)
    with (out / "tests.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(row), lineterminator="\n")
        writer.writeheader()
        writer.writerow(row)


Work = dict[Path, tuple[Callable, dict[str, Any]]]
"""By its folder, where ``tests.csv`` will be: a function of the folder, and what else it is told."""


def carry_out(work: Work, jobs: int) -> None:
    """Do what is not done yet, ``jobs`` at once.

    Raises:
        SystemExit: a folder holds what was done with other settings.
    """
    os.environ["OMP_NUM_THREADS"] = "1"
    done = {folder for folder in work if (folder / "tests.csv").exists()}
    for folder in done:
        belongs(folder, work[folder][1])
    # A process for each run: what one compiles or allocates is no other's.
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        waiting = {
            folder: pool.submit(function, folder, **settings)
            for folder, (function, settings) in work.items()
            if folder not in done
        }
        for folder, each in waiting.items():
            each.result()
            belongs(folder, work[folder][1])


def tests(folder: Path) -> list[dict[str, float]]:
    """The rows of ``tests.csv``."""
    with (folder / "tests.csv").open(newline="") as file:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]


def marks(rows: list[dict[str, float]]) -> dict[str, dict[str, float] | None]:
    """The first test at which each mark was passed."""
    return {
        f"{mark:.1%}": next((row for row in rows if row["success"] >= mark), None) for mark in MARKS
    }


def show(name: str, seed: str, rows: list[dict[str, float]]) -> None:
    cells = [
        "-" if row is None else f"{row['frames'] / 1e3:.0f}k, {row['minutes']:.1f}"
        for row in marks(rows).values()
    ]
    last = rows[-1]
    end = f"{last['frames'] / 1e3:.0f}k, {last['minutes']:.1f}"
    rates = " / ".join(f"{100 * last[e]:.1f}" for e in ENDS)
    print(f"| {name} | {seed} | {' | '.join(cells)} | {end} | {rates} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--runs", nargs="*", default=["algo=arsac"], metavar="COMPOSITION")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--every", type=float, default=3.0, help="minutes between two tests")
    parser.add_argument("--episodes", type=int, default=500, help="of each task in a test")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="of all runs")
    parser.add_argument("--jobs", type=int, default=2, help="runs at once")
    parser.add_argument("--peers", nargs="*", default=[])
    parser.add_argument("--peer-minutes", type=float, help="of each peer; by default --minutes")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    for name in set(options.peers) - {"intersection-v1", "ours"}:
        raise SystemExit(f"--peers must be among intersection-v1, ours, got {name!r}")

    folders: dict[tuple[str, str], Path] = {}
    work: Work = {}
    tested = {"minutes": options.minutes, "episodes": options.episodes}
    for seed in options.seeds:
        for name in options.runs:
            folder = options.out / re.sub(r"[^\w.]+", "_", name) / f"seed{seed}"
            folders[name, str(seed)] = folder
            overrides = ["task=mixed", *name.split(), *options.set, f"seed={seed}"]
            work[folder] = train, {"overrides": overrides, "every": options.every, **tested}
    for name in options.peers:
        folder = options.out / f"peer_{name}"
        folders[f"SB3 SAC, {name}", "0"] = folder
        peer_minutes = options.peer_minutes or options.minutes
        work[folder] = peer, {"name": name, **tested, "minutes": peer_minutes}
    carry_out(work, options.jobs)

    figures: dict = {}
    print(
        f"Frames and minutes to a mean success of each mark over {', '.join(TASKS)}; at the end success / collision "
        f"/ frozen %. {options.jobs} at once, load {os.getloadavg()[0]:.1f}\n\n"
        f"| | seed | {' | '.join(f'{mark:.1%}' for mark in MARKS)} | end | success / collision / frozen % |\n"
        f"|{'---|' * (len(MARKS) + 4)}"
    )
    for (name, seed), folder in folders.items():
        rows = tests(folder)
        show(name, seed, rows)
        figures[f"{name}, {seed}"] = {"tests": rows, "marks": marks(rows)}
    for name in dict.fromkeys(name for name, _ in folders):
        ends = [value["tests"][-1] for key, value in figures.items() if key.startswith(f"{name}, ")]
        if len(ends) > 1:
            means = (f"{100 * np.mean([row[end] for row in ends]):.2f}" for end in ENDS)
            print(f"{name}, mean of {len(ends)} seeds at the end: {' / '.join(means)} %")
    write(options.json, figures)


if __name__ == "__main__":
    main()
