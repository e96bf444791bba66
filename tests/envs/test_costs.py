"""Several costs: each road's cost by hand and on both backends, and those of gymnasium environments."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from saferl.envs import GymEnvs, GymTask
from saferl.envs.intersection import BatchedIntersection, CollisionCost, Scenario
from saferl.envs.intersection.costs import COSTS, Decision, costs_of
from saferl.envs.intersection.highway_torchrl import HighwayIntersection
from saferl.envs.seeding import episode_seeds

NAMES = ("collision", "road", "comfort", "speed")


def test_each_cost_by_hand():
    """Two cars: one at 12 m/s that brakes with 5 m/s^2 into another, one at 8 m/s that turns off the road."""
    ego = torch.tensor([[0.0, 0.0, 12.0, 0.0, 0.0, 0.0], [0.0, 0.0, 8.0, 0.0, 0.0, 0.5]])
    control = torch.tensor([[-5.0, 0.0], [0.0, 0.2]])
    predicted = torch.tensor([0.3, 0.0])
    hit, off = torch.tensor([True, False]), torch.tensor([False, True])
    decision = Decision(CollisionCost(crash=2.0), predicted, hit, off, ego, control, 0.1)
    expected = {
        "cost": [2.3, 2.0],
        "collision": [2.3, 0.0],
        "road": [0.0, 1.0],
        "comfort": [0.2, 0.1],  # 5 - 3, and 8 * 0.5 - 3, for a tenth of a second
        "speed": [0.2, 0.0],
    }
    assert set(expected) == set(COSTS)
    found = costs_of([*expected], decision)
    torch.testing.assert_close(found, torch.tensor([*expected.values()]).T)


def rollout(env, steps: int, seed: int = 0):
    torch.manual_seed(0)
    actions = torch.rand(steps, *env.batch_size, 2) * 2 - 1
    data, done = env.reset(seeds=episode_seeds(seed, env.batch_size[0])), []
    for action in actions:
        data = env.step(data.set("action", action))
        done.append(data["next"].clone())
        data = env.step_mdp(data)
    return torch.stack(done)


@pytest.mark.parametrize("backend", [BatchedIntersection, HighwayIntersection])
def test_a_cost_among_several_is_what_it_is_alone(backend):
    """And the default's is collision and road in one."""
    torch.set_default_dtype(torch.float64)
    try:
        envs = {names: backend(Scenario(task="lt", costs=names), 2) for names in (NAMES, ("cost",), ("comfort",))}  # fmt: skip
    finally:
        torch.set_default_dtype(torch.float32)
    check_env_specs(envs[NAMES])
    found = {names: rollout(env, 8) for names, env in envs.items()}
    assert found[NAMES]["cost"].shape == (8, 2, 4) and found[("cost",)]["cost"].shape == (8, 2, 1)
    each = found[NAMES]["cost"]
    torch.testing.assert_close(each[..., 2:3], found[("comfort",)]["cost"])
    torch.testing.assert_close(each[..., :2].sum(-1, keepdim=True), found[("cost",)]["cost"])
    assert (each[..., 2:] >= 0).all() and (each[..., 2] > 0).any()


def test_both_backends_charge_alike():
    torch.set_default_dtype(torch.float64)
    try:
        scenario = Scenario(task="gs", costs=NAMES)
        found = [rollout(kind(scenario, 2), 12) for kind in (BatchedIntersection, HighwayIntersection)]  # fmt: skip
    finally:
        torch.set_default_dtype(torch.float32)
    running = ~found[0]["done"].squeeze(-1)
    assert running.sum() > 10
    costs = [each["cost"][running] for each in found]
    torch.testing.assert_close(costs[0], costs[1].to(costs[0]), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("costs", [("crash",), ("speed", "speed"), ()])
def test_other_names_are_refused(costs):
    with pytest.raises(ValueError, match="costs must be different names among cost, collision, road"):  # fmt: skip
        Scenario(costs=costs)


class Told(gymnasium.Env):
    """Tells two costs in its info, or in a step of six values."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,))

    def __init__(self, six: bool = False):
        self.six = six

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        effort, left = float(abs(action[0])), float(action[0] < 0)
        own = (np.array([effort, left]),) if self.six else ()
        info = {} if self.six else {"effort": effort, "left": left, "words": "no number"}
        return (np.zeros(1, np.float32), 1.0, *own, False, False, info)


gymnasium.register("Told-v0", Told, max_episode_steps=5)


@pytest.mark.parametrize("six", [False, True])
def test_a_gymnasium_environment_tells_several(six: bool):
    env = GymEnvs(GymTask("Told-v0", costs=("effort", "left"), kwargs={"six": six}), num_envs=2)
    check_env_specs(env)
    data = env.rollout(4)
    action = 2 * data["action"]
    torch.testing.assert_close(data["next", "cost"], torch.cat([action.abs(), (action < 0).float()], -1))  # fmt: skip
    if not six:  # one of them alone
        alone = GymEnvs(GymTask("Told-v0", costs=("left",)), num_envs=2)
        assert alone.rollout(2)["next", "cost"].shape == (2, 2, 1)


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"costs": ("effort", "risk")}, r"task.costs: info has no 'risk', it has \['effort', 'left', 'words'\]"),
        ({"costs": ("effort", "words")}, "task.costs: a cost must be one number, got 'no number'"),
        ({"costs": ("a", "b", "c"), "kwargs": {"six": True}}, "task.costs: costs must be 3 numbers"),
        ({"costs": ("a", "a")}, "task.costs must be null or different names"),
    ],
)  # fmt: skip
def test_what_is_no_cost_is_refused(settings, told):
    with pytest.raises(ValueError, match=told):
        GymTask("Told-v0", **settings).complete()
