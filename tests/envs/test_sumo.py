"""SUMO's drivers on our road: its geometry, whose car is where, seeds, replay, processes, and what a test says of it."""

from __future__ import annotations

import copy
import math
import pickle
import xml.etree.ElementTree as ET
from functools import partial
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from batch import reset, step
from shapely import LineString, Point
from small import SMALL
from torchrl.envs import ParallelEnv
from torchrl.envs.utils import check_env_specs

from saferl.envs.intersection import BatchedIntersection, Scenario
from saferl.envs.intersection.base import OUTCOMES
from saferl.envs.intersection.drivers import Driver
from saferl.envs.intersection.dynamics import step_ego, to_physical
from saferl.envs.intersection.geometry import ARM, LENGTH, overlap
from saferl.envs.intersection.observation import observe
from saferl.envs.intersection.roads import MOVEMENTS, lane_frames, lanes
from saferl.envs.intersection.scenario import SUBSTEPS
from saferl.envs.intersection.sumo import SumoIntersection, installed, placed
from saferl.envs.intersection.sumo_net import MANNERS, network
from saferl.envs.seeding import episode_seeds
from saferl.evaluation.play import evaluate, play

there = pytest.mark.skipif(not installed(), reason="needs saferl[sumo]")
SEEN = ("ego", "vehicles", "route", *OUTCOMES)
RESULT = (*SEEN, "reward", "cost", "terminated", "truncated", "done")


@pytest.fixture(scope="module")
def make():
    """Environments that are closed at the end; those of the same settings are the same one."""
    made = {}

    def get(num_envs: int = 2, drivers: str = "perfect", **task) -> SumoIntersection:
        key = (num_envs, drivers, *sorted(task.items()))
        if key not in made:
            made[key] = SumoIntersection(Scenario(**task), num_envs, seed=0, drivers=drivers)
        return made[key]

    yield get
    for env in made.values():
        env.close()


def same(a, b, keys=RESULT) -> bool:
    return all(torch.equal(a[key], b[key]) for key in keys)


def gentle(count: int, *shape: int, seed: int = 0) -> torch.Tensor:
    """Random actions that mostly keep a car moving on the road: little steering."""
    generator = torch.Generator().manual_seed(seed)
    action = torch.rand((count, *shape, 2), generator=generator) * 2 - 1
    return action * torch.tensor([0.5, 0.05])


def where(env: SumoIntersection, name: str) -> list:
    """Position, angle and speed of a car as SUMO says them."""
    asked = ("vehicle.getPosition", "vehicle.getAngle", "vehicle.getSpeed")
    return [env._ask("look", {0: (function, name)})[0] for function in asked]


def test_without_the_extra_it_is_refused_in_one_line(command, monkeypatch):
    monkeypatch.setattr(
        "saferl.envs.intersection.sumo.find_spec",
        lambda name: None if name in ("libsumo", "sumo") else find_spec(name),
    )
    with pytest.raises(SystemExit, match=r"needs libsumo .*: pip install 'saferl\[sumo\]'\.$"):
        command("train", "config", *SMALL, "algo=sac", "env=sumo", "out=run")


def test_unknown_drivers_are_refused():
    with pytest.raises(ValueError, match="drivers must be one of perfect, .*, got 'drunk'"):
        SumoIntersection(Scenario(), drivers="drunk")


# --- the road ------------------------------------------------------------------------------------


def shapes() -> dict[str, LineString]:
    """The middle line of each lane of SUMO's network, in our coordinates."""
    found = {}
    for lane in ET.parse(network()).iter("lane"):
        points = [point.split(",") for point in lane.attrib["shape"].split()]
        found[lane.attrib["id"]] = LineString([(float(x), -float(y)) for x, y in points])
    return found


@there
def test_its_lanes_are_ours():
    """Approach, way through the box and exit of all 16 routes, within two centimetres, and as long to 1 cm."""
    net, lines = ET.parse(network()).getroot(), shapes()
    links = {
        (link.attrib["from"], link.attrib["fromLane"], link.attrib["to"]): link.attrib
        for link in net.iter("connection")
    }
    assert sum(name.startswith("in") for name, *_ in links) == 16
    for route in range(16):
        arm, (movement, lane) = route // 4, MOVEMENTS[route % 4]
        out = (arm + {"left": 1, "straight": 2, "right": 3}[movement]) % 4
        first = links[f"in{arm}", str(1 - lane), f"out{out}"]
        assert first["toLane"] == str(1 - lane)
        way = [f"in{arm}_{1 - lane}", first["via"], f"out{out}_{1 - lane}"]
        onwards = links.get((first["via"].rpartition("_")[0], "0", f"out{out}"), {})
        if "via" in onwards:  # a bend in two parts, between which a car may wait
            way.insert(2, onwards["via"])
        points = [point for name in way for point in lines[name].coords]
        theirs, ours = LineString(points), lanes(torch.tensor(route), torch.zeros(1).double())
        s = torch.linspace(0, float(ours.out) + ARM, 400, dtype=torch.float64)
        place, _ = lane_frames(ours, s)
        off = [theirs.distance(Point(x, y)) for x, y in zip(place.x, place.y, strict=True)]
        assert max(off) < 0.02
        assert theirs.length == pytest.approx(float(ours.out) + ARM, abs=0.01)


# --- cars and the ego ----------------------------------------------------------------------------


@there
def test_specs(make):
    check_env_specs(make(task="mixed"), seed=0)
    ours = BatchedIntersection(Scenario(task="mixed"), num_envs=2)
    assert make(task="mixed").observation_spec == ours.observation_spec
    assert make(task="mixed").full_reward_spec == ours.full_reward_spec


@there
def test_an_episode_begins_with_the_scene_of_the_other_backends(make):
    seeds = episode_seeds(3, 2)
    ours = BatchedIntersection(Scenario(task="gs"), num_envs=2, seed=0)
    assert same(reset(make(task="gs"), seeds), reset(ours, seeds), SEEN)


@there
def test_the_ego_is_where_its_dynamics_bring_it_in_both_worlds(make):
    env = make(1, task="lt")
    reset(env, episode_seeds(0, 1))
    state = env.scene()[0]
    for action in gentle(20, 1):
        step(env, action)
        for _ in range(SUBSTEPS):
            state = step_ego(state, to_physical(action), env.task.dt)
        assert torch.equal(env.scene()[0], state)
    front = state[0, :2] + LENGTH / 2 * torch.stack([state[0, 4].cos(), state[0, 4].sin()])
    (x, y), angle, speed = where(env, "ego")
    assert [x, -y] == pytest.approx(front.tolist(), abs=1e-4)
    assert math.radians(angle - 90) == pytest.approx(float(state[0, 4]), abs=1e-4)
    assert speed == pytest.approx(float(state[0, 2]), abs=0.3)  # the mean of its last step


@there
def test_cars_are_where_sumo_has_them(make):
    """On their lane, in its direction, with the speed that their steps show, and never in each other."""
    env, decisions = make(2, task="mixed"), 60
    reset(env, episode_seeds(5, 2))
    before = None
    for _ in range(decisions):
        step(env, (-1.0, 0.0))
        _, vehicles = env.scene()
        pose = torch.from_numpy(env.snapshot(0)[1])[:, [0, 1, 4]]
        pose = pose[~pose[:, 0].isnan()]
        assert overlap(pose[:, None], pose).sum() == len(pose)
        for number in vehicles.present[:, 0].nonzero().flatten().tolist():
            (x, y), angle, speed = where(env, str(number))
            lane = lanes(vehicles.route[number, 0], vehicles.s)
            place, heading = lane_frames(lane, vehicles.s[number, 0] + LENGTH / 2)
            assert [x, -y] == pytest.approx([float(place.x), float(place.y)], abs=0.02)
            assert speed == pytest.approx(float(vehicles.speed[number, 0]))
            turned = math.remainder(math.radians(angle - 90) - float(heading), math.tau)
            assert abs(turned) < 0.3  # SUMO's is of the chord from bumper to bumper
        if before is not None:
            both = vehicles.present & before.present
            moved = (vehicles.s - before.s)[both] * env.task.policy_frequency
            mean = (vehicles.speed + before.speed)[both] / 2
            assert torch.allclose(moved, mean, atol=0.6)
        before = vehicles
    assert vehicles.present.sum() < vehicles.present.numel()  # some have left


@there
def test_an_observation_is_ours_of_a_scene_made_by_hand(make):
    """A car that comes from the left, told by SUMO, against the observation of the same state."""
    env = make(1, task="gs", vehicles=1)
    reset(env, episode_seeds(0, 1))
    _, vehicles = env.scene()
    vehicles = vehicles._replace(
        route=torch.tensor([[4 * 1 + 1]])
    )  # straight, inner, from the west
    vehicles = placed(vehicles, [[(0, -30.0, -2.0, 7.0)]])
    assert vehicles.present.all() and vehicles.s.item() == pytest.approx(85.0 - LENGTH / 2)
    ego = torch.tensor([[2.0, 40.0, 9.0, 0.0, -math.pi / 2, 0.0]])
    car = torch.tensor([[[-30.0 - LENGTH / 2, 2.0, 7.0, 0.0, 0.0, 0.0]]])
    env._state["ego"], env._state["route"] = ego, torch.tensor([1])
    for name, value in vehicles._asdict().items():
        env._state[f"vehicle_{name}"] = value.movedim(0, -1)
    seen, others = env.snapshot(0)
    assert np.allclose(others, car[0], atol=1e-4)
    own, table, _ = observe(ego, car, torch.ones(1, 1, dtype=torch.bool), torch.tensor([1]))
    again = observe(
        ego, torch.from_numpy(others).float()[None], vehicles.present.T, torch.tensor([1])
    )
    assert torch.allclose(own, again[0], atol=1e-4) and torch.allclose(table, again[1], atol=1e-4)
    assert np.allclose(seen, ego[0])


@there
def test_the_blind_crash_by_our_axes_where_sumo_reports_less(make):
    env = make(8, task="lt", policy_frequency=10)
    env._options[env._options.index("none", -8)] = "warn"
    steps = play(Driver(), env, episode_seeds(0, 8))
    hit = torch.stack([each["next", "collision"] for each in steps]).any(0).flatten()
    assert 0 < hit.sum() < 8
    for index in hit.nonzero().flatten().tolist():
        ego, others = env.snapshot(index)
        pose = torch.from_numpy(others)[:, [0, 1, 4]]
        touched = overlap(torch.from_numpy(ego)[[0, 1, 4]], pose) & ~pose[:, 0].isnan()
        assert touched.any()
    told = env._ask("look", {index: ("simulation.getCollisions",) for index in range(8)})
    assert sum(map(bool, told)) < hit.sum()


@there
def test_cars_stop_for_an_ego_that_stands_in_the_box(make):
    """Nobody drives into it for 20 s, as it would if it were not seen."""
    env = make(8, task="gs", policy_frequency=5)
    reset(env, episode_seeds(1, 8))
    middle = torch.tensor([[2.0, 6.0, 0.0, 0.0, -math.pi / 2, 0.0]]).repeat(8, 1)
    early, hits = env.scene()[1].s.max() < ARM, torch.zeros(8, dtype=torch.bool)
    env._state["ego"] = middle
    for _ in range(100):
        hits |= step(env, (-1.0, 0.0))["collision"].flatten()
    assert early and hits.sum() <= 1


@there
def test_an_ego_that_stands_far_before_the_box_holds_nobody_up(make):
    """An oncoming car that turns left would wait for it, if it were taken for somebody who is about to go."""
    env = make(8, task="gs", policy_frequency=5)
    reset(env, episode_seeds(1, 8))
    env._state["ego"] = env._state["ego"] * torch.tensor([1.0, 1.0, 0.0, 0.0, 1.0, 0.0])
    for _ in range(110):
        view = step(env, (-1.0, 0.0))
    _, vehicles = env.scene()
    lane = lanes(vehicles.route, vehicles.s)
    before_the_box = vehicles.present & (vehicles.s < ARM) & (lane.approach >= 2)  # not behind it
    assert not before_the_box.any() and not view["collision"].any()


# --- episodes ------------------------------------------------------------------------------------


@there
@pytest.mark.parametrize("drivers", MANNERS)
def test_the_same_seed_is_the_same_episode_whoever_plays_beside_it(make, drivers: str):
    seeds, actions = episode_seeds(4, 2), gentle(15, 2)
    env = make(2, drivers, task="mixed")
    first = [reset(env, seeds).clone(), *(step(env, action).clone() for action in actions)]
    again = [reset(env, seeds).clone(), *(step(env, action).clone() for action in actions)]
    assert same(first[0], again[0], SEEN)
    assert all(same(a, b) for a, b in zip(first[1:], again[1:], strict=True))
    alone = make(1, drivers, task="mixed")
    reset(alone, seeds[1:])
    for action, whole in zip(actions, first[1:], strict=True):
        here = step(alone, action[1:])
        assert all(torch.allclose(here[k].float(), whole[k][1:].float(), atol=1e-4) for k in RESULT)


@there
def test_drivers_differ(make):
    """The same scene: perfect ones, imperfect ones, and half of them disobedient."""
    speeds = []
    for drivers in MANNERS:
        env = make(2, drivers, task="mixed")
        reset(env, episode_seeds(4, 2))
        for _ in range(15):
            step(env, (-0.2, 0.0))
        speeds.append(env.scene()[1].speed)
    assert not torch.equal(speeds[0], speeds[1])
    cars = [
        (i, str(n))
        for i in (0, 1)
        for n in env.scene()[1].present[:, i].nonzero().flatten().tolist()
    ]
    kinds = {
        env._ask("look", {i: ("vehicle.getTypeID", name)})[0].split("@")[0] for i, name in cars
    }
    assert kinds == {"obedient", "heedless"}


@there
@pytest.mark.parametrize("how", ["state_dict", "deepcopy", "pickle"])
def test_an_episode_goes_on_by_replay(make, how: str):
    env = make(2, "imperfect", task="mixed")
    reset(env, episode_seeds(6, 2))
    actions = gentle(12, 2, seed=1)
    for action in actions[:6]:
        step(env, action)
    if how == "state_dict":
        other = SumoIntersection(env.task, 2, seed=9, drivers="imperfect")
        other.load_state_dict(env.state_dict())
    else:
        other = copy.deepcopy(env) if how == "deepcopy" else pickle.loads(pickle.dumps(env))
    try:
        for action in actions[6:]:
            assert same(step(env, action), step(other, action))
    finally:
        other.close()


@there
def test_cars_come_and_go_with_respawn(make):
    env = make(1, task="gs", scenario="dense")
    reset(env, episode_seeds(2, 1))
    before, entered = env.scene()[1].present.clone(), 0
    for _ in range(60):
        step(env, (-1.0, 0.0))
        now = env.scene()[1].present
        entered += int((now & ~before).sum())
        before = now.clone()
    told = env._ask("move", {0: ([(2.0, -55.0, 0.0)],)})[0][0]
    assert entered > 0 and {number for number, *_ in told} >= set(
        now[:, 0].nonzero().flatten().tolist()
    ) - {n for n in range(len(now)) if not before[n, 0]}


@there
def test_two_play_side_by_side_and_end_with_their_environment():
    """Each simulation has a process of its own."""
    env, other = (SumoIntersection(Scenario(task="gs"), 1, seed=seed) for seed in (0, 1))
    a, b = reset(env).clone(), reset(other).clone()
    assert not torch.equal(a["ego"], b["ego"])
    process = env._process
    env.close()
    assert process.poll() == 0
    step(other, (0.0, 0.0))
    other.close()


@there
@pytest.mark.slow
def test_workers_of_torchrl_have_simulations_of_their_own():
    make = partial(SumoIntersection, Scenario(task="gs"), 1)
    several = ParallelEnv(2, make, mp_start_method="spawn")
    start = several.reset()
    assert not torch.equal(start["ego"][0], start["ego"][1])
    several.close()


@there
def test_a_simulation_that_fails_says_so(make):
    env = make(1, task="gs", vehicles=0)
    reset(env)
    with pytest.raises(RuntimeError, match="SUMO failed in look: .*nobody"):
        env._ask("look", {0: ("vehicle.getAngle", "nobody")})
    assert reset(env)["ego"].isfinite().all()  # it goes on


@there
def test_training_test_and_pictures(command, tmp_path):
    """By command: a policy learns there, is tested there, and an episode is drawn, traced and explained."""
    few = [option for option in SMALL if not option.startswith("env.")]
    command("train", "config", *few, "algo=sac", "env=sumo", "env.num_envs=2", "task=gs", "out=run")
    assert (tmp_path / "run/evaluation/metrics.json").is_file()
    command(
        "evaluate", "evaluate", "policy=blind", "env=sumo", "env.drivers=disobedient", "task=lt", "episodes=6",
        "env.num_envs=6", "episode=0", "draw_format=png", "trace=all", "why=true", "out=test",
    )  # fmt: skip
    assert (tmp_path / "test/episode_0.png").is_file() and (tmp_path / "test/trace.npz").is_file()
    assert len((tmp_path / "test/crashes.csv").read_text().splitlines()) > 1


@there
def test_a_picture_shows_the_scene(make):
    env = make(2, task="mixed")
    reset(env, episode_seeds(4, 2))
    picture = env.render(1)
    assert picture.shape == (600, 600, 3) and picture.dtype == np.uint8


@there
def test_rows_are_those_of_every_backend(make):
    rows = evaluate(Driver(), make(2, task="mixed"), 2, seed=0, progress=False)
    ours = BatchedIntersection(Scenario(task="mixed"), 2)
    assert rows[0].keys() == evaluate(Driver(), ours, 2, seed=0, progress=False)[0].keys()
