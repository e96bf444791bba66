"""What new data for each update is worth: success against time for several ``updates_per_frame``.

    python benchmarks/updates_per_frame.py OUT [--values 0.25 0.03125 0.00390625] [--seeds 0 1]
        [--minutes 10] [--algo sac] [--task mixed] [--set KEY=VALUE ...] [--figure PATH]
        [--json PATH]

Trains from nothing, one run after the other in OUT, each with as many frames as fit in the minutes: the
first run of a value is preceded by a short one that measures its frames a second. Nothing is compiled, which
would take a share of the minutes that has nothing to do with the value. What is in OUT already is not run
again. Prints for each run the minutes that it took, frames, updates, and the closing test's success rate with its
95% interval, and draws the success rate of the training episodes against the minutes.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from matplotlib import pyplot as plt
from side_by_side import belongs, write

from saferl.training.records import CsvLog

#: Of the short run: frames before the first update, and updates.
WARMUP, UPDATES = 2000, 600
TEST = ("evaluation.episodes=500", "evaluation.num_envs=100")

PHASES = ("collect", "learn", "other")


def seconds(row: dict[str, float]) -> float:
    return sum(row[phase] for phase in PHASES)


def train(out: Path, frames: int, overrides: list[str]) -> None:
    if (out / "evaluation" / "metrics.json").exists():
        return
    settings = ["episodes=null", f"frames={frames}", f"record_every={max(frames // 40, 1)}"]
    settings += ["logger=none", "save_minutes=null", f"save_every={frames}", f"out={out}"]
    if (out / "checkpoints").exists():
        overrides, settings = [], [f"resume={out}"]
    subprocess.run([sys.executable, "-m", "saferl", *overrides, *settings], check=True)


def frames_in(run: Path, minutes: float) -> int:
    """How many frames fit, by the last half of a short run."""
    timing = CsvLog(run / "timing.csv").read()
    first, last = timing[len(timing) // 2], timing[-1]
    speed = (last["frames"] - first["frames"]) / (seconds(last) - seconds(first))
    return int(60 * minutes * speed)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--values", type=float, nargs="+", default=[0.25, 0.03125, 0.00390625])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--algo", default="sac")
    parser.add_argument("--task", default="mixed")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    parser.add_argument("--figure", type=Path, help="draw the curves here")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()

    belongs(options.out, {key: getattr(options, key) for key in ("algo", "task", "minutes", "set")})
    figures: dict = {}
    axes = plt.figure(figsize=(6, 4)).gca()
    print(
        f"{'updates/frame':>14s}{'seed':>6s}{'minutes':>9s}{'frames':>10s}{'updates':>9s}  success"
    )
    for number, value in enumerate(options.values):
        # By default the long runs alone would compile, which the short one says nothing about.
        common = [f"algo={options.algo}", f"task={options.task}", "compile=false"]
        common += [f"learning.updates_per_frame={value}", *options.set]
        trial = options.out / f"trial_{value}"
        train(trial, WARMUP + int(UPDATES / value), [*common, "evaluation.episodes=1"])
        frames = frames_in(trial, options.minutes)
        for seed in options.seeds:
            run = options.out / f"{value}_{seed}"
            train(run, frames, [*common, f"seed={seed}", *TEST])
            curve = CsvLog(run / "metrics.csv").read()
            minutes = [seconds(row) / 60 for row in CsvLog(run / "timing.csv").read()]
            label = f"{value:.3g}" if seed == options.seeds[0] else None
            success = [100 * row["success_rate"] for row in curve]
            axes.plot(minutes, success, color=f"C{number}", label=label)
            test = json.loads((run / "evaluation" / "metrics.json").read_text())
            last, rate = curve[-1], test["success_rate"]
            print(
                f"{value:14g}{seed:6d}{minutes[-1]:9.1f}{last['frames']:10.0f}{last['updates']:9.0f}"
                f"  {rate['mean']:.1%} [{rate['low']:.1%}, {rate['high']:.1%}]",
                flush=True,
            )
            figures[f"{value}_{seed}"] = {"minutes": minutes, "success": success, "test": test}
    axes.set(xlabel="minutes of collecting and learning", ylabel="training episodes that arrive, %")
    axes.set_ylim(0, 100)
    axes.legend(
        title="updates a frame", loc="lower center", bbox_to_anchor=(0.5, 1), ncols=9, frameon=False
    )
    axes.grid(alpha=0.3)
    write(options.json, figures)
    if options.figure:
        axes.figure.savefig(options.figure, dpi=150, bbox_inches="tight")


if __name__ == "__main__":
    main()
