"""Which features of the observation along the route learning needs: one group left out at a time.

    python benchmarks/features.py OUT [--algo sac] [--frames 200000] [--seeds 0 1 2] [--episodes 500] [--jobs 2]
        [--set KEY=VALUE ...] [--json PATH]

A group is left out by dividing it by 1e9 in every network; sizes, initial weights and all else stay. Trains on ``task=mixed`` at
equal frames and updates, tests 500 episodes each of left, straight and right at 10 Hz, and prints the mean over the
seeds, its 95% interval over them (Student's t), and on how many seeds a group was missed. What is in OUT already is not run again.
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
#: Whose features, and which.
GROUPS: dict[str, tuple[str, tuple[str, ...]]] = {
    "nothing": ("ego", ()),
    "the conflict": ("vehicle", ("conflict_s", "conflict_t", "lead")),
    "the closest approach": ("vehicle", ("closest", "closest_t")),
}


def without(kind: str, names: tuple[str, ...]) -> list[str]:
    """What leaves these features out of all networks."""
    features = getattr(FORMS["route"], kind).items()
    row = [BLANK if name in names else feature.scale for name, feature in features]
    setting = f"{kind}_scale={row}".replace(" ", "")
    return [f"+encoder.{setting}"]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--algo", default="sac")
    parser.add_argument("--frames", type=int, default=200000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--episodes", type=int, default=500, help="of each task")
    parser.add_argument("--jobs", type=int, default=2, help="runs at once")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="of all runs")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    folders = {
        (group, seed): options.out / group.replace(" ", "_") / f"seed{seed}"
        for seed in options.seeds
        for group in GROUPS
    }
    work: Work = {}
    for (group, seed), folder in folders.items():
        budget = [f"algo={options.algo}", f"frames={options.frames}", f"seed={seed}"]
        overrides = ["task=mixed", *budget, *without(*GROUPS[group]), *options.set]
        settings = {"overrides": overrides, "minutes": math.inf, "every": math.inf}
        work[folder] = train, {**settings, "episodes": options.episodes}
    carry_out(work, options.jobs)

    figures: dict[str, dict[str, list[float]]] = {}
    seeds = len(options.seeds)
    print(
        f"{options.algo}, {options.frames} frames, seeds {options.seeds}, mean and 95% interval over them\n"
    )
    print(
        "| left out | success % | crashes % | frozen % | seeds that missed it |\n|---|---|---|---|---|"
    )
    for group in GROUPS:
        ends = [tests(folders[group, seed])[-1] for seed in options.seeds]
        rates = figures[group] = {f"{end}_rate": [row[end] for row in ends] for end in ENDS}
        cells = []
        for name, values in rates.items():
            low, high = within(name, mean_interval(values), values)
            cells.append(f"{100 * np.mean(values):.1f} {span(low, high, '.1f', 100)}")
        whole = figures["nothing"]["success_rate"]
        missed = sum(one < all_ for one, all_ in zip(rates["success_rate"], whole, strict=True))
        print(f"| {group} | {' | '.join(cells)} | {missed} of {seeds} |")
    write(options.json, figures)


if __name__ == "__main__":
    main()
