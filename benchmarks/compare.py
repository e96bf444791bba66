"""Two tests of the same episodes side by side: rates, and their differences with 95% intervals.

    python benchmarks/compare.py TEST_A TEST_B [--json PATH]

TEST_A and TEST_B are folders that ``python -m saferl.evaluate out=...`` wrote with the same task, seed
and number of episodes. The differences are means over the pairs of episodes with one seed (A minus B),
with Student's interval.
"""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path

from saferl.evaluation.statistics import mean_interval, span

#: What two tests must have alike; their backends and their number of vehicle rows may differ.
ALIKE = ("task", "scenario", "traffic", "vehicles", "reading", "policy_frequency", "seed")
FIGURES = ("success", "hit_vehicle", "left_road", "frozen", "speed", "cost_return")


def read(folder: Path) -> dict[str, dict[str, str]]:
    with (folder / "episodes.csv").open(newline="") as file:
        return {row["seed"]: row for row in csv.DictReader(file)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("a", type=Path, metavar="TEST_A")
    parser.add_argument("b", type=Path, metavar="TEST_B")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    about = [json.loads((path / "metrics.json").read_text()) for path in (options.a, options.b)]
    differing = [
        f"{key} {about[0].get(key)} and {about[1].get(key)}"
        for key in ALIKE
        if about[0].get(key) != about[1].get(key)
    ]
    if differing:
        raise SystemExit(f"These tests are not of the same task: {', '.join(differing)}.")
    a, b = read(options.a), read(options.b)
    if a.keys() != b.keys():
        raise SystemExit(f"{options.a} and {options.b} are tests of different episodes.")
    result = {}
    print(f"{len(a)} episodes  {'A':>8s}{'B':>10s}{'A - B':>12s}  95% interval")
    for name in FIGURES:
        pairs = [(float(a[seed][name]), float(b[seed][name])) for seed in a]
        means = [sum(values) / len(pairs) for values in zip(*pairs, strict=True)]
        low, high = mean_interval([first - second for first, second in pairs])
        result[name] = {"a": means[0], "b": means[1], "low": low, "high": high}
        print(
            f"{name:13s}{means[0]:10.3f}{means[1]:10.3f}{means[0] - means[1]:+12.3f}"
            f"  {span(low, high, '+.3f')}"
        )
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
