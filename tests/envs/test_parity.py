"""The batched intersection against highway-env's classes, the road on them and the rules in NumPy.

Everything batched runs in float64 here, so that what differs is a fault and not rounding.
"""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from highway_env import utils
from highway_env.vehicle.behavior import IDMVehicle
from numpy_road import NumpyRoad
from numpy_routes import routes
from tensordict import TensorDict

from saferl.envs.intersection import SCENARIOS, IntersectionEnv, Scenario, Traffic
from saferl.envs.intersection.base import OUTCOMES
from saferl.envs.intersection.batched import advance, begin, look, vehicles_of
from saferl.envs.intersection.collision_cost import CollisionCost
from saferl.envs.intersection.drivers import CautiousDriver
from saferl.envs.intersection.geometry import ARM, LENGTH, WIDTH, frame, overlap
from saferl.envs.intersection.network import build_network
from saferl.envs.intersection.regulation import IntersectionRoad
from saferl.envs.intersection.roads import lane_frames, lane_project, lanes, pairs, zones
from saferl.envs.intersection.spawning import Drawn, draw_traffic
from saferl.envs.intersection.traffic import Vehicles, accelerate, drive_in, vehicle_states
from saferl.envs.intersection.vehicles import EgoVehicle, RouteVehicle
from saferl.envs.intersection.yielding import road_rules
from saferl.envs.seeding import episode_seeds

F64 = torch.float64


def double(state):
    return {k: v.double() if v.is_floating_point() else v for k, v in state.items()}


# --- shapes of things ----------------------------------------------------------------------------


def test_separating_axes_agree_with_highway_env_on_20000_pairs():
    rng = np.random.default_rng(0)
    a, b = rng.uniform([-5, -5, -np.pi], [5, 5, np.pi], (2, 20_000, 3))
    ours = overlap(torch.from_numpy(a), torch.from_numpy(b)).numpy()
    zero = np.zeros(2)
    theirs = [
        utils.are_polygons_intersecting(
            *(
                np.vstack([corners, corners[:1]])
                for corners in (
                    utils.rect_corners(p[:2], LENGTH, WIDTH, p[2]) for p in (one, other)
                )
            ),
            zero,
            zero,
        )[0]
        for one, other in zip(a, b, strict=True)
    ]
    assert 0.2 < np.mean(theirs) < 0.8
    np.testing.assert_array_equal(ours, theirs)


def test_poses_and_projections_are_those_of_highway_envs_lanes():
    network, table = build_network(), routes()
    for route, indexes in enumerate(table.lanes):
        lane = lanes(torch.tensor(route), torch.zeros(1, dtype=F64))
        for index, start in zip(indexes, (0.0, ARM, table.out[route]), strict=True):
            theirs = network.get_lane(index)
            s = np.linspace(0.01, theirs.length - 0.01, 9)
            at, heading = lane_frames(lane, torch.from_numpy(start + s))
            where = np.array([theirs.position(one, 0.0) for one in s])
            np.testing.assert_allclose(np.stack([at.x, at.y], -1), where, atol=1e-9)
            turn = heading.numpy() - np.array([theirs.heading_at(one) for one in s])
            np.testing.assert_allclose(np.cos(turn), 1.0, atol=1e-12)
            beside = torch.from_numpy(np.array([theirs.position(one, 1.2) for one in s]))
            again, lateral = lane_project(lane, beside[:, 0], beside[:, 1])
            np.testing.assert_allclose(again, start + s, atol=1e-8)
            np.testing.assert_allclose(lateral, 1.2, atol=1e-8)


# --- how one vehicle follows another -------------------------------------------------------------


def scene(*vehicles, ego=(2.0, 300.0, 0.0, 0.0, -np.pi / 2, 0.0), headway=1.2):
    """Vehicles (route, s, speed) [N, 1] with an ego that is far away, and their lanes."""
    route, s, speed = (torch.tensor(column)[:, None] for column in zip(*vehicles, strict=True))
    s, speed = s.double(), speed.double()
    yes = torch.ones_like(route, dtype=torch.bool)
    v = Vehicles(
        yes, route, s, speed, speed, torch.full_like(s, headway), ~yes,
        torch.full((len(s) + 1, 1), torch.inf, dtype=F64), ~yes, torch.full_like(s, torch.inf),
    )  # fmt: skip
    return v, lanes(route, s), torch.tensor([ego], dtype=F64)


@pytest.mark.parametrize("route", [0, 1, 6, 11, 13])
@pytest.mark.parametrize("speeds", [(8.0, 8.0), (9.0, 5.0), (6.5, 9.5), (3.0, 0.0)])
def test_idm_is_highway_envs_but_from_bumper_to_bumper(route, speeds):
    """highway-env divides distances between centres; with their length taken off both, ours."""
    gap, table, road = 14.0, routes(), SimpleNamespace(network=build_network())
    place, (v, ahead) = 30.0, speeds
    stock = IDMVehicle(
        road, table.pose(route, place)[:2], heading=table.pose(route, place)[2], speed=v,
        target_speed=9.0, enable_lane_change=False,
    )  # fmt: skip
    front = IDMVehicle(
        road, table.pose(route, place + gap)[:2], heading=table.pose(route, place)[2], speed=ahead
    )
    for name in ("COMFORT_ACC_MAX", "COMFORT_ACC_MIN", "DISTANCE_WANTED"):
        setattr(stock, name, getattr(RouteVehicle, name))
    stock.TIME_WANTED, stock.DELTA = 1.2, 4.0
    free = stock.acceleration(stock)
    share = (stock.desired_gap(stock, front) - LENGTH) / (stock.lane_distance_to(front) - LENGTH)
    expected = max(free - stock.COMFORT_ACC_MAX * share**2, -6.0)

    vehicles, lane, ego = scene((route, place, v), (route, place + gap, ahead))
    vehicles = vehicles._replace(desired=torch.full_like(vehicles.s, 9.0))
    ours = accelerate(vehicles, lane, pairs(vehicles.route), ego)
    assert ours[0].item() == pytest.approx(expected, abs=1e-9)
    alone, lane, ego = scene((route, place, v))
    alone = alone._replace(desired=torch.full_like(alone.s, 9.0))
    assert accelerate(alone, lane, pairs(alone.route), ego).item() == pytest.approx(free, abs=1e-9)


# --- who yields to whom --------------------------------------------------------------------------


def numpy_road(vehicles, ego):
    route, s, speed = (torch.tensor(column) for column in zip(*vehicles, strict=True))
    s, speed = s.double(), speed.double()
    yes = torch.ones_like(route, dtype=torch.bool)
    drawn = Drawn(yes, route, s, speed, torch.full_like(s, 1.2), ~yes)
    return NumpyRoad(drawn, torch.tensor(ego, dtype=F64), 1)


def decide(vehicles, lane, ego, ego_route=1):
    route, like = torch.tensor([ego_route]), vehicles.s
    zone = zones(vehicles.route, torch.cat([vehicles.route, route[None]]), like)
    return road_rules(vehicles, lane, lanes(route, like), zone, ego, torch.zeros(1, dtype=F64))


FAR = (2.0, 114.0, 0.0, 0.0, -np.pi / 2, 0.0)  # the ego, standing at the start of its arm


@pytest.mark.parametrize("places", [(80.0, 80.0), (90.0, 84.0), (96.5, 70.0), (99.0, 92.0)])
def test_who_yields_is_the_same_for_every_pair_of_routes(places):
    seen = set()
    for mine, other in itertools.product(range(16), repeat=2):
        if routes().approach[mine] == routes().approach[other]:
            continue
        cars = [(mine, places[0], 8.0), (other, places[1], 7.0)]
        road = numpy_road(cars, FAR)
        road.enforce_road_rules()
        decided = decide(*scene(*cars, ego=FAR))
        held = decided.held[:, 0].numpy()
        np.testing.assert_array_equal(held, road.held)
        np.testing.assert_allclose(decided.stop[:, 0], road.stop, atol=1e-9)
        assert not held.all()  # two never wait for each other
        seen.add(tuple(held.tolist()))
    assert len(seen) > 1


def scene_of_ten(seed):
    """Vehicles drawn for an ego that comes from 45 m before the box, its state and its route."""
    route = seed % 4
    x, y, phi = routes().pose(route, 70.0)
    ego = torch.tensor([x, y, 6.0, 0.0, phi, 0.0], dtype=F64)
    traffic = Traffic(heedless=0.2, headways=(0.6, 2.0))
    drawn = draw_traffic(traffic, torch.tensor([route]), ego[None], episode_seeds(seed, 1))
    return Drawn(*(value[0] for value in drawn)), ego, route


def test_scenes_of_ten_are_decided_alike_all_the_way():
    assert sum(waits_in_a_scene(seed) for seed in range(6)) > 20


def waits_in_a_scene(seed) -> int:
    """Compares decisions and accelerations for 15 s, the batch copied from NumPy's every 0.2 s."""
    drawn, start, route = scene_of_ten(seed)
    car = EgoVehicle(IntersectionRoad(), start, route)
    road, own_route = NumpyRoad(drawn, start, route), torch.tensor([route])
    waits = 0
    for tick in range(75):
        count = len(road.s)
        column = {k: torch.from_numpy(np.array(getattr(road, k)))[:, None] for k in (
            "route", "s", "speed", "desired", "headway", "heedless", "entered", "held", "stop"
        )}  # fmt: skip
        vehicles = Vehicles(torch.ones(count, 1, dtype=torch.bool), **column)
        lane, own = lanes(vehicles.route, vehicles.s), lanes(own_route, vehicles.s)
        zone = zones(vehicles.route, torch.cat([vehicles.route, own_route[None]]), vehicles.s)
        time = torch.full((1,), road.time, dtype=F64)
        decided = road_rules(vehicles, lane, own, zone, car.state[None], time)
        road.enforce_road_rules()
        np.testing.assert_array_equal(decided.held[:, 0], road.held)
        np.testing.assert_allclose(decided.entered[:, 0], road.entered)
        np.testing.assert_allclose(decided.stop[:, 0], road.stop, atol=1e-9)
        waits += int(road.held.any())
        road.next_pass = np.inf  # decided above
        for _ in range(3):
            states = torch.from_numpy(road.states())
            decided = decided._replace(
                s=torch.from_numpy(road.s)[:, None], speed=torch.from_numpy(road.speed)[:, None]
            )
            torch.testing.assert_close(vehicle_states(decided, lane)[0][:, :4], states[:, :4])
            ours = accelerate(decided, lane, pairs(decided.route), car.state[None])[:, 0]
            road.act()
            np.testing.assert_allclose(ours, road.acceleration, atol=1e-9)
            car.step(1 / 15)
            road.ego = car.state
            road.step(1 / 15)
            if len(road.s) != count:
                break
        if tick > 25:
            car.act(torch.tensor([-2.0, 0.0]))
    return waits


@pytest.mark.parametrize("seed", range(10, 14))
def test_the_road_of_objects_goes_on_as_the_rules_in_numpy_do(seed):
    """Both play the same scene for 20 s, neither told what the other does."""
    drawn, start, route = scene_of_ten(seed)
    road, waits = IntersectionRoad(), 0
    car = EgoVehicle(road, start, route)
    road.populate(car, drive_in(drawn, F64))
    theirs = NumpyRoad(drawn, start, route)
    for tick in range(300):
        if tick > 75:
            car.act(torch.tensor([-2.0, 0.0]))
        road.act()
        theirs.act()
        ours = road.surrounding
        assert ours.present.numpy().nonzero()[0].tolist() == theirs.number.tolist()
        np.testing.assert_array_equal(ours.held[ours.present], theirs.held)
        np.testing.assert_allclose(ours.stop[ours.present], theirs.stop, atol=1e-9)
        there = torch.cat([ours.present, torch.ones(1, dtype=torch.bool)])
        np.testing.assert_allclose(ours.entered[there], theirs.entered, atol=1e-9)
        np.testing.assert_allclose(road.acceleration[ours.present], theirs.acceleration, atol=1e-7)
        waits += int(theirs.held.any())
        road.step(1 / 15)
        theirs.ego = car.state
        theirs.step(1 / 15)
        np.testing.assert_allclose(
            road.states[road.surrounding.present][:, :3], theirs.states()[:, :3], atol=1e-7
        )
    assert waits > 10
    assert len(theirs.s) < int(drawn.present.sum())  # some have left by then


# --- whole episodes ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("task", "name", "observation"),
    [
        *(("gs", name, "route") for name in SCENARIOS),
        ("lt", "noisy", "route"),
        ("rt", "noisy", "world"),
        ("gs", "nominal", "world"),
    ],
)
def test_an_episode_is_the_same_on_both_backends(task, name, observation):
    """Observation, reward, cost and ends, decision by decision, at the rates of training and test."""
    frequency = 10 if task == "gs" else 5
    settings = {"policy_frequency": frequency, "observation": observation}
    # Unlike a prediction, what a crash itself costs is known to no observation.
    settings["cost"] = CollisionCost(crash=0.7)
    scenario = Scenario(task=task, scenario=name, **settings)
    env = IntersectionEnv(task=task, scenario=name, **settings)
    seed = int(episode_seeds(7, 3)[["lt", "gs", "rt"].index(task)])
    seen, _ = env.reset(seed=seed)
    state = begin(scenario, torch.tensor([seed]))
    state["ego"] = env.ego.state[None].clone()  # before it was rounded to float32
    drawn = draw_traffic(scenario.traffic, state["route"], state["ego"], state["seed"])
    for name_, values in (("s", drawn.s), ("speed", drawn.speed), ("desired", drawn.speed)):
        state["vehicle_" + name_] = values
    state["vehicle_headway"] = drawn.headway
    state = double(state)
    state |= look(scenario, state)[0]
    driver, generator = CautiousDriver(), torch.Generator().manual_seed(seed)
    for _ in range(scenario.horizon):
        view = {"ego": state["seen_ego"], "vehicles": state["seen_vehicles"]}
        np.testing.assert_allclose(view["ego"][0], seen["ego"], atol=1e-4)
        np.testing.assert_allclose(view["vehicles"][0], seen["vehicles"], atol=1e-4)
        present = vehicles_of(state).present[:, 0].tolist()
        assert present == env.road.surrounding.present.tolist()
        reads = TensorDict({**view, "route": state["route"][:, None]}, batch_size=[1])
        action = driver(reads)["action"]
        action = (action + 0.2 * torch.randn(1, 2, generator=generator)).clamp(-1, 1)
        state, out = advance(scenario, state, action)
        seen, reward, terminated, truncated, info = env.step(action[0].numpy())
        assert float(out["reward"]) == pytest.approx(reward, abs=1e-6)
        assert float(out["cost"]) == pytest.approx(info["cost"], abs=1e-6)
        assert (bool(out["terminated"]), bool(out["truncated"])) == (terminated, truncated)
        assert [bool(out[key]) for key in OUTCOMES] == [info[key] for key in OUTCOMES]
        if terminated or truncated:
            break


def test_frames_are_poses():
    heading = torch.tensor([0.3, 2.0])
    at = frame(torch.zeros(2), torch.ones(2), heading)
    torch.testing.assert_close(torch.atan2(at.sin, at.cos), heading)
