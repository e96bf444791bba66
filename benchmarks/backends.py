"""Is driving on the batched road the same task as driving on highway-env?

    python benchmarks/backends.py [RUN ...] [--episodes 500] [--tasks lt gs rt]
        [--drivers cautious blind random] [--json PATH]

Plays the same test episodes (10 Hz) on both backends with each scripted driver and each trained RUN,
and prints collision, success and frozen rates with Wilson's 95% intervals. A comparison fails where
the rate on highway-env lies outside the interval of the rate on the batched road. Then, for each RUN,
what its success rate loses from one backend to the other over all tasks together, with Newcombe's 95%
interval, which takes the two samples for independent.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import hydra
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.transforms import Transform

from saferl.algorithms.policy import trained_agent
from saferl.checkpoint.run import run_config
from saferl.envs.intersection import BatchedIntersection, HighwayIntersection, Scenario
from saferl.envs.intersection.drivers import CautiousDriver, Driver, RandomDriver
from saferl.evaluation.play import envs_at_once, evaluate
from saferl.evaluation.statistics import wilson

DRIVERS = {"cautious": CautiousDriver, "blind": Driver, "random": RandomDriver}
BACKENDS = {"batched": (BatchedIntersection, 100), "highway": (HighwayIntersection, 10)}
RATES = ("collision", "success", "frozen")


def rows_of(
    policy: TensorDictModuleBase,
    transforms: list[Transform],
    scenario: Scenario,
    backend: str,
    episodes: int,
) -> list[dict]:
    kind, most = BACKENDS[backend]
    env = kind(scenario, envs_at_once(episodes, most))
    if transforms:
        env = TransformedEnv(env, Compose(*transforms))
    rows = evaluate(policy, env, episodes, seed=0, progress=False)
    for transform in transforms:  # the next environment's
        transform.reset_parent()
    return rows


def counts(rows: list[dict]) -> dict[str, int]:
    return {rate: sum(row[rate] for row in rows) for rate in RATES}


def newcombe(a: int, b: int, trials: int) -> tuple[float, float]:
    """95% interval of a / trials - b / trials (Newcombe 1998, method 10)."""
    (low_a, high_a), (low_b, high_b) = wilson(a, trials), wilson(b, trials)
    p, q = a / trials, b / trials
    below = math.hypot(p - low_a, high_b - q)
    above = math.hypot(high_a - p, q - low_b)
    return p - q - below, p - q + above


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="*", metavar="RUN")
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument(
        "--tasks", nargs="+", choices=("lt", "gs", "rt"), default=["lt", "gs", "rt"]
    )
    parser.add_argument("--drivers", nargs="*", choices=list(DRIVERS), default=list(DRIVERS))
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    torch.set_num_threads(1)

    policies: dict[str, tuple[TensorDictModuleBase, list[Transform], dict[str, Any]]] = {
        name: (DRIVERS[name](), [], {}) for name in options.drivers
    }
    for run in options.runs:
        cfg = run_config(run)
        cfg.device = "cpu"
        scenario = hydra.utils.instantiate(cfg.task)
        agent = trained_agent(cfg, run)
        policies[run.name] = (agent.actor, agent.transforms, {"rows": scenario.rows})

    result: dict[str, Any] = {"episodes": options.episodes, "rates": {}, "transfer": {}}
    failed, compared, same, played = 0, 0, 0, 0
    n = options.episodes
    print(
        f"{n} episodes each{'':4s}"
        + "".join(f"{rate + ' % (batched / highway)':>36s}" for rate in RATES)
    )
    for name, (policy, transforms, settings) in policies.items():
        total = dict.fromkeys(BACKENDS, 0)
        for task in options.tasks:
            scenario = Scenario(task=task, **settings).as_test()
            rows = {b: rows_of(policy, transforms, scenario, b, n) for b in BACKENDS}
            same += sum(
                all(a[rate] == b[rate] for rate in RATES)
                for a, b in zip(rows["batched"], rows["highway"], strict=True)
            )
            played += n
            ours, theirs = counts(rows["batched"]), counts(rows["highway"])
            result["rates"][f"{name} {task}"] = {"batched": ours, "highway": theirs}
            line = f"{name + ' ' + task:20s}"
            for rate in RATES:
                low, high = wilson(ours[rate], n)
                inside = low <= theirs[rate] / n <= high
                compared, failed = compared + 1, failed + (not inside)
                text = f"{ours[rate] / n:.1%} [{low:.1%}, {high:.1%}] / {theirs[rate] / n:.1%}"
                line += f"{text + ('' if inside else ' !'):>36s}"
            print(line, flush=True)
            for backend in BACKENDS:
                total[backend] += counts(rows[backend])["success"]
        if settings:
            trials = n * len(options.tasks)
            low, high = newcombe(total["highway"], total["batched"], trials)
            change = (total["highway"] - total["batched"]) / trials
            result["transfer"][name] = {"difference": change, "low": low, "high": high}
            print(
                f"{name}: success on highway-env minus batched, {trials} episodes: "
                f"{100 * change:+.1f} points [{100 * low:+.1f}, {100 * high:+.1f}]"
            )
    result |= {"compared": compared, "failed": failed, "same_outcome": same, "played": played}
    # Of independent samples of one rate, the second lies outside the first's interval in 16.6%.
    print(
        f"{failed} of {compared} comparisons fail (independent samples would fail in about "
        f"{0.166 * compared:.0f}); {same} of {played} episodes end alike on both."
    )
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
