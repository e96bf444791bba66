"""Which choices learning needs: one undone at a time, a feature of the observation or a setting.

    python benchmarks/choices.py OUT [--algo sac] [--undo targets standstill ...] [--frames 200000] [--seeds 0 1 2]
        [--episodes 500] [--jobs 2] [--set KEY=VALUE ...] [--json PATH]

What can be undone stands in ``CHOICES``, as far as ``--algo`` has it (SAC no multiplier). A feature is left out by dividing it by 1e9 in every network; sizes, initial weights and all
else stay. Trains on ``task=mixed`` at equal frames and updates, tests 500 episodes each of left, straight and right at
10 Hz, and prints the mean over the seeds, its 95% interval over them (Student's t), and on how many seeds a choice was missed.
What is in OUT already is not run again.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from side_by_side import write
from time_to_safe import ENDS, Work, carry_out, tests, train

from saferl.envs.intersection.observation import FORMS
from saferl.evaluation.statistics import mean_interval, span, within

BLANK = 1e9


def without(*names: str) -> tuple[str, ...]:
    """What leaves these features of a vehicle out of all networks."""
    features = FORMS["route"].vehicle.items()
    row = [BLANK if name in names else feature.scale for name, feature in features]
    return (f"+encoder.vehicle_scale={row}".replace(" ", ""),)


#: How each is undone.
CHOICES: dict[str, tuple[str, ...]] = {
    "conflict": without("conflict_s", "conflict_t", "lead"),
    "closest": without("closest", "closest_t"),
    "targets": ("learning.tau=0.005",),
    "exploration": ("learning.exploration=0",),
    "standstill": ("task.standstill=null",),
    "starts": ("task.route_starts=0",),
    "width": ("encoder.width=64",),
    "crash": ("task.cost.crash=0",),
    "multiplier": ("lagrange.multiplier.lr=0.002",),
    "worst": ("risk=mean",),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--algo", default="sac")
    parser.add_argument("--undo", nargs="*", default=["conflict", "closest"], choices=list(CHOICES))
    parser.add_argument("--frames", type=int, default=200000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--episodes", type=int, default=500, help="of each task")
    parser.add_argument("--jobs", type=int, default=2, help="runs at once")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="of all runs")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    undone = {"nothing": ()} | {name: CHOICES[name] for name in options.undo}
    folders = {
        (name, seed): options.out / options.algo / name / f"seed{seed}"
        for seed in options.seeds
        for name in undone
    }
    work: Work = {}
    for (name, seed), folder in folders.items():
        budget = [f"algo={options.algo}", f"frames={options.frames}", f"seed={seed}"]
        overrides = ["task=mixed", *budget, *undone[name], *options.set]
        settings = {"overrides": overrides, "minutes": math.inf, "every": math.inf}
        work[folder] = train, {**settings, "episodes": options.episodes}
    carry_out(work, options.jobs)

    figures: dict[str, dict[str, list[float]]] = {}
    seeds = len(options.seeds)
    print(
        f"{options.algo}, {options.frames} frames, seeds {options.seeds}, mean and 95% interval over them\n"
    )
    print(
        "| undone | success % | crashes % | frozen % | seeds that missed it |\n|---|---|---|---|---|"
    )
    for name in undone:
        ends = [tests(folders[name, seed])[-1] for seed in options.seeds]
        rates = figures[name] = {f"{end}_rate": [row[end] for row in ends] for end in ENDS}
        cells = []
        for rate, values in rates.items():
            low, high = within(rate, mean_interval(values), values)
            cells.append(f"{100 * np.mean(values):.1f} {span(low, high, '.1f', 100)}")
        whole = figures["nothing"]["success_rate"]
        missed = sum(one < all_ for one, all_ in zip(rates["success_rate"], whole, strict=True))
        print(f"| {name} | {' | '.join(cells)} | {missed} of {seeds} |")
    write(options.json, figures)


if __name__ == "__main__":
    main()
