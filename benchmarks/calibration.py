"""Is a trained cost critic right? Its values against the discounted costs that followed.

    python benchmarks/calibration.py RUN [RUN ...] [--episodes 200] [--frequency 5] [--json PATH]

Plays test episodes on the batched road with each run's mean action and without its projector, and
compares Q_c(s, a) of every decision with the discounted sum of the costs from there to the end of
the episode. Prints both means, how often each exceeds the run's cost limit, and their correlation.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

import hydra
import torch

from saferl.algorithms.assemble import load_agent
from saferl.checkpoint.run import run_config
from saferl.envs.intersection import BatchedIntersection
from saferl.envs.seeding import episode_seeds
from saferl.evaluation.play import play


@torch.no_grad()
def calibrate(run: Path, episodes: int, frequency: int) -> dict[str, float]:
    cfg = run_config(run)
    cfg.device = "cpu"
    agent = load_agent(cfg, run, "checkpoint")
    if not hasattr(agent.loss, "cost_value"):
        raise SystemExit(f"{run}: algo={cfg.algo_name} has no cost critic.")
    task = hydra.utils.instantiate(cfg.task).as_test()
    env = BatchedIntersection(
        dataclasses.replace(task, policy_frequency=frequency), episodes, seed=0
    )
    steps = play(agent.actor, env, episode_seeds(cfg.seed, episodes))
    alive = torch.stack([step["alive"] for step in steps])
    cost = torch.stack([step["next", "cost"].squeeze(-1) for step in steps]) * alive
    value = torch.stack([agent.loss.cost_value(step)["state_action_cost_value"] for step in steps])
    after, returns = torch.zeros(episodes), torch.zeros_like(cost)
    for t in reversed(range(len(steps))):
        returns[t] = after = cost[t] + cfg.gamma * after
    q, g = value.squeeze(-1)[alive], returns[alive]
    return {
        "decisions": len(q),
        "mean_value": q.mean().item(),
        "mean_return": g.mean().item(),
        "value_above_limit": (q > cfg.risk_limit).float().mean().item(),
        "return_above_limit": (g > cfg.risk_limit).float().mean().item(),
        "correlation": torch.corrcoef(torch.stack([q, g]))[0, 1].item(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--frequency", type=int, default=5, help="decisions per second")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    torch.set_num_threads(1)
    results = {}
    for run in options.runs:
        figures = results[run.name] = calibrate(run, options.episodes, options.frequency)
        print(run.name, "  ".join(f"{key} {value:.3f}" for key, value in figures.items()))
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
