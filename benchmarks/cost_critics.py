"""What the cost critics of a fixed policy come to, by the target that they learn from.

    python benchmarks/cost_critics.py RUN [--targets mean max] [--updates 8000] [--width 64] [--seed 0]
        [--json PATH]

Drives RUN's policy with its noise on 128 environments for 400 decisions, trains fresh cost critics on
the transitions of 96 of them (E13, learning rate 1e-3), and compares the larger of the two values of the
others with the discounted costs that followed, wherever an episode was seen to its end.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import hydra
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SoftUpdate

from saferl.algorithms.assemble import load_agent
from saferl.checkpoint.run import run_config
from saferl.envs.intersection import BatchedIntersection
from saferl.modules import DualAscent, MLPValue, MMAMValue, value_operator, zero_output
from saferl.objectives import SACLagLoss

ENVS, HELD_OUT, DECISIONS = 128, 32, 400


def followed(data: TensorDictBase, gamma: float) -> tuple[Tensor, Tensor]:
    """Discounted cost from each transition to the end of its episode [B, T], and whether the episode
    was seen to its end."""
    after = data["next"]
    cost, done, ends = (after[key].squeeze(-1) for key in ("cost", "done", "terminated"))
    returns, seen = torch.zeros_like(cost), torch.zeros_like(done)
    total, known = torch.zeros(len(cost)), torch.zeros(len(cost), dtype=torch.bool)
    for t in reversed(range(cost.shape[1])):
        known = torch.where(done[:, t], ends[:, t], known)
        returns[:, t] = total = cost[:, t] + gamma * torch.where(done[:, t], 0.0, total)
        seen[:, t] = known
    return returns, seen


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, metavar="RUN")
    parser.add_argument("--targets", nargs="+", choices=("mean", "max"), default=["mean", "max"])
    parser.add_argument("--updates", type=int, default=8000)
    parser.add_argument("--width", type=int, default=64, help="of the critics (MMAM)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(options.seed)
    cfg = run_config(options.run)
    cfg.device = "cpu"
    actor = load_agent(cfg, options.run, "checkpoint").actor
    scenario = hydra.utils.instantiate(cfg.task)
    env, scales = BatchedIntersection(scenario, ENVS, seed=options.seed), scenario.form.scales
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        data = env.rollout(DECISIONS, actor, break_when_any_done=False)
    returns, seen = followed(data, cfg.gamma)
    train, test = data[:-HELD_OUT].reshape(-1), data[-HELD_OUT:][seen[-HELD_OUT:]]
    truth = returns[-HELD_OUT:][seen[-HELD_OUT:]]
    print(f"{len(train)} transitions, {len(test)} held out: mean cost return {truth.mean():.4f}")

    results = {}
    for target in options.targets:
        torch.manual_seed(options.seed)
        critics = [
            value_operator(
                zero_output(MMAMValue(width=options.width, **scales)),
                out_key="state_action_cost_value",
            )
            for _ in range(2)
        ]
        loss = SACLagLoss(
            actor,
            [value_operator(MLPValue(rows=cfg.task.rows, width=8, **scales)) for _ in range(2)],
            critics,
            lagrange=DualAscent(init=1.0, lr=1e-4),
            cost_target=target,
        )
        loss.make_value_estimator(gamma=cfg.gamma)
        optimizer = torch.optim.Adam(loss.cost_critic_params.parameters(), lr=1e-3, fused=True)
        targets = SoftUpdate(loss, tau=cfg.learning.tau)
        for update in range(1, options.updates + 1):
            value, _ = loss.cost_loss(train[torch.randint(len(train), (cfg.learning.batch_size,))])
            value.backward()
            optimizer.step()
            optimizer.zero_grad()
            targets.step()
            if update % max(options.updates // 4, 1) == 0:
                with torch.no_grad():
                    q = loss.cost_value(test.copy())["state_action_cost_value"].squeeze(-1)
                figures = {
                    "mean_value": q.mean().item(),
                    "mean_return": truth.mean().item(),
                    "rmse": (q - truth).square().mean().sqrt().item(),
                    "value_above_limit": (q > cfg.risk_limit).float().mean().item(),
                    "return_above_limit": (truth > cfg.risk_limit).float().mean().item(),
                    "correlation": torch.corrcoef(torch.stack([q, truth]))[0, 1].item(),
                }
                results[f"{target} {update}"] = figures
                row = "  ".join(f"{key} {value:.3f}" for key, value in figures.items())
                print(f"{target:5s}{update:6d}  {row}", flush=True)
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
