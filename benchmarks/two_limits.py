"""Two constraints at once, on the cart whose optimum under both is known.

    python benchmarks/two_limits.py OUT [--algos sac_lag ppo_lag] [--seeds 0 1 2 3 4] [--jobs 1] [--set KEY=VALUE ...]
        [--json PATH]

``task=cart task.costs=[effort,motion] cost_limit=[0.25,0.5]``: without motion's limit the best policy moves 0.61, without
effort's it steers more than the box allows. Prints for each run the costs of an episode of 2,000 and the discounted return
of the mean action, beside both limits and the best return under them (Riccati, two multipliers). What is in OUT already is
not run again.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from side_by_side import write
from tensordict import TensorDictBase

from saferl.algorithms.policy import load_policy
from saferl.envs import Cart, CartEnv
from saferl.envs.seeding import episode_seeds
from saferl.evaluation.play import play

CART = Cart(costs=("effort", "motion"))
LIMITS, GAMMA, HORIZON, FOREVER = (0.25, 0.5), 0.9, 20, 80
#: What each needs beside the limits.
SETTINGS = {
    "sac_lag": ("frames=200000",),
    "ppo_lag": ("learning.epochs=5", "loss.entropy_bonus=false", "frames=800000"),
}
PROBLEM = (
    "experiment=cart", f"task.costs=[{','.join(CART.costs)}]", f"cost_limit={[*LIMITS]}".replace(" ", ""),
    "logger=none", "threads=1", "compile=true",
)  # fmt: skip


def linear(gain: Any) -> Callable[[TensorDictBase], TensorDictBase]:
    """The policy u = -gain x, within the box."""
    gain = torch.as_tensor(gain, dtype=torch.float32)
    return lambda td: td.set("action", -(td["observation"] @ gain)[:, None].clamp(-1, 1))


def sums(policy: Any, steps: int, gamma: float) -> tuple[float, list[float]]:
    """Mean discounted reward and costs of a policy's mean actions in 2,000 episodes."""
    env = CartEnv(dataclasses.replace(CART, horizon=steps), num_envs=2000, seed=0)
    played = play(policy, env, episode_seeds(1, 2000))
    weight = gamma ** torch.arange(len(played), dtype=torch.float64)
    reward, cost = (
        torch.stack([step["next", key].mean(0) for step in played]).double()
        for key in ("reward", "cost")
    )
    return float(weight @ reward), (weight @ cost).tolist()


def measured(policy: Any) -> tuple[float, list[float]]:
    """The discounted return of a policy, which is what it learns, and the costs of an episode."""
    return sums(policy, FOREVER, GAMMA)[0], sums(policy, HORIZON, 1.0)[1]


def best() -> tuple[float, list[float]]:
    """Likewise of the best policy under both limits."""
    return measured(linear(CART.optimum(LIMITS, GAMMA, 1.0, HORIZON)))


def train(folder: Path, algo: str, seed: int, options: argparse.Namespace) -> None:
    if (folder / "evaluation/metrics.json").exists():
        return
    settings = [*PROBLEM, f"algo={algo}", f"seed={seed}", *SETTINGS[algo], f"out={folder}"]
    command = [sys.executable, "-m", "saferl", *settings, *options.set]
    env = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=env, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\n{done.stderr[-2000:]}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--algos", nargs="+", default=list(SETTINGS), choices=list(SETTINGS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--jobs", type=int, default=1, help="runs at once")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="of all runs")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    runs = {
        (algo, seed): (options.out / f"{algo}-seed{seed}").absolute()
        for algo in options.algos
        for seed in options.seeds
    }
    with ThreadPoolExecutor(options.jobs) as pool:
        list(pool.map(lambda run: train(run[1], *run[0], options), runs.items()))

    figures: dict[str, dict] = {}
    print("| | seed | effort | motion | return |\n|---|---|---|---|---|")
    rows = {("limits, best", "-"): best()}
    rows |= {run: measured(load_policy(folder)) for run, folder in runs.items()}
    for (name, seed), (gain, costs) in rows.items():
        figures[f"{name} {seed}"] = {"return": gain, **dict(zip(CART.costs, costs, strict=True))}
        print(f"| {name} | {seed} | {' | '.join(f'{cost:.3f}' for cost in costs)} | {gain:.4f} |")
    write(options.json, figures)


if __name__ == "__main__":
    main()
