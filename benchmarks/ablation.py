"""Compositions side by side: how often each arrives and crashes on each task, over seeds.

    python benchmarks/ablation.py OUT --runs "algo=arsac" "algo=arsac cost_critic=quantile risk=cvar" ...
        [--set KEY=VALUE ...] [--seeds 0 1] [--train mixed] [--tasks lt gs rt] [--episodes 500] [--jobs 2]
        [--json PATH]

Trains every composition with every seed on one task, ``--jobs`` at once with one thread each, and tests it
on each of ``--tasks``, the same episodes for all. ``{seed}`` in a setting is the seed: ``init=runs/asac_{seed}``.
A run that is there already is continued, or left as it is, so that the script can be stopped and started again.
Prints one line for each composition and task: the rates of every seed, and of all seeds' episodes together with
Wilson's 95% interval. The seeds differ by more than such an interval says.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from side_by_side import belongs, write

from saferl.evaluation.statistics import wilson

RATES = {"success": "success_rate", "collision": "collision_rate", "frozen": "frozen_rate"}


def saferl(module: str, *arguments: str, log: Path) -> None:
    with log.open("a") as file:
        command = [sys.executable, "-m", module, *arguments]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, stdout=file, stderr=subprocess.STDOUT, env=environment)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)} failed: see {log}")


def settings(name: str, seed: int, options: argparse.Namespace) -> list[str]:
    each = [setting.replace("{seed}", str(seed)) for setting in (*name.split(), *options.set)]
    return [*each, f"seed={seed}"]


def train_and_test(run: Path, overrides: list[str], options: argparse.Namespace) -> None:
    """What is not there yet of a run and its tests."""
    run.parent.mkdir(parents=True, exist_ok=True)
    log = run.with_suffix(".log")
    if not (run / "checkpoints").exists():
        fixed = [f"task={options.train}", "threads=1", "logger=none", "evaluation.episodes=1"]
        saferl("saferl", *overrides, *fixed, f"out={run}", log=log)
    elif not (run / "evaluation" / "metrics.json").exists():
        saferl("saferl", f"resume={run}", log=log)
    for task in options.tasks:
        test = run / f"test_{task}"
        if not (test / "metrics.json").exists():
            how = [f"episodes={options.episodes}", f"env.num_envs={min(options.episodes, 500)}"]
            where = [f"checkpoint={run}", f"task={task}", "env=batched", f"out={test}"]
            saferl("saferl.evaluate", *where, *how, log=log)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--runs", nargs="+", required=True, metavar="COMPOSITION")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="of all runs")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--train", default="mixed", metavar="TASK", help="the task of training")
    parser.add_argument("--tasks", nargs="+", default=["lt", "gs", "rt"])
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--jobs", type=int, default=2, help="runs at once")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()

    belongs(options.out, {"train": options.train, "set": options.set})
    folders = {
        (name, seed): options.out / re.sub(r"[^\w.]+", "_", name) / f"seed{seed}"
        for seed in options.seeds
        for name in options.runs
    }
    with ThreadPoolExecutor(options.jobs) as pool:
        waiting = [
            pool.submit(train_and_test, run, settings(name, seed, options), options)
            for (name, seed), run in folders.items()
        ]
        for each in waiting:
            each.result()

    figures: dict = {}
    print(
        f"| composition | task | {' | '.join(f'{rate} %' for rate in RATES)} |\n|---|---|---|---|---|"
    )
    for name in options.runs:
        for task in options.tasks:
            cells = []
            for label, rate in RATES.items():
                tests = [folders[name, seed] / f"test_{task}" for seed in options.seeds]
                measured = [json.loads((t / "metrics.json").read_text()) for t in tests]
                for test, figure in zip(tests, measured, strict=True):
                    if figure["episodes"] != options.episodes:
                        raise SystemExit(
                            f"--episodes must be {figure['episodes']}, as in {test}, got {options.episodes}"
                        )
                each = [figure[rate]["mean"] for figure in measured]
                count = options.episodes * len(each)
                low, high = wilson(round(sum(each) * options.episodes), count)
                seeds = ", ".join(f"{100 * value:.1f}" for value in each)
                mean = sum(each) / len(each)
                cells.append(f"{100 * mean:.1f} [{100 * low:.1f}, {100 * high:.1f}] ({seeds})")
                figures.setdefault(name, {}).setdefault(task, {})[label] = each
            print(f"| {name} | {task} | {' | '.join(cells)} |")
    write(options.json, figures)


if __name__ == "__main__":
    main()
