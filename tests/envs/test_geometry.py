"""Rectangles and pavement against shapely; goals, angles and names."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
import torch

from saferl.envs.intersection.geometry import (
    ROUTES,
    ROUTES_OF_TASK,
    TASK_OF_ROUTE,
    TASKS,
    arrived,
    corners,
    offroad,
    on_pavement,
    overlap,
    rectangle_distance,
    wrap,
)

BATCHES = [(), (2, 1)]
DTYPES = [torch.float32, torch.float64]
BOX, ARM, RIGHT_ANGLE = 15.0, 100.0, math.pi / 2


def rectangles(poses, length, width):
    """Rectangles [N, 4, 2] by rotation matrices, in numpy; sizes may be arrays [N]."""
    corner = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2
    local = corner * np.stack(np.broadcast_arrays(length, width), -1).reshape(-1, 1, 2)
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    rotation = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    return np.einsum("nij,nkj->nki", rotation, local) + poses[:, None, :2]


def pair_of_poses(count, seed, spread=6.0):
    rng = np.random.default_rng(seed)
    low, high = [-spread, -spread, -7.0], [spread, spread, 7.0]
    return rng.uniform(low, high, (2, count, 3))


def clear(a, b, tolerance):
    """Which pairs of shapely polygons neither almost touch nor overlap by a sliver."""
    return (shapely.distance(a, b) > tolerance) | (
        shapely.area(shapely.intersection(a, b)) > tolerance
    )


# --- rectangles ----------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    ("size_a", "size_b", "scale"),
    [
        ((5.0, 2.0), (5.0, 2.0), 1.0),
        ((5.0, 2.0), (5.0, 2.0), 1.37),
        ((12.0, 2.5), (3.0, 1.0), 1.0),
        ((1.0, 0.5), (9.0, 6.0), 1.2),
    ],
)
def test_overlap_agrees_with_shapely(size_a, size_b, scale, dtype):
    poses = pair_of_poses(4000, seed=11)
    a, b = (
        shapely.polygons(rectangles(pose, size[0] * scale, size[1] * scale))
        for pose, size in zip(poses, (size_a, size_b), strict=True)
    )
    sure = clear(a, b, 1e-9 if dtype is torch.float64 else 1e-4)
    expected = shapely.intersects(a, b)
    assert 0.1 < expected.mean() < 0.9
    pose_a, pose_b = torch.tensor(poses, dtype=dtype)
    ours = overlap(pose_a, pose_b, size_a, size_b, scale).numpy()
    assert sure.mean() > 0.99
    assert (ours == expected)[sure].all()
    assert (overlap(pose_b, pose_a, size_b, size_a, scale).numpy() == expected)[sure].all()


def test_overlap_takes_a_scale_for_each_pair():
    poses = pair_of_poses(3000, seed=12)
    scale = np.random.default_rng(13).uniform(1.0, 2.0, 3000)
    a, b = (shapely.polygons(rectangles(pose, 5.0 * scale, 2.0 * scale)) for pose in poses)
    ours = overlap(*torch.tensor(poses), scale=torch.tensor(scale)).numpy()
    sure = clear(a, b, 1e-9)
    assert (ours == shapely.intersects(a, b))[sure].all()


def test_overlap_broadcasts_one_against_many():
    a, b = torch.tensor(pair_of_poses(30, seed=14))
    table = overlap(a[:5, None], b)
    assert table.shape == (5, 30)
    for i in range(5):
        assert torch.equal(table[i], torch.stack([overlap(a[i], b[j]) for j in range(30)]))
    assert overlap(a.reshape(2, 1, 15, 3), b.reshape(2, 1, 15, 3)).shape == (2, 1, 15)


@pytest.mark.parametrize("dtype", DTYPES)
def test_touching_rectangles_overlap_and_a_hair_apart_they_do_not(dtype):
    origin = torch.zeros(3, dtype=dtype)
    hair = 1e-5
    for x, y in [(5.0, 0.0), (0.0, 2.0), (5.0, 2.0), (-5.0, 1.0), (2.5, -2.0)]:
        touching = torch.tensor([x, y, 0.0], dtype=dtype)
        apart = touching * (1 + hair)
        assert overlap(origin, touching), (x, y)
        assert not overlap(origin, apart), (x, y)
    # Scaled by 1.5: 7.5 m long and 3 m wide.
    for x, y in [(7.5, 0.0), (0.0, 3.0)]:
        touching = torch.tensor([x, y, 0.0], dtype=dtype)
        assert overlap(origin, touching, scale=1.5)
        assert not overlap(origin, touching * (1 + hair), scale=1.5)
    # A corner that pokes a long side: half the diagonal of a square of side 2, turned by 45 degrees.
    for gap, expected in [(-1e-4, True), (1e-4, False)]:
        poke = torch.tensor([0.0, 1.0 + math.sqrt(2.0) + gap, math.pi / 4], dtype=dtype)
        assert overlap(origin, poke, size_b=(2.0, 2.0)) == expected


def test_one_inside_the_other_and_a_crossing_without_corners_inside():
    origin = torch.zeros(3, dtype=torch.float64)
    assert overlap(origin, torch.tensor([0.3, 0.1, 0.5]).double(), size_b=(0.5, 0.2))
    assert overlap(origin, torch.tensor([0.0, 0.0, RIGHT_ANGLE]).double())
    # Only an axis of the second rectangle separates these two.
    thin = torch.tensor([3.3, 1.8, -math.pi / 4], dtype=torch.float64)
    assert not overlap(origin, thin, size_b=(5.0, 0.4))


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_corners_are_those_of_a_rotated_rectangle_in_ring_order(batch, dtype):
    poses = np.random.default_rng(3).uniform(-4, 4, (max(1, math.prod(batch)), 3))
    ours = corners(torch.tensor(poses, dtype=dtype).reshape(*batch, 3), 4.0, 1.5)
    assert ours.shape == (*batch, 4, 2) and ours.dtype == dtype
    polygons = shapely.polygons(ours.double().numpy().reshape(-1, 4, 2))
    assert shapely.is_valid(polygons).all()
    expected = shapely.polygons(rectangles(poses, 4.0, 1.5))
    assert shapely.area(polygons) == pytest.approx(6.0, rel=1e-5)
    assert (shapely.hausdorff_distance(polygons, expected) < 1e-5).all()


# --- pavement ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def road():
    """The paved cross: two roads, and a box whose corners are cut by circles of 7 m."""
    end = BOX + ARM
    curbs = [
        shapely.Point(x, y).buffer(7.0, quad_segs=512) for x in (-BOX, BOX) for y in (-BOX, BOX)
    ]
    box = shapely.difference(shapely.box(-BOX, -BOX, BOX, BOX), shapely.union_all(curbs))
    arms = [shapely.box(-8, -end, 8, end), shapely.box(-end, -8, end, 8)]
    return shapely.union_all([box, *arms])


@pytest.mark.parametrize("dtype", DTYPES)
def test_on_pavement_is_the_road_polygon(road, dtype):
    rng = np.random.default_rng(5)
    points = np.concatenate([rng.uniform(-20, 20, (6000, 2)), rng.uniform(-125, 125, (6000, 2))])
    shapes = shapely.points(points)
    sure = shapely.distance(shapes, shapely.boundary(road)) > 1e-3
    inside = shapely.covers(road, shapes)
    assert 0.05 < inside.mean() < 0.95
    ours = on_pavement(torch.tensor(points, dtype=dtype)).numpy()
    assert (ours == inside)[sure].all()


@pytest.mark.parametrize(
    ("x", "y", "paved"),
    [
        (0.0, 0.0, True),
        (8.0, 60.0, True),
        (8.001, 60.0, False),
        (-115.0, 3.0, True),
        (-115.001, 3.0, False),
        (0.0, 115.001, False),
        (8.0, 15.0, True),  # where the kerb's arc begins
        (8.01, 15.0, False),
        (10.0, 10.0, True),  # 7.07 m from the circle's centre
        (10.1, 10.1, False),  # 6.93 m
        (14.9, 14.9, False),
        (-10.0, 10.0, True),
        (60.0, 60.0, False),
    ],
)
def test_on_pavement_at_its_edges(x, y, paved):
    assert on_pavement(torch.tensor([x, y], dtype=torch.float64)) == paved


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_offroad_is_a_corner_off_the_road_polygon(road, batch, dtype):
    rng = np.random.default_rng(6)
    poses = np.concatenate(
        [rng.uniform([-20, -20, -7], [20, 20, 7], (2000, 3)),
         rng.uniform([-10, -120, -2], [10, 120, -1], (2000, 3))]
    )  # fmt: skip
    points = shapely.points(rectangles(poses, 5.0, 2.0))
    expected = ~shapely.covers(road, points).all(-1)
    sure = (shapely.distance(points, shapely.boundary(road)) > 1e-3).all(-1)
    assert 0.1 < expected.mean() < 0.95
    states = torch.zeros(4000, 6, dtype=dtype)
    states[:, [0, 1, 4]] = torch.tensor(poses, dtype=dtype)
    if batch:
        ours = offroad(states.reshape(*batch, 2000, 6)).reshape(-1)
        assert (ours.numpy() == expected)[sure].all()
    else:
        ours = torch.stack([offroad(state) for state in states[:300]])
        assert (ours.numpy() == expected[:300])[sure[:300]].all()


@pytest.mark.parametrize("offset", [7.0, 7.001])
def test_offroad_when_the_side_of_a_straight_car_passes_the_verge(offset):
    state = torch.tensor([offset, 50.0, 5.0, 0.0, -RIGHT_ANGLE, 0.0], dtype=torch.float64)
    state[0] -= 1e-9
    assert offroad(state) == (offset > 7.0)


# --- goal, angles, names -------------------------------------------------------------------------

#: Exit arm of each route: position from metres along the arm and to the right of its middle line.
EXIT = {
    "lt": lambda along, right: (-along, -right),
    "gs_inner": lambda along, right: (right, -along),
    "gs_outer": lambda along, right: (right, -along),
    "rt": lambda along, right: (along, right),
}


@pytest.mark.parametrize("name", ROUTES)
@pytest.mark.parametrize(
    ("along", "right", "there"),
    [
        (40.0, 2.0, True),
        (40.0, 6.0, True),
        (39.999, 2.0, False),
        (60.0, 0.0, True),
        (60.0, 8.0, True),
        (60.0, -0.001, False),
        (60.0, 8.001, False),
        (-40.0, 2.0, False),
        (0.0, 0.0, False),
    ],
)
def test_arrived_at_its_boundaries(name, along, right, there):
    x, y = EXIT[name](along, right)
    for dtype in DTYPES:
        state = torch.tensor([x, y, 5.0, 0.0, 0.0, 0.0], dtype=dtype)
        assert arrived(state, torch.tensor(ROUTES.index(name))) == there


def test_arrived_on_the_own_exit_arm_alone():
    states = torch.zeros(3, 6)
    states[:, :2] = torch.tensor([EXIT[name](50.0, 4.0) for name in ("lt", "gs_inner", "rt")])
    for route in range(4):
        reached = arrived(states, torch.full((3,), route))
        assert reached.tolist() == [TASK_OF_ROUTE[route] == task for task in range(3)]
    assert arrived(states.reshape(3, 1, 6), torch.zeros(3, 1, dtype=torch.int64)).shape == (3, 1)


def test_routes_and_tasks_name_each_other():
    for task, name in enumerate(TASKS):
        assert all(TASK_OF_ROUTE[route] == task for route in ROUTES_OF_TASK[name])
        assert all(ROUTES[route].split("_")[0] == name for route in ROUTES_OF_TASK[name])
    assert sorted(ROUTES_OF_TASK["mixed"]) == sorted(sum(map(ROUTES_OF_TASK.get, TASKS), ()))


def test_wrap_folds_into_half_open_turn():
    angle = torch.linspace(-20.0, 20.0, 1001, dtype=torch.float64)
    folded = wrap(angle)
    assert ((folded >= -math.pi) & (folded < math.pi)).all()
    turns = (angle - folded) / (2 * math.pi)
    assert torch.allclose(turns, turns.round(), atol=1e-12)
    table = torch.tensor([0.0, math.pi, -math.pi, 1.5 * math.pi], dtype=torch.float64)
    expected = torch.tensor([0.0, -math.pi, -math.pi, -0.5 * math.pi], dtype=torch.float64)
    assert torch.allclose(wrap(table), expected)


def test_the_distance_of_two_bodies_is_shapelys():
    generator = torch.Generator().manual_seed(3)
    poses = torch.rand(2, 400, 3, generator=generator, dtype=torch.float64) * torch.tensor(
        [14.0, 14.0, 7.0]
    )
    ours = rectangle_distance(*poses)
    outlines = [[shapely.Polygon(corners(pose).numpy()) for pose in side] for side in poses]
    theirs = [a.distance(b) for a, b in zip(*outlines, strict=True)]
    torch.testing.assert_close(ours, torch.tensor(theirs, dtype=torch.float64), atol=1e-9, rtol=0)
    assert 50 < (ours == 0).sum() < 350
