"""How often can an episode be driven at all? What an oracle that knows the others' plans would reach.

    python benchmarks/oracle.py [--episodes 500] [--seed 0] [--json PATH]

Plays the test episodes (10 Hz) with open-loop plans, one after the other, until one of them arrives: drive along the
lane at a steady speed, or halt before the box for so many seconds and then drive. The others react to the ego as
always. An episode that no plan solves may still be solvable by steering or by a change of speed in the box, so the
rate is a lower bound of the oracle's; a policy, which does not know what others are about to do, cannot choose by
hindsight. Also says how many plans solve an episode (a look at the first 100 of each task): few, where the gap is narrow.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import torch
from side_by_side import write
from torch import Tensor

from saferl.envs.intersection import BatchedIntersection, Scenario
from saferl.envs.intersection.drivers import Driver
from saferl.envs.intersection.yielding import STOP
from saferl.envs.seeding import episode_seeds
from saferl.evaluation.play import play
from saferl.evaluation.rows import episode_rows

SPEEDS = (8.0, 12.0, 5.0, 3.0)  # m/s
WAITS = (2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0, 16.0, 18.0)  # s from the start
BRAKE = 3.0  # m/s^2
PLANS = [*((speed, 0.0) for speed in SPEEDS), *itertools.product(SPEEDS[:2], WAITS)]


class Plan(Driver):
    """Drives at ``speed`` m/s, but halts before the box until the episode is ``wait`` seconds old."""

    def __init__(self, speed: float, wait: float, policy_frequency: int):
        super().__init__(speed)
        self.decisions = round(wait * policy_frequency)

    def target_speed(self, ego: Tensor, vehicles: Tensor, line: Tensor, s: Tensor) -> Tensor:
        free = self.bend_speed(line, s)
        self.decisions -= 1
        if self.decisions < 0:
            return free
        halting = torch.sqrt(2 * BRAKE * (STOP - s).clamp_min(0.0))
        return torch.minimum(free, halting)


def arrives(scenario: Scenario, seeds: Tensor, plan: tuple[float, float]) -> Tensor:
    """Which of the episodes a plan solves [B]."""
    env = BatchedIntersection(scenario, len(seeds), 0)
    rows = episode_rows(play(Plan(*plan, scenario.policy_frequency), env, seeds), seeds, scenario)
    return torch.tensor([bool(row["success"]) for row in rows])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=500, help="of each task")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    torch.set_num_threads(1)
    figures: dict = {}
    print(f"{len(PLANS)} plans, {options.episodes} episodes of each task, seed {options.seed}\n")
    print(
        "| | the first plan % | any plan % | plans that solve an episode, quartiles |\n|---|---|---|---|"
    )
    for task in ("lt", "gs", "rt"):
        scenario = Scenario(task=task).as_test()
        seeds = episode_seeds(options.seed, options.episodes)
        solved = first = arrives(scenario, seeds, PLANS[0])
        for plan in PLANS[1:]:
            left = (~solved).nonzero().squeeze(-1)
            if len(left):
                solved = solved.index_put((left,), arrives(scenario, seeds[left], plan))
        looked = seeds[:100]
        counts = sum(arrives(scenario, looked, plan).double() for plan in PLANS)
        quartiles = counts.quantile(torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64))
        figures[task] = {
            "first": first.double().mean().item(),
            "any": solved.double().mean().item(),
            "plans": quartiles.tolist(),
            "unsolved": seeds[~solved].tolist(),
        }
        row = figures[task]
        plans = " / ".join(f"{count:.0f}" for count in row["plans"])
        print(
            f"| {task} | {100 * row['first']:.1f} | {100 * row['any']:.1f} | {plans} |", flush=True
        )
    mean = sum(row["any"] for row in figures.values()) / len(figures)
    print(f"\nmean of the tasks: {100 * mean:.1f}%")
    write(options.json, figures)


if __name__ == "__main__":
    main()
