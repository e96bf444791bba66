"""HighwayIntersection: TorchRL's contract, replay, and agreement with the batched backend."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from batch import reset, reset_rows, step
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from saferl.envs.intersection import BatchedIntersection, HighwayIntersection, Reward, Scenario
from saferl.envs.intersection.base import OUTCOMES
from saferl.envs.intersection.drivers import Driver
from saferl.envs.intersection.spawning import draw_route
from saferl.envs.seeding import episode_seeds

OBSERVATION = ("ego", "vehicles", "route", *OUTCOMES)
RESULT = (*OBSERVATION, "reward", "cost", "terminated", "truncated", "done")
BACKENDS = (BatchedIntersection, HighwayIntersection)


def same(a, b, keys=RESULT):
    return all(torch.equal(a[key], b[key]) for key in keys)


def gentle(count, *shape, seed=0):
    """Random actions that mostly keep a car moving on the road: little steering."""
    generator = torch.Generator().manual_seed(seed)
    action = torch.rand((count, *shape, 2), generator=generator) * 2 - 1
    return action * torch.tensor([0.5, 0.05])


@pytest.mark.parametrize(("task", "vehicles"), [("lt", 10), ("gs", 3), ("rt", 0), ("mixed", 10)])
def test_specs(task, vehicles):
    env = HighwayIntersection(Scenario(task=task, vehicles=vehicles), num_envs=2, seed=0)
    check_env_specs(env, seed=0)
    for key in ("reward", "cost"):
        spec = env.full_reward_spec[key]
        assert spec.shape == (2, 1) and spec.dtype == torch.float32
    assert set(env.full_reward_spec.keys()) == {"reward", "cost"}


def test_both_backends_have_the_same_specs():
    batched, highway = (kind(Scenario(vehicles=0), num_envs=3) for kind in BACKENDS)
    assert batched.observation_spec == highway.observation_spec
    assert batched.full_reward_spec == highway.full_reward_spec
    assert batched.full_done_spec == highway.full_done_spec
    assert batched.action_spec == highway.action_spec


# --- both backends, step by step -----------------------------------------------------------------


def assert_agree(a, b, reward=1e-4):
    """One backend computes in float32 and the other in float64."""
    for key in RESULT:
        if a[key].is_floating_point():
            gap = (a[key] - b[key]).abs()
            tolerance = reward if key == "reward" else 1e-4
            assert (gap <= tolerance + 1e-4 * b[key].abs()).all(), (key, gap.max())
        else:
            assert torch.equal(a[key], b[key]), key


# In the raw reading 2 / (1 + 400 e^2) changes by up to 26 for each metre of e, so that a
# rounding of 1e-5 m in a position is worth some 1e-4 of reward.
@pytest.mark.parametrize(
    ("frequency", "reading", "tolerance"),
    [(5, "normalised", 1e-4), (10, "normalised", 1e-4), (5, "raw", 1e-3)],
)
def test_both_backends_agree_on_crossings(frequency, reading, tolerance):
    scenario = Scenario(
        task="mixed", vehicles=0, policy_frequency=frequency, reward=Reward(reading=reading)
    )
    batched, highway = (kind(scenario, num_envs=4, seed=1) for kind in BACKENDS)
    seeds = episode_seeds(2, 50)
    routes = draw_route("mixed", seeds).tolist()
    seeds = seeds[[routes.index(route) for route in range(4)]]
    here, there = reset(batched, seeds), reset(highway, seeds)
    assert here["route"].flatten().tolist() == [0, 1, 2, 3]
    assert_agree_at_reset(here, there)
    alive, driver = torch.ones(4, dtype=torch.bool), Driver()
    noise = gentle(scenario.horizon, 4, seed=frequency) / 2
    for k in range(scenario.horizon):
        # The same action to both: the driver's, from one of them, and a little noise.
        action = (driver(here.select(*OBSERVATION).clone())["action"] + noise[k]).clamp(-1, 1)
        here, there = step(batched, action), step(highway, action)
        assert_agree(here[alive], there[alive], tolerance)
        alive &= ~here["done"].squeeze(-1)
        if not alive.any():
            break
    assert not alive.any() and here["success"].any()


def assert_agree_at_reset(here, there):
    for key in OBSERVATION:
        assert torch.allclose(here[key].float(), there[key].float(), atol=1e-5), key


@pytest.mark.parametrize(
    "action", [(-1.0, 0.0), (-1.0, 1.0), (0.6, -1.0), (1.0, 0.0)], ids=["stop", "skid", "off", "go"]
)
def test_both_backends_agree_at_the_ends_of_episodes(action):
    scenario = Scenario(task="gs", vehicles=0, duration=8.0, standstill=2.0, route_starts=0.5)
    batched, highway = (kind(scenario, num_envs=4) for kind in BACKENDS)
    seeds = episode_seeds(3, 4)
    assert_agree_at_reset(reset(batched, seeds), reset(highway, seeds))
    alive = torch.ones(4, dtype=torch.bool)
    for _ in range(scenario.horizon):
        here, there = step(batched, action), step(highway, action)
        assert_agree(here[alive], there[alive])
        alive &= ~here["done"].squeeze(-1)
    assert not alive.any()


@pytest.mark.parametrize("kind", BACKENDS)
def test_own_sequences_of_episodes_are_the_same_on_both(kind):
    ours = kind(Scenario(vehicles=0), num_envs=3, seed=5)
    reference = BatchedIntersection(Scenario(vehicles=0), num_envs=3, seed=5)
    for _ in range(2):
        assert_agree_at_reset(reset(ours), reset(reference))


# --- episodes ------------------------------------------------------------------------------------


def test_an_ended_episode_stands_still_until_its_reset():
    env = HighwayIntersection(Scenario(task="gs", vehicles=2), num_envs=2, seed=1)
    reset(env)
    off_road = torch.tensor([[0.0, 1.0], [-1.0, 0.0]])  # the first steers off, the second brakes
    for _ in range(30):
        view = step(env, off_road)
        if view["done"].any():
            break
    assert view["done"].squeeze(-1).tolist() == [True, False]
    assert view["terminated"][0] and view["offroad"][0] and not view["success"][0]
    for action in gentle(3, 2):
        after = step(env, action)
        assert same(after[0], view[0])
    assert not torch.equal(after["ego"][1], view["ego"][1])
    fresh = reset_rows(env, after, [True, False])
    assert not fresh["done"].any() and not fresh["offroad"].any()
    assert torch.equal(fresh["ego"][1], after["ego"][1])
    assert not step(env, (0.0, 0.0))["done"].any()


def test_a_partial_reset_touches_only_its_rows():
    env, twin = (
        HighwayIntersection(Scenario(task="mixed", vehicles=6), num_envs=3, seed=2)
        for _ in range(2)
    )
    rows = torch.tensor([False, True, False])
    reset(env), reset(twin)
    actions = gentle(6, 3, seed=1)
    for action in actions[:3]:
        before = step(env, action)
        step(twin, action)
    after = reset_rows(env, before, rows)
    assert same(after[~rows], before[~rows], OBSERVATION)
    assert not torch.equal(after["ego"][1], before["ego"][1])
    for action in actions[3:]:
        here, there = step(env, action), step(twin, action)
        assert same(here[~rows], there[~rows])


def test_an_episode_is_a_function_of_its_seed_whatever_the_batch():
    seeds = episode_seeds(4, 3)
    actions = gentle(10, 3, seed=2)
    together = HighwayIntersection(Scenario(vehicles=8), num_envs=3, seed=0)
    views = [reset(together, seeds)] + [step(together, action) for action in actions]
    assert (views[0]["vehicles"][..., 0].sum(-1) > 0).all()
    for k in (2, 0):
        alone = HighwayIntersection(Scenario(vehicles=8), num_envs=1, seed=9)
        assert same(reset(alone, seeds[k : k + 1]), views[0][k : k + 1], OBSERVATION)
        for action, view in zip(actions, views[1:], strict=True):
            assert same(step(alone, action[k : k + 1]), view[k : k + 1])


def test_two_instances_share_no_generator_and_leave_the_global_ones_alone():
    def episodes(env, neighbour=None):
        out = []
        for _ in range(2):
            out.append(reset(env).clone())
            if neighbour is not None:
                reset(neighbour)
                step(neighbour, (0.0, 0.0))
            out.append(step(env, (0.2, 0.0)).clone())
        return out

    def make():
        return HighwayIntersection(Scenario(vehicles=5), num_envs=1, seed=3)

    state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()
    alone, beside = episodes(make()), episodes(make(), make())
    assert torch.equal(torch.get_rng_state(), state)
    assert (np.random.get_state()[1] == numpy_state).all()
    assert all(same(a, b, OBSERVATION) for a, b in zip(alone, beside, strict=True))


def test_set_seed_starts_the_same_sequence_of_episodes_again():
    env = HighwayIntersection(Scenario(vehicles=5), num_envs=2, seed=3)
    first = [reset(env).clone() for _ in range(2)]
    env.set_seed(3)
    assert all(same(reset(env), view, OBSERVATION) for view in first)
    env.set_seed(4)
    assert not torch.equal(reset(env)["ego"], first[0]["ego"])


# --- state ---------------------------------------------------------------------------------------


def test_state_dict_continues_bit_for_bit_in_the_middle_of_an_episode():
    scenario = Scenario(task="mixed", vehicles=10, route_starts=0.5)
    actions = gentle(24, 3, seed=4)
    actions[:, 2, 1] = 1.0  # the third leaves the road and stands still

    def onwards(env):
        out = [step(env, action).clone() for action in actions[10:16]]
        out.append(reset_rows(env, out[-1], [False, True, True]).clone())
        out += [step(env, action).clone() for action in actions[16:]]
        return [*out, reset(env).clone()]

    env = HighwayIntersection(scenario, num_envs=3, seed=6)
    reset(env)
    for action in actions[:10]:
        view = step(env, action)
    assert view["done"].squeeze(-1)[2]
    stored = {key: value.clone() for key, value in env.state_dict().items()}
    expected = onwards(env)

    other = HighwayIntersection(scenario, num_envs=3, seed=77)
    reset(other)
    step(other, actions[0])
    other.load_state_dict(stored)
    assert all(torch.equal(other.state_dict()[key], value) for key, value in stored.items())
    for here, there in zip(onwards(other), expected, strict=True):
        assert set(here.keys()) == set(there.keys())
        assert same(here, there, there.keys())


def test_replay_does_not_depend_on_the_callers_memory():
    env = HighwayIntersection(
        Scenario(task="gs", vehicles=2, observation="world"), num_envs=1, seed=1
    )
    reset(env)
    buffer = TensorDict({"action": torch.tensor([[0.5, 0.0]])}, batch_size=[1])
    view = env.step(buffer)["next"].clone()
    buffer["action"].fill_(-1.0)  # a collector that writes its next action in place
    other = HighwayIntersection(
        Scenario(task="gs", vehicles=2, observation="world"), num_envs=1, seed=2
    )
    other.load_state_dict(env.state_dict())
    assert same(step(other, (0.1, 0.0)), step(env, (0.1, 0.0)))
    assert view["ego"][0, 3] > 6.0


def test_snapshot_and_render_show_one_environment():
    env = HighwayIntersection(
        Scenario(task="lt", vehicles=6, observation="world"), num_envs=2, seed=1
    )
    view = reset(env)
    ego, others = env.snapshot(1)
    assert torch.allclose(torch.tensor(ego).float(), view["ego"][1, 1:7])
    seen = view["vehicles"][1]
    seen = seen[seen[:, 0] > 0]
    assert others.shape[1] == 6 and len(others) >= len(seen) > 0
    nearest = torch.tensor(others[:, :2] - ego[:2])
    nearest = nearest[nearest.norm(dim=-1).argsort()]
    ahead = nearest @ torch.tensor([math.cos(ego[4]), math.sin(ego[4])], dtype=torch.float64)
    expected = nearest[(ahead <= 70) & (ahead >= -30)].float()
    assert torch.allclose(seen[:, 1:3], expected[:10], atol=1e-4)
    picture = env.render(1)
    assert picture.ndim == 3 and picture.shape[-1] == 3 and picture.dtype.name == "uint8"
