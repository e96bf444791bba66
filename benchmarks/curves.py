"""Draw training curves of runs: success and collision rate over episodes.

python benchmarks/curves.py figure.png "SAC, all tasks=RUN" "ARSAC, left turn=RUN"
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("figure", type=Path)
    parser.add_argument("runs", nargs="+", metavar="LABEL=RUN")
    args = parser.parse_args()
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained", sharey=True)
    for item in args.runs:
        label, run = item.rsplit("=", 1)
        with (Path(run) / "metrics.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        for axis, key in zip(axes, ("success_rate", "collision_rate"), strict=True):
            axis.plot(
                [int(row["episodes"]) for row in rows],
                [100 * float(row[key]) for row in rows],
                label=label,
            )
    for axis, title in zip(axes, ("success", "collision or off the road"), strict=True):
        axis.set(title=title, xlabel="training episodes", ylim=(-2, 102))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("% of the last 200 episodes")
    axes[0].legend(fontsize=8)
    figure.savefig(args.figure, dpi=110)


if __name__ == "__main__":
    main()
