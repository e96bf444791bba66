"""A speed limit as a cost."""

from __future__ import annotations

import gymnasium
import pytest

from saferl.envs import GymEnvs, GymTask
from saferl.envs.speed import RUNNERS, SpeedLimit


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
    env = GymEnvs(task, num_envs=2)
    assert env.horizon == 1000
    data = env.rollout(3)
    assert data["next", "cost"].eq(1).all() and data["next", "reward"].isfinite().all()
