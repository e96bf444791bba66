"""The road network, the repaired regulation and the traffic against known truth."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from highway_env import utils
from numpy_routes import rectangles_overlap, routes

from saferl.envs.intersection.geometry import (
    ARM,
    LENGTH,
    ROUTES,
    WIDTH,
    line_pose,
    overlap,
    reference_lines,
)
from saferl.envs.intersection.network import build_network
from saferl.envs.intersection.regulation import IntersectionRoad
from saferl.envs.intersection.roads import BODY_STEP, bodies, lanes, pairs, zones
from saferl.envs.intersection.spawning import Drawn, Traffic, draw_traffic
from saferl.envs.intersection.traffic import drive_in
from saferl.envs.intersection.vehicles import EgoVehicle
from saferl.envs.seeding import episode_seeds

DT = 1 / 15
SOUTH, WEST, NORTH, EAST = 0, 4, 8, 12  # first route of each arm
LEFT, INNER, OUTER, RIGHT = 0, 1, 2, 3


AWAY = (OUTER, -100.0, 0.0)  # an ego that stands where nobody comes


def make_road(*vehicles: tuple[int, float, float], ego: tuple = AWAY) -> IntersectionRoad:
    """A road with vehicles (route, arc length, speed) and an ego (route, s, speed)."""
    road = IntersectionRoad()
    route, s, speed = ego
    x, y, phi = routes().pose(route, np.float64(s))
    state = torch.tensor([x, y, speed, 0.0, phi, 0.0], dtype=torch.float64)
    car = EgoVehicle(road, state, route)
    route, s, speed = (torch.tensor(column) for column in zip(*vehicles, strict=True))
    s, speed = s.double(), speed.double()
    yes = torch.ones(len(route), dtype=torch.bool)
    drawn = Drawn(yes, route, s, speed, torch.full_like(s, 1.2), ~yes)
    road.populate(car, drive_in(drawn, torch.float64))
    return road


def poses(road: IntersectionRoad) -> np.ndarray:
    """Poses [N, 3] of the vehicles that are on the road."""
    return road.states[road.surrounding.present][:, [0, 1, 4]].numpy()


def overlaps(road: IntersectionRoad) -> bool:
    pose = poses(road)
    return rectangles_overlap(pose[:, None], pose).sum() > len(pose)


def play(road: IntersectionRoad, seconds: float):
    for _ in range(round(seconds / DT)):
        road.act()
        road.step(DT)
        yield road


def test_lanes_and_priorities_are_as_in_highway_env():
    network = build_network()
    for arm in range(4):
        high = 3 if arm in (1, 3) else 1
        ahead = network.graph[f"ir{arm}"]
        assert [lane.priority for lane in ahead[f"il{(arm + 1) % 4}"]] == [high - 1]  # left
        assert [lane.priority for lane in ahead[f"il{(arm + 2) % 4}"]] == [high, high]
        assert [lane.priority for lane in ahead[f"il{(arm + 3) % 4}"]] == [high]
        for edge in ((f"o{arm}", f"ir{arm}"), (f"il{arm}", f"o{arm}")):
            lanes = network.graph[edge[0]][edge[1]]
            assert [(lane.length, lane.width) for lane in lanes] == [(100.0, 4.0)] * 2
    inner, outer = network.graph["o0"]["ir0"]
    np.testing.assert_allclose(inner.position(60.0, 0.0), [2.0, 55.0])
    np.testing.assert_allclose(outer.position(60.0, 0.0), [6.0, 55.0])
    assert network.graph["ir0"]["il1"][0].radius == 17.0
    assert network.graph["ir0"]["il3"][0].radius == 9.0


def test_routes_run_along_the_networks_lanes():
    network, table = build_network(), routes()
    for route, indexes in enumerate(table.lanes):
        for index, begin in zip(indexes, (0.0, ARM, table.out[route]), strict=True):
            lane = network.get_lane(index)
            for s in np.linspace(0.01, lane.length - 0.01, 7):
                pose = table.pose(route, np.float64(begin + s))
                np.testing.assert_allclose(pose[:2], lane.position(s, 0.0), atol=1e-9)
                turn = utils.wrap_to_pi(pose[2] - lane.heading_at(s))
                assert abs(turn) < 1e-9


@pytest.mark.parametrize("route", range(4))
def test_the_south_routes_are_the_egos_reference_lines(route):
    s = np.linspace(0.0, 220.0, 111)
    lines = reference_lines(torch.tensor(route), torch.zeros(1, dtype=torch.float64))[0]
    expected = line_pose(lines.expand(len(s), 4, 6), torch.from_numpy(s)).numpy()
    pose = routes().pose(route, s)
    np.testing.assert_allclose(pose[:, :2], expected[:, :2], atol=1e-9)
    np.testing.assert_allclose(np.cos(pose[:, 2]), np.cos(expected[:, 2]), atol=1e-9)
    assert ROUTES[route] == ("lt", "gs_inner", "gs_outer", "rt")[route]


def test_the_tables_are_those_read_off_highway_envs_lanes():
    table, everyone = routes(), torch.arange(16)
    lane = lanes(everyone, torch.zeros(1, dtype=torch.float64))
    read = {
        name: getattr(table, name)
        for name in ("heading", "out", "priority", "turn_speed", "approach")
    }
    (read["x"], read["y"]), (read["out_x"], read["out_y"]) = table.start.T, table.leave.T
    for whose, angle in (("", table.heading), ("out_", table.turned)):
        read |= {whose + "cos": np.cos(angle), whose + "sin": np.sin(angle)}
    bend = np.abs(table.curvature)
    read |= {"side": np.sign(table.curvature), "radius": 1 / np.where(bend == 0, 1.0, bend)}
    assert set(read) == set(lane._fields)
    for name, value in read.items():
        np.testing.assert_allclose(getattr(lane, name), value, rtol=1e-15, atol=1e-15, err_msg=name)
    zone = torch.stack(zones(everyone, everyone, lane.x), -1)
    np.testing.assert_array_equal(zone, table.zone)
    i, j = np.arange(16)[:, None], np.arange(16)
    for k in range(table.body.shape[2]):
        s = torch.full((16,), k * BODY_STEP, dtype=torch.float64)
        where, aligned = bodies(pairs(everyone), s)
        theirs = table.body[i % 4, (j - i // 4 * 4) % 16, k]
        np.testing.assert_allclose(where - s, theirs[..., 0], atol=1e-12)
        np.testing.assert_allclose(aligned, theirs[..., 1], atol=1e-12)


def test_projection_inverts_the_pose():
    table = routes()
    for route in range(16):
        s = np.linspace(1.0, table.out[route] + 50.0, 60)
        lateral = np.linspace(-1.5, 1.5, 60)
        x, y, heading = table.pose(route, s).T
        points = np.stack([x - lateral * np.sin(heading), y + lateral * np.cos(heading)], -1)
        got_s, got_lateral = table.project(route, points)
        np.testing.assert_allclose(got_s, s, atol=1e-8)
        np.testing.assert_allclose(got_lateral, lateral, atol=1e-8)


def test_rectangles_agree_with_two_other_separating_axis_tests():
    rng = np.random.default_rng(3)
    a, b = rng.uniform([-4, -4, -7], [4, 4, 7], (2, 600, 3))
    ours = rectangles_overlap(a, b)
    np.testing.assert_array_equal(ours, overlap(torch.from_numpy(a), torch.from_numpy(b)).numpy())
    for k in range(0, 600, 3):
        polygons = [
            np.vstack([box, box[:1]])
            for box in (utils.rect_corners(p[k, :2], LENGTH, WIDTH, p[k, 2]) for p in (a, b))
        ]
        assert utils.are_polygons_intersecting(*polygons, np.zeros(2), np.zeros(2))[0] == ours[k]
    assert 0.2 < ours.mean() < 0.8


@pytest.mark.parametrize(
    ("a", "b", "truth"),
    [
        # nose to tail on a diagonal, 4 m apart: overlap
        ((0.0, 0.0, np.pi / 4), (2.83, 2.83, np.pi / 4), True),
        # side by side on a diagonal, 3 m apart: none
        ((0.0, 0.0, np.pi / 4), (2.12, -2.12, np.pi / 4), False),
        # the nose of one in the flank of the other
        ((0.0, 0.0, 0.0), (0.0, 3.4, np.pi / 2), True),
        ((0.0, 0.0, 0.0), (0.0, 3.6, np.pi / 2), False),
    ],
)
def test_rectangles_on_diagonals(a, b, truth):
    assert bool(rectangles_overlap(np.array(a), np.array(b))) is truth


def test_zones_bound_every_overlap():
    table, rng = routes(), np.random.default_rng(1)
    # Straight from the south (x = 2) and from the west (y = 6): the nose reaches the other's
    # swept band at y = 6 + 1 + 1 + margins, closed form.
    begin, end = table.zone[SOUTH + INNER, WEST + OUTER]
    assert begin == pytest.approx(115 - (6 + 1 + LENGTH / 2), abs=1.5)
    assert end == pytest.approx(115 - (6 - 1 - LENGTH / 2), abs=1.5)
    for i, j in itertools.permutations(range(16), 2):
        if table.approach[i] == table.approach[j]:
            continue
        s_i, s_j = (rng.uniform(95, table.out[k], 300) for k in (i, j))
        hit = rectangles_overlap(table.pose(i, s_i), table.pose(j, s_j))
        zone = table.zone[i, j]
        assert (s_i[hit] >= zone[0] - 0.5).all()
        assert (s_i[hit] <= zone[1] + 0.5).all()


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (WEST + INNER, SOUTH + INNER),  # horizontal before vertical
        (WEST + OUTER, SOUTH + OUTER),
        (WEST + LEFT, NORTH + OUTER),  # a horizontal left turn (2) before vertical straight (1)
        (WEST + OUTER, EAST + LEFT),  # straight (3) before oncoming left (2)
        (NORTH + INNER, SOUTH + LEFT),  # straight (1) before oncoming left (0)
        (WEST + OUTER, SOUTH + RIGHT),  # merge: straight (3) before the vertical right turn (1)
    ],
)
def test_the_lower_priority_waits_at_the_line(first, second):
    table = routes()
    # Both reach the middle of the zone of their routes at the same time.
    ends = table.zone[first, second].mean(), table.zone[second, first].mean()
    road = make_road((first, ends[0] - 40.0, 8.0), (second, ends[1] - 40.0, 8.0))
    waited, order, passed = False, [], [False, False]
    for _ in play(road, 12.0):
        assert not overlaps(road)
        s, held = road.surrounding.s, road.surrounding.held
        assert not held[0]
        waited |= bool(held[1])
        assert road.traffic[1].is_yielding == bool(held[1])
        if held[1]:
            assert s[1] + LENGTH / 2 <= ARM + 0.2
        for k, zone in enumerate((table.zone[first, second], table.zone[second, first])):
            if not passed[k] and s[k] > zone[0] + 1.0:
                passed[k] = True
                order.append(k)
    assert waited
    assert order == [0, 1]


def test_a_vehicle_in_the_box_is_not_stopped_by_priority():
    # A vertical left turn (priority 0) is inside when a horizontal vehicle (3) comes up.
    road = make_road((SOUTH + LEFT, 101.0, 6.0), (WEST + INNER, 75.0, 9.0))
    for _ in play(road, 6.0):
        assert not road.surrounding.held[0]
        assert not overlaps(road)
    assert road.surrounding.s[0] > routes().out[0]


@pytest.mark.parametrize("movement", [LEFT, INNER, OUTER])
def test_four_at_once_resolve(movement):
    road = make_road(*((arm + movement, 70.0, 8.0) for arm in (SOUTH, WEST, NORTH, EAST)))
    for _ in play(road, 20.0):
        assert not overlaps(road)
    ahead = road.surrounding.s.numpy() - routes().out[road.surrounding.route]
    assert (ahead > 0).all()


def test_leaders_are_seen_across_lane_segments():
    # The ego stands in the box, on the next lane segment of the follower.
    road = make_road((SOUTH + INNER, 60.0, 9.0), ego=(SOUTH + INNER, 112.0, 0.0))
    for _ in play(road, 10.0):
        gap = 112.0 - road.surrounding.s[0] - LENGTH
        assert gap > 1.0
    assert road.surrounding.speed[0] < 0.1


def test_nobody_hits_an_ego_that_stands_across_the_box():
    others = [(arm + k, 60.0 - 5 * k, 9.0) for arm in (WEST, NORTH, EAST) for k in (INNER, OUTER)]
    road = make_road(*others, ego=(SOUTH + LEFT, 112.0, 0.0))
    pose = np.array([*road.ego.position, road.ego.heading])
    for _ in play(road, 15.0):
        assert not rectangles_overlap(pose, poses(road)).any()
        assert not overlaps(road)


def test_traffic_is_predicted_along_its_route():
    road = make_road((SOUTH + LEFT, 95.0, 8.0))
    position, heading = road.traffic[0].predict_trajectory_constant_speed([0.0, 1.0, 5.0])
    np.testing.assert_allclose(position[0], [2.0, 20.0])
    np.testing.assert_allclose(heading[0], -np.pi / 2)
    np.testing.assert_allclose(position[2], [-15 - (135 - 126.7035), -2.0], atol=1e-3)
    np.testing.assert_allclose(np.abs(heading[2]), np.pi)


def test_states_hold_the_prediction_models_yaw_rate():
    road = make_road((SOUTH + LEFT, 110.0, 8.0), (SOUTH + RIGHT, 105.0, 6.0), (8, 50.0, 7.0))
    states = road.states.numpy()
    np.testing.assert_allclose(states[:, 5], [-8 / 17, 6 / 9, 0.0])
    np.testing.assert_allclose(states[:, 2:4], [[8, 0], [6, 0], [7, 0]])
    before = states[:2, [0, 1, 4]]
    road.step(1e-4)  # without accelerations, which nobody has decided
    rate = (road.states.numpy()[:2, [0, 1, 4]] - before) / 1e-4
    np.testing.assert_allclose(np.hypot(rate[:, 0], rate[:, 1]), [8, 6], rtol=1e-3)
    np.testing.assert_allclose(rate[:, 2], [-8 / 17, 6 / 9], rtol=1e-3)


def test_vehicles_leave_at_the_end_of_their_exit_arm():
    road = make_road((WEST + INNER, 226.0, 9.0), (EAST + INNER, 100.0, 9.0))
    for _ in play(road, 0.5):
        pass
    assert road.surrounding.present.tolist() == [False, True]
    assert list(road.traffic) == [1]
    assert road.vehicles == [road.ego, road.traffic[1]]


def test_the_objects_follow_the_vehicles():
    road = make_road(
        (SOUTH + LEFT, 92.0, 8.0), (EAST + RIGHT, 96.0, 6.0), (NORTH + OUTER, 60.0, 9.0)
    )
    segments = set()
    for _ in play(road, 4.0):
        vehicles = road.surrounding
        for number, car in road.traffic.items():
            assert car.s == vehicles.s[number]
            assert car.speed == vehicles.speed[number]
            assert car.action["acceleration"] == road.acceleration[number]
            pose = routes().pose(car.route_id, car.s)
            np.testing.assert_allclose(car.position, pose[:2], atol=1e-9)
            assert abs(utils.wrap_to_pi(car.heading - pose[2])) < 1e-9
            longitudinal, lateral = car.lane.local_coordinates(car.position)
            assert abs(lateral) < 1e-6
            assert -1e-6 <= longitudinal <= car.lane.length + 1e-6
            assert car.lane is road.network.get_lane(car.lane_index)
            assert car.route[0] == car.lane_index
            segments.add((number, car.lane_index))
    assert len(segments) >= 6  # two of them see all of their lanes


def test_spawning_keeps_its_distances_and_ranges():
    seeds = episode_seeds(1, 200)
    routes_of_ego = torch.arange(200) % 4
    table = routes()
    pose = torch.from_numpy(table.pose(routes_of_ego.numpy(), np.full(200, 60.0)))
    ego = torch.zeros(200, 6, dtype=torch.float64)
    ego[:, :2] = pose[:, :2]
    drawn = draw_traffic(Traffic(), routes_of_ego, ego, seeds)
    for k in range(200):
        there = drawn.present[k]
        place = torch.from_numpy(table.pose(drawn.route[k].numpy(), drawn.s[k].numpy())[:, :2])
        apart = torch.cdist(place[there], place[there]) + 1e9 * torch.eye(int(there.sum()))
        assert apart.min() >= 15.0
        assert (place[there] - ego[k, :2]).norm(dim=-1).min() >= 20.0
        # None was removed without a reason: too close to the ego or to an earlier one that stayed.
        for gone in (~there).nonzero().flatten().tolist():
            kept = torch.cat([place[:gone][there[:gone]], place[:0]])
            to_ego = (place[gone] - ego[k, :2]).norm()
            assert to_ego < 20.0 or (kept - place[gone]).norm(dim=-1).min() < 15.0
    assert ((drawn.s >= 0) & (drawn.s <= 95)).all()
    assert ((drawn.speed >= 6) & (drawn.speed <= 10)).all()
    assert 5 < drawn.present.sum(1).double().mean() < 10
