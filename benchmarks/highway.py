"""Decisions per second: highway-env's stock intersection against ours, side by side.

    python benchmarks/highway.py [--rounds 5] [--seconds 4] [--clock wall] [--json PATH]

Both run 10 vehicles at 15 Hz with 5 decisions per second and random continuous actions; resets
count. The rounds alternate, so that a changing machine load meets both alike. Prints the median of
each and their ratio. On a machine that is busy with other work ``--clock cpu`` counts this
process's own time; both sides run on one thread.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path

import gymnasium
import highway_env  # noqa: F401  (registers intersection-v1)
import torch

from saferl.envs.intersection.highway import IntersectionEnv


def stock() -> gymnasium.Env:
    config = {"simulation_frequency": 15, "policy_frequency": 5, "initial_vehicle_count": 10}
    return gymnasium.make("intersection-v1", config=config)


def ours() -> gymnasium.Env:
    return IntersectionEnv(task="mixed", vehicles=10, policy_frequency=5)


CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}


def decisions_per_second(env: gymnasium.Env, seed: int, seconds: float, clock: str) -> float:
    now = CLOCKS[clock]
    env.action_space.seed(seed)
    env.reset(seed=seed)
    count, begin = 0, now()
    while (elapsed := now() - begin) < seconds:
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        count += 1
        if terminated or truncated:
            env.reset()
    return count / elapsed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=4.0, help="per environment and round")
    parser.add_argument("--clock", choices=list(CLOCKS), default="wall")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    torch.set_num_threads(1)

    envs = {"stock": stock(), "ours": ours()}
    speeds: dict[str, list[float]] = {name: [] for name in envs}
    for seed in range(options.rounds):
        for name, env in envs.items():
            speeds[name].append(decisions_per_second(env, seed, options.seconds, options.clock))
            print(f"round {seed + 1}: {name:5s} {speeds[name][-1]:7.1f} decisions/s", flush=True)
    result: dict = {name: statistics.median(values) for name, values in speeds.items()}
    result["ratio"] = result["ours"] / result["stock"]
    result |= {"clock": options.clock, "rounds": speeds}
    print(
        f"median: stock {result['stock']:.1f}, ours {result['ours']:.1f} decisions/s, "
        f"ratio {result['ratio']:.2f}"
    )
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
