"""Any gymnasium environment: costs, boxes, ends, seeds, state."""

from __future__ import annotations

import json

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from small import SMALL
from torchrl.envs.utils import check_env_specs
from walk import constant

from saferl.envs import GymEnvs, GymTask


def test_specs_costs_and_ends():
    env = GymEnvs(GymTask("test/Walk-v0"), num_envs=3, seed=4)
    check_env_specs(env)
    data = env.rollout(7, constant(1.0), break_when_any_done=False)
    assert data["observation"].shape == (3, 7, 2)  # a Dict, flattened
    torch.testing.assert_close(
        data["next", "cost"], torch.full((3, 7, 1), 4.0)
    )  # 1 is the upper end of [-2, 4]
    ends = data["next", "truncated"].squeeze(-1)
    assert ends.tolist() == [[False] * 4 + [True] + [False] * 2] * 3
    assert not data["next", "terminated"].any()
    # The last observation is the episode's own, not the next one's, though the array is reused.
    place = data["next", "observation"][:, :5, 0]
    torch.testing.assert_close(place.diff(dim=1), torch.full((3, 4), 4.0))
    assert data["observation"][:, 5, 1].eq(0).all()


def test_a_step_of_six_values_says_its_cost():
    """As Safety-Gymnasium's, whatever info has."""
    env = GymEnvs(GymTask("test/Six-v0", horizon=3), num_envs=1, seed=0)
    data = env.rollout(9, constant(0.0), break_when_any_done=True)
    torch.testing.assert_close(data["next", "cost"], torch.full((1, 3, 1), 2.0))
    assert bool(data["next", "truncated"][0, -1])


def test_termination_on_the_last_step_stays_a_termination():
    """docs/pitfalls.md, 2 and 12."""
    env = GymEnvs(GymTask("test/Walk-v0"), num_envs=1, seed=0)
    env.envs[0].unwrapped.far = 20.0 - 1e-3
    env.reset()
    env.envs[0].unwrapped.place[:] = 0.0
    for _ in range(5):
        env._go_on({0: np.ones(1, np.float32)})
    assert env._last[0]["terminated"] and env._last[0]["truncated"] and len(env._actions[0]) == 5


def test_seeds_decide_episodes_and_state_replays_them():
    task = GymTask("test/Walk-v0")
    first, second = (GymEnvs(task, num_envs=2, seed=7) for _ in range(2))
    start = first.reset()["observation"]
    assert torch.equal(start, second.reset()["observation"])
    assert not torch.equal(start[0], start[1])
    assert not torch.equal(start, first.reset()["observation"])
    asked = first.reset(seeds=torch.tensor([5, 5]))
    assert torch.equal(asked["observation"][0], asked["observation"][1])

    first.step(constant(0.5)(asked))
    other = GymEnvs(task, num_envs=2, seed=99)
    other.reset()
    other.load_state_dict(first.state_dict())
    steps = [env._step(constant(0.1)(asked.clone())) for env in (first, other)]
    assert torch.equal(steps[0]["observation"], steps[1]["observation"])


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (GymTask("test/Nowhere-v0"), "task.id: test/Nowhere-v0 cannot be made"),
        (GymTask("no_such_module:Walk-v0"), "cannot be made: No module named 'no_such_module'"),
        (GymTask("CartPole-v1"), "must have actions in a bounded box .*Discrete"),
        (GymTask("test/Whole-v0"), "bounded box .A. of floats, got Box.*int32"),
        (GymTask("test/Walk-v0", kwargs={"prize": 1}), "cannot be made: .*'prize'"),
        (GymTask("test/Walk-v0", size=99), "task.size is 2 in test/Walk-v0, got 99"),
        (GymTask("test/Walk-v0", action_dim=7), "task.action_dim is 1 in test/Walk-v0, got 7"),
        (GymTask("test/Six-v0"), "task.horizon must be given: test/Six-v0 has no time limit"),
    ],
)
def test_refuses(task: GymTask, message: str):
    with pytest.raises(ValueError, match=message):
        GymEnvs(task, num_envs=1, seed=0)


def test_a_missing_cost_is_named_before_anything_starts():
    with pytest.raises(
        ValueError, match=r"task.cost_key: info has no 'collision', it has \['cost'"
    ):
        GymTask("test/Walk-v0", cost_key="collision").complete()
    free = GymEnvs(GymTask("test/Walk-v0", cost_key=None), num_envs=1, seed=0)
    assert free.rollout(2, constant(1.0))["next", "cost"].eq(0).all()


@pytest.mark.parametrize("name", ["test/Six-v0", "test/SixLimited-v0"])
def test_six_values_under_a_time_limit(name: str):
    """Which gymnasium's own wrapper would not pass on."""
    env = GymEnvs(GymTask(name, horizon=None if "Limited" in name else 3), num_envs=1, seed=0)
    assert env.rollout(9, constant(0.0)).shape[1] == 3


def test_a_horizon_takes_the_place_of_the_environments_limit():
    assert GymTask("test/Walk-v0", horizon=3).complete()["horizon"] == 3
    assert GymTask("test/Walk-v0", horizon=30).complete()["horizon"] == 30
    assert GymTask("test/Walk-v0").complete()["horizon"] == 5
    with pytest.raises(ValueError, match="task.horizon must be null or >= 1, got 0"):
        GymTask("test/Walk-v0", horizon=0)


@pytest.mark.parametrize(
    ("cost", "message"),
    [
        (None, "a cost must be one number, got None"),
        ([1.0, 2.0], "a cost must be one number, got .1.0, 2.0."),
        ("much", "a cost must be one number, got 'much'"),
        (float("nan"), "test/Walk-v0 gave cost=.nan."),
    ],
)
def test_what_is_no_cost(cost, message: str):
    env = GymEnvs(GymTask("test/Walk-v0"), num_envs=1, seed=0)
    env.envs[0].unwrapped.priced = lambda speed: cost
    with pytest.raises(ValueError, match=message):
        env.rollout(1, constant(0.0))


def test_a_cost_in_an_array_of_one():
    env = GymEnvs(GymTask("test/Walk-v0"), num_envs=1, seed=0)
    env.envs[0].unwrapped.priced = lambda speed: np.array([[2]])
    assert env.rollout(1, constant(0.0))["next", "cost"].item() == 2.0


def test_an_observation_that_is_no_number():
    env = GymEnvs(GymTask("test/Walk-v0"), num_envs=1, seed=0)
    env.reset()
    env.envs[0].unwrapped.place[:] = np.nan
    with pytest.raises(ValueError, match="test/Walk-v0 gave observation=.*nan"):
        env._advance(0, np.zeros(1, np.float32))


class Engine(gymnasium.Env):
    """A simulator of which a process holds one, that fails at a place of its author's."""

    observation_space = Box(-1.0, 1.0, (2,), np.float32)
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    alive = 0

    def __init__(self, fails_in: str = ""):
        if Engine.alive:
            raise RuntimeError("this process holds an engine already")
        Engine.alive, self.fails_in = 1, fails_in

    def _fail(self, where: str) -> None:
        if self.fails_in == where:
            np.zeros(3) + np.zeros(4)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._fail("reset")
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self._fail("step")
        return np.zeros(2, np.float32), 0.0, False, False, {"cost": 0.0}

    def close(self):
        Engine.alive = 0


gymnasium.register("test/Engine-v0", Engine, max_episode_steps=6)


def test_who_makes_an_environment_closes_it(command, tmp_path):
    """Training and closing test, each with an engine of which a process holds one."""
    options = (
        *SMALL,
        "task=gym",
        "task.id=test/Engine-v0",
        "algo=rsac",
        "risk_limit=1",
        "env.num_envs=1",
    )
    command("train", "config", *options, "evaluation.num_envs=1", "out=run")
    assert (tmp_path / "run/evaluation/metrics.json").is_file() and not Engine.alive


@pytest.mark.parametrize("where", ["reset", "step"])
def test_a_fault_of_an_environment_says_where(where: str):
    told = rf"test/Engine-v0 failed in {where}: ValueError: oper.*test_gym.py, line \d+, in _fail"
    with pytest.raises(ValueError, match=told):
        GymEnvs(GymTask("test/Engine-v0", kwargs={"fails_in": where}), seed=0)
    assert not Engine.alive


def test_a_fault_is_placed_in_its_authors_file_not_in_a_library(monkeypatch):
    monkeypatch.setattr(Engine, "_fail", lambda self, where: json.loads("{ bad }"))
    with pytest.raises(ValueError, match=r"JSONDecodeError: .*test_gym.py, line \d+, in <lambda>"):
        GymEnvs(GymTask("test/Engine-v0"))
