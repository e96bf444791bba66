"""Constraints as a newcomer sets them: only ``cost_limit``, on linear-quadratic problems whose optimum is known.

    python benchmarks/limits.py OUT [--algos cpo ppo_lag sac_lag sac_pid] [--problems Effort Distance] [--seeds 0 1 2]
        [--frames 200000] [--episodes 2000] [--jobs 2] [--set KEY=VALUE ...] [--json PATH]

``Effort`` is a cart on a line whose steps cost what they steer (33 without a limit, 20 allowed); ``Distance`` a mass with
friction whose steps cost how far off it is (9.7, 6 allowed), benchmarks/lqr.py. Prints a row for each run: mean cost and return of
the closing test with 95% intervals, beside the limit and the best return under it (Riccati, forces cut off at their
bounds). What is in OUT already is not run again.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from lqr import PROBLEMS
from side_by_side import write

from saferl.evaluation.statistics import span

HERE = Path(__file__).parent


def train(folder: Path, algo: str, problem: str, seed: int, options: argparse.Namespace) -> None:
    if (folder / "evaluation/metrics.json").exists():
        return
    settings = [f"algo={algo}", "task=gym", f"task.id=lqr:{problem}-v0", f"seed={seed}"]
    settings += [f"cost_limit={PROBLEMS[problem].limit:g}", f"frames={options.frames}"]
    settings += [
        "threads=1",
        "logger=none",
        f"evaluation.episodes={options.episodes}",
        f"out={folder}",
    ]
    path = os.pathsep.join([str(HERE), os.environ.get("PYTHONPATH", "")])
    env = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": path}
    command = [sys.executable, "-m", "saferl", *settings, *options.set]
    done = subprocess.run(command, env=env, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\n{done.stderr[-2000:]}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--algos", nargs="+", default=["cpo", "ppo_lag", "sac_lag", "sac_pid"])
    parser.add_argument("--problems", nargs="+", default=list(PROBLEMS), choices=list(PROBLEMS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--frames", type=int, default=200_000)
    parser.add_argument("--episodes", type=int, default=2000, help="of the closing test")
    parser.add_argument("--jobs", type=int, default=2, help="runs at once")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="of all runs")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    runs = {
        (problem, algo, seed): (options.out / f"{algo}-{problem}-seed{seed}").absolute()
        for problem in options.problems
        for algo in options.algos
        for seed in options.seeds
    }
    with ThreadPoolExecutor(options.jobs) as pool:
        list(
            pool.map(
                lambda run: train(run[1], run[0][1], run[0][0], run[0][2], options), runs.items()
            )
        )

    figures: dict[str, dict] = {}
    print("| | seed | cost | limit | return | best |\n|---|---|---|---|---|---|")
    for (problem, algo, seed), folder in runs.items():
        found = json.loads((folder / "evaluation/metrics.json").read_text())
        cost, gain = found["cost_return"], found["return"]
        figures[f"{algo} {problem} {seed}"] = {"cost": cost["mean"], "return": gain["mean"]}
        cells = [f"{v['mean']:.2f} {span(v['low'], v['high'], '.2f')}" for v in (cost, gain)]
        limit, best = PROBLEMS[problem].limit, PROBLEMS[problem].best
        print(f"| {algo}, {problem} | {seed} | {cells[0]} | {limit:g} | {cells[1]} | {best:.2f} |")
    write(options.json, figures)


if __name__ == "__main__":
    main()
