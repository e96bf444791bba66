"""Whole trainings against optima that can be computed."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from small import compose
from table import Table
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from saferl.algorithms.assemble import build_trainer
from saferl.envs import Cart, CartEnv
from saferl.envs.seeding import episode_seeds
from saferl.evaluation.play import play

QUIET = ("logger=none", "threads=1", "save_minutes=null", "save_every=100000000", "device=cpu")
LIMIT, GAMMA, HORIZON, FOREVER = 0.2, 0.9, 20, 80


def linear(gain: torch.Tensor):
    return lambda td: td.set("action", -(td["observation"] @ gain)[:, None].clamp(-1, 1))


def sums(policy, steps: int, gamma: float) -> tuple[float, float]:
    """Mean discounted reward and cost of a policy's mean actions in 2,000 episodes."""
    env = CartEnv(dataclasses.replace(Cart(), horizon=steps), num_envs=2000, seed=0)
    played = play(policy, env, episode_seeds(1, 2000))
    weight = gamma ** torch.arange(len(played), dtype=torch.float64)
    reward, cost = (
        torch.stack([step["next", key].squeeze(-1).mean() for step in played]).double()
        for key in ("reward", "cost")
    )
    return float(weight @ reward), float(weight @ cost)


#: What each needs beside the limit, which is on the undiscounted cost of an episode.
PROBLEMS = {
    "cpo": ("loss.damping=0.01", "learning.rollout_frames=2560", "frames=800000"),
    "ppo_lag": ("learning.epochs=5", "loss.entropy_bonus=false", "frames=800000"),
    "sac_lag": (),
    "sac_pid": (),
}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("algo", PROBLEMS)
def test_cart(algo: str, seed: int, tmp_path: Path):
    """Within 5% of the optimum, at a cost of at most 1.05 times the limit."""
    cfg = compose("experiment=cart", f"algo={algo}", f"seed={seed}", *PROBLEMS[algo], *QUIET)
    trainer = build_trainer(cfg, tmp_path)
    trainer.train()
    gain = torch.tensor(Cart().optimum(LIMIT, GAMMA, 1.0, HORIZON), dtype=torch.float32)
    actor = trainer.collector.policy
    best, ours = (sums(policy, FOREVER, GAMMA)[0] for policy in (linear(gain), actor))
    cost = sums(actor, HORIZON, 1.0)[1]
    print(f"{algo} {seed}: return {ours:.4f} of {best:.4f}, cost {cost:.4f} of {LIMIT}")
    assert abs(ours - best) <= 0.05 * abs(best)
    assert cost <= 1.05 * LIMIT


TABLE = (
    "encoder=mlp", "task=cart", "~task.spread", "~task.noise", "task._target_=table.Table", "task.task=table",
    "task.horizon=10", "env._target_=table.TableEnv", "env.num_envs=64", "risk_limit=1",
    "gamma=0.8", "learning.tau=0.005", "frames=200000", "learning.updates_per_frame=0.04", "encoder.width=32",
    "encoder.depth=2", "learning.reward_scale=1", "learning.target_entropy=-3", "compile=false",
    "projector.penalty=10", "projector.step_size=0.005", "lagrange.multiplier.lr=0.003",
    "lagrange.multiplier.init=0",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_table(seed: int, tmp_path: Path):
    """ARSAC with the signed multiplier, on a limit in every state: return, and each state's cost."""
    cfg = compose("algo=arsac_signed", *TABLE, f"seed={seed}", *QUIET)
    trainer = build_trainer(cfg, tmp_path)
    trainer.train()
    table, (*_, projector) = Table(), trainer.collector.env.transform
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        states = TensorDict({"observation": torch.eye(4)}, [4])
        action = projector._inv_call(trainer.collector.policy(states))["action"].squeeze(-1)
    best, ours = (float(table.reward(a).mean()) for a in (table.best, action))
    cost = float(table.values(action).max())
    print(f"arsac_signed {seed}: return {ours:.4f} of {best:.4f}, cost {cost:.4f} of {table.limit}")
    assert abs(ours - best) <= 0.05 * abs(best)
    assert cost <= 1.05 * table.limit


def test_table_states_its_optimum():
    """No action of a fine grid is better in any state, with the others at theirs."""
    table = Table()
    torch.testing.assert_close(table.values(table.best), torch.full((4,), table.limit))
    grid = torch.linspace(-1, 1, 4001)
    for state in range(4):
        trial = table.best.expand(4001, 4).clone()
        trial[:, state] = grid
        allowed = torch.stack([table.values(a) for a in trial])[:, state] <= table.limit + 1e-6
        rewards = table.reward(trial)[:, state].masked_fill(~allowed, -torch.inf)
        assert abs(grid[rewards.argmax()] - table.best[state]) < 1e-3
