"""The on-policy algorithms on the cart, whose best policy is known.

    python benchmarks/cart.py OUT [--algos ppo_pid p3o focops crpo ppo_saute cat] [--seeds 0 1 2 3 4] [--jobs 2]
        [--set KEY=VALUE ...] [--json PATH]

Prints a row for each run: of 2,000 episodes of the policy's mean action the mean cost of 20 decisions, the return
(discounted by 0.9, of an episode that goes on), how far it is below the best, and what is beyond the limit. What is
best depends on what is promised:

- a mean cost of 0.2 an episode: the best linear policy (Riccati);
- a cost of 0.2 in each episode (``ppo_saute``): the best linear policy of each start, which may cost 0.2 in the mean from there;
- a cost of 0.04 in each step (``cat``): the best linear policy whose force is cut off at 0.2. The share is of steps.

What is in OUT already is not run again.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize
from side_by_side import write
from torchrl.envs import Compose, Transform, TransformedEnv

from saferl.algorithms.policy import trained_agent
from saferl.checkpoint.run import run_config
from saferl.envs import Cart, CartEnv
from saferl.envs.cart import _A, _B, _Q
from saferl.envs.seeding import episode_seeds
from saferl.evaluation.play import play

LIMIT, STEP_LIMIT, GAMMA, HORIZON, FOREVER, EPISODES = 0.2, 0.04, 0.9, 20, 80, 2000

_PLAIN = ("learning.epochs=5", "loss.entropy_bonus=false")
_FAST = (
    *("learning.epochs=10", "loss.entropy_bonus=false"),
    *("learning.lr.actor=[1e-3,1e-4]", "learning.lr.critic=[3e-3,3e-4]", "frames=200000"),
)
#: What each needs beside the limit, which is on the mean cost of an episode but of the last two.
SETTINGS = {
    "sac_lag": (),
    "sac_pid": (),
    "cpo": ("loss.damping=0.01", "learning.rollout_frames=2560", "frames=800000"),
    "ppo_lag": (*_PLAIN, "frames=800000"),
    "ppo_pid": _PLAIN,
    "p3o": _PLAIN,
    "focops": _PLAIN,
    "crpo": _PLAIN,
    "ppo_saute": (*_FAST, "transform.penalty=0.5", "learning.initial_std=0.3"),
    "cat": (*_FAST, f"loss.step_limit={STEP_LIMIT}", "loss.bonus=1"),
}

FAMILY = ["ppo_pid", "p3o", "focops", "crpo", "ppo_saute", "cat"]


class Measured(NamedTuple):
    """Mean cost of an episode, mean discounted return, shares of episodes and of steps that cost more than they may."""

    cost: float
    gain: float
    episodes: float
    steps: float


def measure(policy: Callable, transforms: Sequence[Transform] = ()) -> Measured:
    """What a policy's mean actions cost and earn."""
    env = CartEnv(dataclasses.replace(Cart(), horizon=FOREVER), EPISODES, seed=0)
    several = TransformedEnv(env, Compose(*transforms)) if transforms else env
    steps = play(policy, several, episode_seeds(1, EPISODES))  # pyright: ignore
    reward, cost = (
        torch.stack([step["next", key].squeeze(-1) for step in steps]).double()
        for key in ("reward", "cost")
    )
    weight, cost = GAMMA ** torch.arange(FOREVER, dtype=torch.float64), cost[:HORIZON]
    beyond = (cost.sum(0) > LIMIT).double().mean(), (cost > STEP_LIMIT).double().mean()
    return Measured(float(cost.sum(0).mean()), float(weight @ reward.mean(1)), *map(float, beyond))


def in_the_mean() -> float:
    """The best return under the limit on the mean cost."""
    cart = Cart()
    return cart.sums(cart.optimum(LIMIT, GAMMA, 1.0, HORIZON), GAMMA)[0]


def in_each_episode(side: int = 60) -> float:
    """The same under the limit on the cost from each start: no policy that keeps it in every episode has more."""
    cart = Cart()
    x, y = cart.spread * (2 * np.indices((side, side)).reshape(2, -1) + 1 - side) / side
    parts = np.stack([np.ones_like(x), x * x, y * y, 2 * x * y])  # sums are affine in the moments
    basis = [np.zeros((2, 2)), np.diag([1, 0]), np.diag([0, 1]), np.array([[0, 0.5], [0.5, 0]])]

    def of_starts(gain: np.ndarray, kind: int, *horizon: float) -> np.ndarray:
        gamma = 1.0 if horizon else GAMMA
        first, *others = (cart.sums(gain, gamma, *horizon, moment=m)[kind] for m in basis)
        return np.array([first, *(other - first for other in others)]) @ parts

    gains = [cart.gain(multiplier, GAMMA) for multiplier in np.geomspace(1e-4, 1e3, 100)]
    kept = np.stack([of_starts(gain, 1, HORIZON) for gain in gains]) <= LIMIT
    best = np.stack([of_starts(gain, 0) for gain in gains])
    return float(best[kept.argmax(0), np.arange(len(x))].mean())


def in_each_step() -> float:
    """The return of the best linear policy whose force is cut off where a step costs more than it may."""
    cart, draw = Cart(), np.random.default_rng(0)
    begin = draw.uniform(-cart.spread, cart.spread, (EPISODES, 2))
    shocks = draw.uniform(-cart.noise, cart.noise, (FOREVER, EPISODES))
    most = STEP_LIMIT**0.5

    def lost(gain: np.ndarray) -> float:
        state, total = begin.copy(), 0.0
        for step in range(FOREVER):
            total += GAMMA**step * np.einsum("bi,ij,bj->b", state, _Q, state).mean()
            force = np.clip(-state @ gain, -most, most)[:, None]
            state = state @ _A.T + force @ _B.T
            state[:, 1] += shocks[step]
        return float(total)

    return -minimize(lost, np.array([0.3, 0.4]), method="Nelder-Mead").fun


#: By algorithm; the others bound the mean.
BEST = {"ppo_saute": in_each_episode, "cat": in_each_step}


def train(folder: Path, algo: str, seed: int, further: Sequence[str] = ()) -> Measured:
    """Train, unless the run is there already, and measure."""
    if not (folder / "evaluation/metrics.json").exists():
        settings = ["experiment=cart", f"algo={algo}", f"seed={seed}", *SETTINGS[algo]]
        settings += ["threads=1", "logger=none", "device=cpu", f"out={folder}", *further]
        env = os.environ | {"OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-m", "saferl", *settings]
        done = subprocess.run(command, env=env, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{' '.join(command)}\n{done.stderr[-2000:]}")
    agent = trained_agent(run_config(folder), folder)
    return measure(agent.actor, agent.transforms)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--algos", nargs="+", default=FAMILY, choices=list(SETTINGS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--jobs", type=int, default=2, help="runs at once")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="of all runs")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    runs = [(algo, seed) for algo in options.algos for seed in options.seeds]
    with ThreadPoolExecutor(options.jobs) as pool:
        found = pool.map(
            lambda run: train(
                (options.out / f"{run[0]}-seed{run[1]}").absolute(), *run, options.set
            ),
            runs,
        )
        figures = dict(zip(runs, found, strict=True))
    best = {algo: BEST.get(algo, in_the_mean)() for algo in options.algos}
    print(f"| | seed | cost (limit {LIMIT}) | return | best | below it | beyond the limit |")
    print("|---|---|---|---|---|---|---|")
    for (algo, seed), each in figures.items():
        below = 100 * (best[algo] - each.gain) / abs(best[algo])
        share = 100 * (each.steps if algo == "cat" else each.episodes)
        print(
            f"| `{algo}` | {seed} | {each.cost:.3f} | {each.gain:.3f} | {best[algo]:.3f} | {below:.1f}% | {share:.1f}% |"
        )
    write(options.json, {f"{a} {s}": each._asdict() for (a, s), each in figures.items()})


if __name__ == "__main__":
    main()
