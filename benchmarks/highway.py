"""Decisions per second: highway-env's stock intersection against ours, side by side.

    python benchmarks/highway.py [--rounds 5] [--seconds 4] [--clock wall] [--json PATH]

Both run 10 vehicles at 15 Hz with 5 decisions per second and random continuous actions; resets
count. The rounds alternate, so that a changing machine load meets both alike. Prints the median of
each and their ratio. On a machine that is busy with other work ``--clock cpu`` counts this
process's own time; both sides run on one thread.
"""

from __future__ import annotations

from collections.abc import Callable

import gymnasium
import highway_env  # noqa: F401  (registers intersection-v1)
import torch
from side_by_side import alternate, conditions, medians, parser, write

from saferl.envs.intersection.highway import IntersectionEnv


def stock() -> gymnasium.Env:
    config = {"simulation_frequency": 15, "policy_frequency": 5, "initial_vehicle_count": 10}
    return gymnasium.make("intersection-v1", config=config)


def deciding(env: gymnasium.Env) -> Callable[[], int]:
    """Makes one decision at each call, and resets where an episode ends."""
    env.action_space.seed(0)
    env.reset(seed=0)

    def decide() -> int:
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
        return 1

    return decide


def main() -> None:
    options = parser(__doc__, seconds=4.0).parse_args()
    torch.set_num_threads(options.threads)
    ours = IntersectionEnv(task="mixed", vehicles=10, policy_frequency=5)
    rates = alternate({"stock": deciding(stock()), "ours": deciding(ours)}, options)
    speed = medians(rates)
    ratio = speed["ours"] / speed["stock"]
    print(conditions(options))
    print(
        f"median: stock {speed['stock']:.1f}, ours {speed['ours']:.1f} decisions/s, "
        f"ratio {ratio:.2f}"
    )
    write(options.json, {**speed, "ratio": ratio, "rounds": rates})


if __name__ == "__main__":
    main()
