"""A speed limit as a cost."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import hydra
import pytest
from small import compose

from saferl.algorithms.assemble import build_env, build_trainer
from saferl.envs import GymEnvs, GymTask
from saferl.envs.speed import RUNNERS, SpeedLimit
from saferl.evaluation.play import evaluate
from saferl.evaluation.statistics import summarise


class Runner(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0, 1, (1,))
    action_space = gymnasium.spaces.Box(-1, 1, (1,))

    def __init__(self, **velocity: float):
        self.velocity = velocity

    def step(self, action):
        return self.observation_space.sample(), 1.0, False, False, dict(self.velocity)


@pytest.mark.parametrize(
    ("velocity", "cost"),
    [
        ({"x_velocity": 0.9}, 0.0),
        ({"x_velocity": -1.1}, 1.0),
        ({"x_velocity": 0.8, "y_velocity": 0.7}, 1.0),
        ({"x_velocity": 0.6, "y_velocity": 0.7}, 0.0),
    ],
)
def test_faster_than_the_limit_costs_one(velocity: dict, cost: float):
    *_, info = SpeedLimit(Runner(**velocity), limit=1.0).step(None)
    assert info["cost"] == cost and info["x_velocity"] == velocity["x_velocity"]


def test_refuses():
    with pytest.raises(ValueError, match="limit must be > 0, got 0"):
        SpeedLimit(Runner(), limit=0)


@pytest.mark.parametrize("runner", RUNNERS)
def test_mujocos_runners(runner: str):
    pytest.importorskip("mujoco")
    pytest.importorskip("imageio")
    task = GymTask(f"saferl.envs.speed:saferl/{runner}Speed-v0", kwargs={"limit": 1e-6})
    env = GymEnvs(task, num_envs=2, seed=0)
    assert env.horizon == 1000
    data = env.rollout(3)
    assert data["next", "cost"].eq(1).all() and data["next", "reward"].isfinite().all()


@pytest.mark.slow
def test_the_cost_falls_to_the_limit(tmp_path: Path):
    """Of the half-cheetah's 1,000 steps without a limit hundreds are too fast, with it at most the 25
    that a discounted cost of 2.5 allows on average."""
    pytest.importorskip("mujoco")
    cost = {}
    for algo, options in {
        "sac": ("frames=50000",),
        "sac_lag": ("lagrange=signed", "lagrange.multiplier.lr=3e-3"),
    }.items():
        cfg = compose("experiment=speed", f"algo={algo}", *options, "threads=1", "logger=none")
        trainer = build_trainer(cfg, tmp_path / algo)
        trainer.train()
        task = hydra.utils.instantiate(cfg.task)
        rows = evaluate(trainer.collector.policy, build_env(cfg.env, task, 10, 0), 20, 0)
        figures = summarise(rows)
        cost[algo] = figures["cost_return"]
        for name in ("cost_return", "return"):
            print(algo, name, {bound: round(v, 2) for bound, v in figures[name].items()})
    assert cost["sac"]["low"] > 100 and cost["sac_lag"]["high"] < 25
