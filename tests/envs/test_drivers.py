"""The scripted drivers on the empty road, and what the cautious one does about others."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from saferl.envs.intersection import BatchedIntersection, Scenario
from saferl.envs.intersection.drivers import CautiousDriver, Driver, RandomDriver
from saferl.envs.intersection.geometry import ROUTES
from saferl.evaluation import play as playing
from saferl.evaluation.rows import episode_rows

NORTH = -math.pi / 2


def play(driver, task, frequency=5, num_envs=64, seed=0):
    """Whether each first episode succeeded, the actions taken and the speeds reached in it."""
    scenario = Scenario(task=task, vehicles=0, policy_frequency=frequency, observation="world")
    env = BatchedIntersection(scenario, num_envs=num_envs, seed=seed)
    tensordict = env.reset()
    alive = torch.ones(num_envs, dtype=torch.bool)
    success = torch.zeros(num_envs, dtype=torch.bool)
    actions, speeds = [], []
    for _ in range(scenario.horizon):
        tensordict = env.step(driver(tensordict))
        actions.append(tensordict["action"][alive])
        speeds.append(tensordict["next", "ego"][alive, 3])
        success |= alive & tensordict["next", "success"].squeeze(-1)
        alive &= ~tensordict["next", "done"].squeeze(-1)
        if not alive.any():
            break
        tensordict = tensordict["next"].exclude("reward", "cost")
    return success, torch.cat(actions), torch.cat(speeds)


@pytest.mark.parametrize(("task", "frequency"), [("lt", 5), ("gs", 5), ("rt", 5), ("mixed", 10)])
def test_every_crossing_of_the_empty_road_succeeds(task, frequency):
    success, actions, speeds = play(Driver(), task, frequency)
    assert success.all()
    assert actions.abs().max() <= 1.0
    assert speeds.max() < 10.1  # the fastest start; it cruises at 9
    cautious, same, _ = play(CautiousDriver(), task, frequency)
    assert cautious.all()
    assert torch.equal(same, actions)


def test_the_cruising_speed_is_a_setting():
    _, _, slow = play(Driver(speed=4.0), "gs", num_envs=8)
    assert slow[-40:].mean().item() == pytest.approx(4.0, abs=0.1)


def view(*vehicles, y=60.0, speed=9.0, rows=11, route="gs_inner"):
    """The observation of a north-bound ego in the inner lane, and others at (dx, dy, v_x, v_y,
    heading): world frame, the velocities absolute."""
    table = torch.zeros(1, rows, 6)
    for row, (dx, dy, v_x, v_y, heading) in enumerate(vehicles):
        table[0, row] = torch.tensor([1.0, dx, dy, v_x, v_y + speed, heading])
    ego = torch.tensor([[1.0, 2.0, y, speed, 0.0, NORTH, 0.0, 70.0, 100.0]])
    return TensorDict(
        {"ego": ego, "vehicles": table, "route": torch.tensor([[ROUTES.index(route)]])}, [1]
    )


STANDING = (0.0, -15.0, 0.0, 0.0, NORTH)
CROSSING = (-22.0, -22.0, 9.0, 0.0, 0.0)  # meets the ego where it is in 22 / 9 s


@pytest.mark.parametrize("other", [STANDING, CROSSING])
def test_cautious_brakes_for_who_is_in_the_way_and_blind_does_not(other):
    free = CautiousDriver()(view())["action"]
    assert free[0, 0].abs() < 1e-6  # at 9 m/s already
    assert CautiousDriver()(view(other))["action"][0, 0] < -0.5
    assert torch.equal(Driver()(view(other))["action"], free)


@pytest.mark.parametrize(
    "other",
    [
        (4.0, -10.0, 0.0, -9.0, NORTH),  # beside, same way, same speed
        (-4.0, -40.0, 0.0, 9.0, -NORTH),  # oncoming, on its own side
        (0.0, 25.0, 0.0, -9.0, NORTH),  # behind
        (-22.0, -22.0, -9.0, 0.0, math.pi),  # driving away
    ],
)
def test_cautious_drives_on_past_who_is_not_in_the_way(other):
    assert torch.equal(CautiousDriver()(view(other))["action"], CautiousDriver()(view())["action"])


def target_speed(driver, tensordict):
    """What a driver aims for, m/s, from its proportional controller's a_x / 5 m/s^2."""
    acceleration = 5 * driver(tensordict)["action"][0, 0].item()
    return tensordict["ego"][0, 3].item() + acceleration / 1.5


def test_cautious_waits_at_the_line_rather_than_creep_into_the_box():
    # At two thirds of its speed it would pass before the other, and stand in the box if that fails.
    other = (-22.0, -24.0, 9.0, 0.0, 0.0)
    scene = {"y": 20.0, "speed": 3.0}  # the centre may come as far as y = 18.5 m
    limit = math.sqrt(2 * 3.0 * 1.5)  # m/s, from which 3 m/s^2 stop it there
    assert target_speed(CautiousDriver(), view(other, **scene)) <= limit + 1e-3
    assert target_speed(CautiousDriver(), view(**scene)) > limit + 2.0


def test_cautious_passes_closer_to_who_stands_than_to_who_drives():
    beside = (2.8, -15.0)  # 0.8 m of room between the two bodies
    standing, driving = (*beside, 0.0, 0.0, NORTH), (*beside, 0.0, -3.0, NORTH)
    free = CautiousDriver()(view())["action"]
    assert torch.equal(CautiousDriver()(view(standing))["action"], free)
    assert CautiousDriver()(view(driving))["action"][0, 0] < -0.1


def test_cautious_ignores_absent_rows():
    tensordict = view(STANDING)
    tensordict["vehicles"][0, 0, 0] = 0.0
    assert torch.equal(CautiousDriver()(tensordict)["action"], CautiousDriver()(view())["action"])
    none = view(rows=1)
    assert torch.equal(CautiousDriver()(none)["action"], CautiousDriver()(view())["action"])


def test_cautious_batches_give_what_singles_give():
    singles = [view(), view(STANDING), view(CROSSING, route="lt"), view(STANDING, CROSSING)]
    batch = torch.cat(singles)
    expected = torch.cat([CautiousDriver()(single)["action"] for single in singles])
    assert torch.allclose(CautiousDriver()(batch)["action"], expected, atol=1e-6)
    shaped = CautiousDriver()(batch.reshape(2, 2))["action"]
    assert torch.allclose(shaped.reshape(4, 2), expected, atol=1e-6)


def views(count):
    """Observations [count] of an ego that is everywhere else a little further on."""
    tensordict = torch.cat([view()] * count)
    tensordict["ego"][:, 2] -= 0.01 * torch.arange(count)
    return tensordict


def test_random_actions_are_of_the_seed_and_of_what_is_seen():
    batch = views(5)
    action = RandomDriver(seed=1)(batch.clone())["action"]
    assert len(action.unique(dim=0)) == 5
    alone = [RandomDriver(seed=1)(batch[i : i + 1])["action"] for i in range(5)]
    assert torch.equal(torch.cat(alone), action)
    assert torch.equal(RandomDriver(seed=1)(batch.flip(0))["action"].flip(0), action)
    assert not torch.isclose(RandomDriver(seed=2)(views(5))["action"], action).any()
    batch["ego"] *= 1 + 1e-7  # the last bits are no part of it
    assert torch.equal(RandomDriver(seed=1)(batch)["action"], action)


def test_random_driver_draws_from_no_generator():
    state = torch.get_rng_state()
    RandomDriver()(views(2))
    assert torch.equal(torch.get_rng_state(), state)


def test_a_random_episode_is_the_same_alone_and_in_a_batch():
    scenario = Scenario(task="mixed", vehicles=4)
    seeds = torch.arange(5)
    rows = episode_rows(
        playing.play(RandomDriver(), BatchedIntersection(scenario, num_envs=5, seed=0), seeds),
        seeds,
        scenario,
    )
    for seed, row in zip(seeds.split(1), rows, strict=True):
        env = BatchedIntersection(scenario, num_envs=1, seed=0)
        (alone,) = episode_rows(playing.play(RandomDriver(), env, seed), seed, scenario)
        assert alone.pop("route") == row.pop("route")
        assert alone == pytest.approx(row, rel=1e-5)


def test_random_driver_is_uniform_on_the_box():
    action = RandomDriver(seed=3)(views(4000))["action"]
    assert action.shape == (4000, 2) and action.dtype == torch.float32
    quantiles = torch.quantile(action, torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0]), dim=0)
    expected = torch.tensor([-1.0, -0.5, 0.0, 0.5, 1.0])[:, None]
    assert (quantiles - expected).abs().max() < 0.06
    assert torch.corrcoef(action.T)[0, 1].abs() < 0.06
    assert torch.corrcoef(torch.stack([action[1:, 0], action[:-1, 0]]))[0, 1].abs() < 0.06
