"""How episodes of the batched environment begin and end."""

from __future__ import annotations

import math

import pytest
import torch
from batch import (
    BRAKE,
    COAST,
    HARD_LEFT,
    NORTH,
    make,
    reset,
    step,
)

from saferl.envs.intersection.geometry import (
    ROUTES,
    ROUTES_OF_TASK,
    TASK_OF_ROUTE,
    project,
    reference_lines,
)
from saferl.envs.intersection.scenario import Scenario
from saferl.envs.intersection.spawning import (
    draw_route,
    draw_start,
)
from saferl.envs.seeding import episode_seeds

# --- starts --------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", ["lt", "gs", "rt", "mixed"])
def test_starts_are_forty_metres_before_the_box_in_the_lane_of_the_route(task):
    env = make(2000, task=task, seed=2)
    view = reset(env)
    route, ego = view["route"].squeeze(-1), view["ego"]
    assert set(route.tolist()) == set(ROUTES_OF_TASK[task])
    lanes = {"lt": 2.0, "gs_inner": 2.0, "gs_outer": 6.0, "rt": 6.0}
    lane = torch.tensor([lanes[name] for name in ROUTES])
    assert torch.equal(ego[:, 1], lane[route])
    assert torch.allclose(ego[:, 5], torch.tensor(NORTH))
    assert (ego[:, [4, 6]] == 0).all()
    for column, low, high in ((2, 50.0, 60.0), (3, 6.0, 10.0)):
        values = (ego[:, column].sort().values - low) / (high - low)
        expected = (torch.arange(2000) + 0.5) / 2000
        assert values[0] >= 0 and values[-1] <= 1
        assert (values - expected).abs().max() < 0.05
    if task == "mixed":
        share = torch.bincount(route, minlength=4) / 2000
        assert (share - torch.tensor([2, 1, 1, 2]) / 6).abs().max() < 0.04


def test_a_test_of_mixed_has_each_task_equally_often():
    scenario = Scenario(task="mixed")
    seeds = scenario.episodes(3, 1000)
    task = torch.tensor(TASK_OF_ROUTE)[draw_route("mixed", seeds)]
    assert torch.equal(task, torch.arange(1000) % 3)
    assert len(seeds.unique()) == 1000 and torch.equal(scenario.episodes(3, 10), seeds[:10])
    assert not torch.isin(seeds, scenario.episodes(4, 1000)).any()
    inner = (draw_route("mixed", seeds[1::3]) == 1).float().mean()
    assert 0.42 < inner < 0.58  # the lanes are still drawn


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_route_starts_spread_their_share_along_the_route(share):
    seeds = episode_seeds(1, 4000)
    route = draw_route("mixed", seeds)
    state = draw_start(route, seeds, share)
    lines = reference_lines(route, state)[:, 0]
    pose, s, distance = project(state[:, :2], lines)
    assert distance.max() < 1e-9 and torch.allclose(pose[:, 2], state[:, 4])
    start, goal = 55.0, lines[:, 3, 5] + 25.0
    assert (s >= start - 1e-9).all() and (s <= goal + 1e-9).all()
    beyond = s > 65.0
    # Uniform over the route: what lies beyond the usual 10 m of starts.
    expected = share * (1 - (10.0 / (goal - start)).mean())
    assert abs(beyond.double().mean() - expected) < 0.03
    if share:
        place = ((s - 65.0) / (goal - 65.0))[beyond].sort().values
        uniform_place = (torch.arange(len(place)) + 0.5) / len(place)
        assert (place - uniform_place).abs().max() < 0.05
        # Those along the route begin at any speed, at rest too.
        speed = (state[beyond, 2] / 10.0).sort().values
        assert (speed - uniform_place).abs().max() < 0.05


# --- ends of episodes ----------------------------------------------------------------------------


@pytest.mark.parametrize(("frequency", "decisions"), [(5, 125), (10, 250)])
def test_an_episode_is_truncated_after_25_seconds(frequency, decisions):
    env = make(3, policy_frequency=frequency)
    reset(env)
    for k in range(1, decisions + 1):
        view = step(env, BRAKE)
        assert view["truncated"].all() == (k == decisions), k
        assert torch.equal(view["done"], view["truncated"])
        assert not view["terminated"].any()


@pytest.mark.parametrize("frequency", [5, 10])
def test_a_decision_lasts_as_long_as_the_clock_says(frequency):
    """Straight on at constant speed: 9 m/s for a second are 9 m."""
    env = make(1, task="gs", policy_frequency=frequency)
    view = reset(env)
    y, speed = view["ego"][0, 2].item(), view["ego"][0, 3].item()
    for _ in range(frequency):
        view = step(env, COAST)
    assert view["ego"][0, 2].item() == pytest.approx(y - speed, abs=1e-4)


@pytest.mark.parametrize("frequency", [5, 10])
def test_a_car_that_stands_still_is_terminated_in_its_time(frequency):
    env = make(1, task="gs", standstill=2.0, policy_frequency=frequency)
    speed = reset(env)["ego"][0, 3].item()
    still = 0
    # Brakes to a stop, waits 1.6 s, drives for a moment, brakes again and waits.
    plan = [BRAKE] * math.ceil(frequency * speed / 5.0) + [BRAKE] * int(1.6 * frequency)
    plan += [(1.0, 0.0)] * 2 + [BRAKE] * (4 * frequency)
    for action in plan:
        view = step(env, action)
        speed = max(speed + action[0] * 5.0 / frequency, 0.0)
        assert view["ego"][0, 3].item() == pytest.approx(speed, abs=1e-4)
        still = still + 1 if speed < 0.3 else 0
        assert view["terminated"].item() == (still >= 2 * frequency)
        assert not view["truncated"].item()
        if view["terminated"].item():
            break
    assert still == 2 * frequency


def test_leaving_the_road_terminates():
    env = make(5, task="mixed")
    reset(env)
    for _ in range(20):
        view = step(env, HARD_LEFT)
        off = view["offroad"]
        assert torch.equal(view["terminated"], off) and torch.equal(view["done"], off)
        assert (view["reward"][off] < -40).all() and (view["reward"][~off] > -10).all()
        assert not view["collision"].any() and not view["success"].any()
        if off.any():
            break
    assert off.any()


def test_a_crash_in_the_last_decision_is_terminated():
    def crash(duration):
        env = make(1, task="gs", duration=duration)
        reset(env, [11])
        for k in range(1, 30):
            view = step(env, HARD_LEFT)
            if view["done"]:
                return k, view

    decisions, free = crash(25.0)
    assert free["terminated"] and not free["truncated"]
    last, view = crash(decisions / 5)
    assert last == decisions
    assert view["terminated"] and view["offroad"] and view["done"]
    assert torch.equal(view["reward"], free["reward"])
    last, view = crash((decisions - 1) / 5)
    assert last == decisions - 1
    assert view["truncated"] and not view["terminated"] and not view["offroad"]


def test_arriving_terminates_with_success():
    env = make(6, task="gs", seed=1)
    reset(env)
    for _ in range(60):
        view = step(env, (0.2, 0.0))
        ego, success = view["ego"], view["success"].squeeze(-1)
        assert torch.equal(success, ego[:, 2] <= -40.0)
        assert torch.equal(view["terminated"].squeeze(-1), success)
        assert (view["reward"].squeeze(-1)[success] > 90).all()
        if success.any():
            break
    assert success.any()
    assert (view["cost"] == 0).all(), "an empty road costs nothing"


def test_actions_beyond_the_box_are_clipped():
    env = make(2)
    reset(env, [3, 3])
    view = step(env, torch.tensor([[1.0, -1.0], [7.0, -3.0]]))
    assert torch.equal(view["ego"][0], view["ego"][1])
