"""Decisions per second with SUMO's drivers beside highway-env's road and the batched one, in one process.

    python benchmarks/worlds.py [--batches 1 16] [--rounds 5] [--seconds 3] [--json PATH]

Nominal traffic, 5 decisions per second, random actions, resets included; every environment is stepped by
``step_and_maybe_reset``. SUMO's simulations run in processes of their own, so that only the wall clock counts all of the
work. The rounds alternate, so that a changing load meets all alike. Prints medians and their ratios to highway-env's road.
"""

from __future__ import annotations

import torch
from side_by_side import alternate, conditions, medians, parser, write

from saferl.envs.intersection import (
    BatchedIntersection,
    HighwayIntersection,
    IntersectionBase,
    Scenario,
    SumoIntersection,
)


class Deciding:
    """Makes one decision in each environment at each call, at random."""

    def __init__(self, env: IntersectionBase):
        self.env, self.generator = env, torch.Generator().manual_seed(0)
        self.data = env.reset()

    def __call__(self) -> int:
        count = self.env.batch_size[0]
        self.data["action"] = 2 * torch.rand(count, 2, generator=self.generator) - 1
        _, self.data = self.env.step_and_maybe_reset(self.data)
        return count


def main() -> None:
    args = parser(__doc__)
    args.add_argument("--batches", type=int, nargs="+", default=[1, 16])
    options = args.parse_args()
    torch.set_num_threads(options.threads)
    scenario = Scenario(task="mixed")
    sides = {"highway": Deciding(HighwayIntersection(scenario, 1, seed=0))}
    for batch in options.batches:
        sides[f"sumo B={batch}"] = Deciding(SumoIntersection(scenario, batch, seed=0))
        sides[f"batched B={batch}"] = Deciding(BatchedIntersection(scenario, batch, seed=0))
    rates = alternate(dict(sides), options)
    speed = medians(rates)
    print(conditions(options))
    for name, value in speed.items():
        print(f"{name:14s} {value:10.1f} decisions/s {value / speed['highway']:8.2f} times highway")
    for side in sides.values():
        side.env.close()
    write(options.json, {**speed, "rounds": rates})


if __name__ == "__main__":
    main()
