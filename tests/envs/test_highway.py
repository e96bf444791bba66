"""The gymnasium environment: spaces, seeds, timing, ends, pictures, and its traffic."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from numpy_routes import rectangles_overlap, routes
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from saferl.envs.intersection import IntersectionEnv, register
from saferl.envs.intersection.dynamics import step_ego, to_physical
from saferl.envs.intersection.geometry import TASKS

CHEAP = {"steps": 1}  # where the cost is not looked at
STILL = np.array([-1.0, 0.0], np.float32)


def start_state(route: int, s: float, speed: float) -> list[float]:
    x, y, phi = routes().pose(route, np.float64(s))
    return [x, y, speed, 0.0, phi, 0.0]


def play(env: IntersectionEnv, seed: int, actions: np.ndarray) -> list[np.ndarray]:
    observation, info = env.reset(seed=seed)
    trace = [observation["ego"], observation["vehicles"]]
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        trace += [observation["ego"], observation["vehicles"]]
        trace += [np.array([reward, info["cost"]]), env.snapshot()[1]]
        if terminated or truncated:
            break
    return trace


@pytest.mark.filterwarnings("ignore")
def test_gymnasium_and_stable_baselines_accept_it():
    register()
    register()  # twice is once
    for name, task in (("LT", "lt"), ("GS", "gs"), ("RT", "rt"), ("Mixed", "mixed")):
        env = gymnasium.make(f"saferl/Intersection-{name}-v0", render_mode="rgb_array")
        assert env.unwrapped.scenario.task == task
        env.close()
    env = gymnasium.make("saferl/Intersection-Mixed-v0", render_mode="rgb_array")
    check_env(env.unwrapped, skip_render_check=True)
    sb3_check_env(IntersectionEnv(), skip_render_check=True)


def test_same_seed_and_actions_give_the_same_episode():
    rng = np.random.default_rng(0)
    actions = rng.uniform(-0.1, 0.1, (12, 2)).astype(np.float32)
    one, two = IntersectionEnv(), IntersectionEnv()
    first = play(one, 5, actions)
    np.random.seed(1)  # nothing of it is global
    torch.manual_seed(1)
    play(two, 6, actions[:3])
    second = play(two, 5, actions)
    other = play(two, 6, actions)
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
    assert not np.array_equal(first[0], other[0])
    # Without a seed the stream goes on, the same in both.
    one.reset(seed=5), two.reset(seed=5)
    for _ in range(3):
        assert np.array_equal(one.reset()[0]["vehicles"], two.reset()[0]["vehicles"])


def test_an_episode_is_restored_by_replay():
    actions = np.random.default_rng(2).uniform(-0.1, 0.1, (12, 2)).astype(np.float32)
    env, copy = IntersectionEnv(task="gs"), IntersectionEnv(task="gs")
    whole = play(env, 11, actions)
    play(copy, 11, actions[:7])
    for action in actions[7:]:
        observation, *_ = copy.step(action)
    np.testing.assert_array_equal(observation["ego"], whole[-4])
    np.testing.assert_array_equal(copy.snapshot()[1], env.snapshot()[1])


@pytest.mark.parametrize(("frequency", "decisions"), [(5, 125), (10, 250)])
def test_an_episode_lasts_25_seconds(frequency, decisions):
    env = IntersectionEnv(task="rt", vehicles=0, policy_frequency=frequency, cost=CHEAP)
    env.reset(seed=0)
    for k in range(decisions):
        _, _, terminated, truncated, _ = env.step(STILL)
        assert not terminated
        assert truncated == (k == decisions - 1)
    assert env.road.time == pytest.approx(25.0, abs=1e-9)


def test_both_frequencies_integrate_the_same_motion():
    ends = []
    for frequency, decisions in ((5, 5), (10, 10)):
        env = IntersectionEnv(vehicles=0, policy_frequency=frequency, cost=CHEAP)
        env.reset(seed=0, options={"start": start_state(1, 60.0, 8.0), "route": "gs_inner"})
        for _ in range(decisions):
            env.step(np.array([0.2, 0.0], np.float32))
        ends.append(env.snapshot()[0])
    assert ends[0][2] == pytest.approx(9.0) == ends[1][2]
    assert ends[0][1] == pytest.approx(ends[1][1], abs=0.05)


def test_the_ego_moves_by_the_dynamic_bicycle():
    env = IntersectionEnv(vehicles=0)
    env.reset(seed=3)
    state = env.ego.state
    action = np.array([0.4, -0.1], np.float32)
    env.step(action)
    control = to_physical(torch.from_numpy(action).double())
    for _ in range(3):
        state = step_ego(state, control, 1 / 15)
    np.testing.assert_array_equal(env.snapshot()[0], state.numpy())
    np.testing.assert_allclose(env.ego.position, state[:2])
    assert env.ego.heading == pytest.approx(state[4].item())


def test_starts_are_40_m_before_the_box_or_along_the_route():
    for task, lanes in (("lt", [2.0]), ("gs", [2.0, 6.0]), ("rt", [6.0])):
        env = IntersectionEnv(task=task, vehicles=0)
        seen = set()
        for seed in range(30):
            _, info = env.reset(seed=seed)
            x, y, v, _, phi, _ = env.snapshot()[0]
            assert 50.0 <= y <= 60.0
            assert 6.0 <= v <= 10.0
            assert phi == pytest.approx(-np.pi / 2)
            seen.add(round(x, 6))
            assert info["task"] == task
        assert sorted(seen) == lanes
    env = IntersectionEnv(task="gs", vehicles=0, route_starts=1.0, observation="world")
    ys = [env.reset(seed=seed)[0]["ego"][2] for seed in range(60)]
    assert min(ys) < -15.0
    assert max(ys) > 40.0


def test_mixed_draws_every_task():
    env = IntersectionEnv(vehicles=0)
    assert {env.reset(seed=seed)[1]["task"] for seed in range(20)} == set(TASKS)
    assert env.reset(seed=0, options={"task": "rt"})[1]["task"] == "rt"


def test_success_past_25_m_on_the_exit_arm():
    env = IntersectionEnv(task="gs", vehicles=0)
    start = start_state(1, 130.0 + 23.0, 9.0)
    env.reset(seed=0, options={"route": "gs_inner", "start": start})
    _, _, terminated, _, info = env.step(np.zeros(2, np.float32))
    assert not terminated
    _, reward, terminated, truncated, info = env.step(np.zeros(2, np.float32))
    assert terminated and not truncated
    assert info["success"] and not info["collision"] and not info["offroad"]
    assert reward > 90.0


def test_leaving_the_road_ends_the_episode():
    env = IntersectionEnv(task="rt", vehicles=0)
    env.reset(seed=0, options={"start": start_state(3, 70.0, 9.0)})
    for _ in range(30):
        _, reward, terminated, _, info = env.step(np.array([0.0, 0.5], np.float32))
        if terminated:
            break
    assert terminated and info["offroad"] and not info["collision"] and not info["success"]
    assert reward < -40.0


def test_a_collision_ends_the_episode_and_was_priced_before():
    env = IntersectionEnv(task="gs", vehicles=1)
    for seed in range(20):
        env.reset(seed=seed)
        if env.road.traffic:
            break
    # Put the ego 7 m behind a vehicle (centres) and drive at it.
    ahead = env.road.traffic[0]
    x, y, phi = routes().pose(ahead.route_id, ahead.s - 7.0)
    env.ego.place(torch.tensor([x, y, 12.0, 0.0, phi, 0.0]))
    env._observe()
    costs = []
    for _ in range(10):
        _, reward, terminated, _, info = env.step(np.array([1.0, 0.0], np.float32))
        costs.append(info["cost"])
        if terminated:
            break
    assert info["collision"] and not info["success"]
    assert reward < -40.0
    assert max(costs) > 0.05


def test_surrounding_vehicles_never_overlap():
    for task, seed in zip(TASKS * 3, range(9), strict=True):
        env = IntersectionEnv(task=task, cost=CHEAP)
        env.reset(seed=seed)
        for _ in range(40):
            *_, info = env.step(STILL)
            pose = env.snapshot()[1][:, [0, 1, 4]]
            hit = rectangles_overlap(pose[:, None], pose)
            assert hit.sum() == len(pose)
            assert not info["collision"]  # nobody hits an ego that brakes and stands


def test_no_vehicle_is_a_valid_scene():
    env = IntersectionEnv(task="lt", vehicles=0, observation="world")
    observation, _ = env.reset(seed=0)
    assert observation["ego"][7] == 70.0
    assert not observation["vehicles"].any()
    assert env.snapshot()[1].shape == (0, 6)
    observation, _, _, _, info = env.step(np.zeros(2, np.float32))
    assert info["cost"] == 0.0
    assert observation in env.observation_space


def test_observed_vehicles_are_those_of_the_snapshot():
    env = IntersectionEnv(task="lt", observation="world")
    observation, _ = env.reset(seed=1)
    ego, vehicles = env.snapshot()
    delta = vehicles[:, :2] - ego[:2]
    ahead = delta @ [np.cos(ego[4]), np.sin(ego[4])]
    seen = delta[(ahead <= 70) & (ahead >= -30)]
    seen = seen[np.argsort(np.hypot(*seen.T))]
    rows = observation["vehicles"]
    assert rows[:, 0].sum() == len(seen)
    np.testing.assert_allclose(rows[: len(seen), 1:3], seen, atol=1e-4)


def test_rendering():
    env = IntersectionEnv(task="lt", render_mode="rgb_array", cost=CHEAP)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.render()
    env.reset(seed=0)
    before = env.render()
    assert before.shape == (600, 600, 3)
    assert before.dtype == np.uint8
    scale = 600 / 110
    ego = env.snapshot()[0]
    column, row = int((ego[0] + 55) * scale), min(int((ego[1] + 55) * scale), 599)
    for _ in range(5):
        env.step(np.array([0.5, 0.0], np.float32))
    after = env.render()
    assert (before != after).any()
    x, y = ((env.snapshot()[0][:2] + 55) * scale).astype(int)
    green = np.array([50, 200, 0])
    assert np.abs(after[y, x].astype(int) - green).max() < 40
    assert column == x and row > y
    assert IntersectionEnv().render() is None
    env.close()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"task": "uturn"}, ("task", "uturn", "lt, gs, rt, mixed")),
        ({"vehicles": -1}, ("vehicles", "-1")),
        ({"rows": 0}, ("rows", "0")),
        ({"policy_frequency": 0}, ("policy_frequency", "0")),
        ({"route_starts": 2.0}, ("route_starts", "2.0")),
        ({"render_mode": "human"}, ("render_mode", "human", "rgb_array")),
        ({"reward": {"reading": "metric"}}, ("reward.reading", "metric", "normalised, raw")),
        ({"reward": {"bonus": 1}}, ("reward.bonus", "reading")),
        ({"cost": {"steps": 0}}, ("cost.steps", "0")),
        ({"cost": 3}, ("cost", "3")),
    ],
)
def test_bad_settings_say_what_is_wrong(settings, words):
    with pytest.raises(ValueError, match=r".") as error:
        IntersectionEnv(**settings)
    assert all(word in str(error.value) for word in words)


def test_bad_options_say_what_is_wrong():
    env = IntersectionEnv()
    for options in ({"task": "up"}, {"route": "up"}, {"start": [0.0]}, {"speed": 3}):
        with pytest.raises(ValueError, match=next(iter(options))):
            env.reset(seed=0, options=options)
