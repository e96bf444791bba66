"""Pavement, reference lines and rectangles against shapely and analytic curves."""

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
    line_pose,
    offroad,
    on_pavement,
    overlap,
    project,
    reference_lines,
    target_points,
    wrap,
)

BATCHES = [(), (2, 1)]
DTYPES = [torch.float32, torch.float64]
BOX, ARM, RIGHT_ANGLE = 15.0, 100.0, math.pi / 2


def lines_of(route, dtype=torch.float64):
    return reference_lines(torch.tensor(route), torch.zeros(1, dtype=dtype))


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


# --- reference lines -----------------------------------------------------------------------------


def curve(route, line, s):
    """Pose [N, 3] of a reference line at arc lengths ``s`` [N], from straights and circles."""

    def join(pieces, s):
        out = np.zeros((len(s), 3))
        for begin, end, function in pieces:
            here = (s >= begin) & (s <= end)
            out[here] = function(s[here] - begin)
        return out

    def go(x, y, heading):
        return lambda t: np.stack(
            [x + t * np.cos(heading), y + t * np.sin(heading), np.full_like(t, heading)], -1
        )

    def arc(centre_x, centre_y, radius, first, sign):
        # ``first``: polar angle where it begins; ``sign``: of the turn, y pointing down.
        def pose(t):
            polar = first + sign * t / radius
            return np.stack(
                [
                    centre_x + radius * np.cos(polar),
                    centre_y + radius * np.sin(polar),
                    polar + sign * RIGHT_ANGLE,
                ],
                -1,
            )

        return pose

    name, north = ROUTES[route], -RIGHT_ANGLE
    if name in ("lt", "rt"):
        x, radius, sign = (2.0, 17.0, -1.0) if name == "lt" else (6.0, 9.0, 1.0)
        late = 4.0 * line
        length = radius * RIGHT_ANGLE
        exit_y = BOX - late - radius
        first = 0.0 if name == "lt" else math.pi
        centre = x + sign * radius
        heading = north + sign * RIGHT_ANGLE
        pieces = [
            (0.0, ARM + late, go(x, BOX + ARM, north)),
            (ARM + late, ARM + late + length, arc(centre, BOX - late, radius, first, sign)),
            (ARM + late + length, np.inf, go(sign * BOX, exit_y, heading)),
        ]
        pose = join(pieces, s)
        if name == "rt":
            # polar pi + pi / 2 is a heading of 2 pi more than the arm's
            pose[:, 2] = (pose[:, 2] + math.pi) % (2 * math.pi) - math.pi
        return pose
    x, sign = (2.0, 1.0) if name == "gs_inner" else (6.0, -1.0)
    if line == 0:
        return go(x, BOX + ARM, north)(s)
    # Two arcs of 15 m along and 2 m across each: R - R cos a = 2, R sin a = 15.
    radius = (BOX**2 + 2.0**2) / (2 * 2.0)
    angle = math.asin(BOX / radius)
    length = radius * angle
    first = math.pi if sign > 0 else 0.0
    other = x + sign * 4.0
    pieces = [
        (0.0, ARM, go(x, BOX + ARM, north)),
        (ARM, ARM + length, arc(x + sign * radius, BOX, radius, first, sign)),
        (ARM + length, ARM + 2 * length,
         arc(other - sign * radius, -BOX, radius, (0.0 if sign > 0 else math.pi) + sign * angle,
             -sign)),
        (ARM + 2 * length, np.inf, go(other, -BOX, north)),
    ]  # fmt: skip
    return join(pieces, s)


def total_length(route, line):
    segment = lines_of(route)[line, -1]
    return float(segment[4] + segment[5])


ALL_LINES = [(route, line) for route in range(4) for line in range(2)]


@pytest.mark.parametrize(("route", "line"), ALL_LINES)
def test_line_pose_follows_the_analytic_curve(route, line):
    s = np.linspace(0.0, total_length(route, line), 2001)
    expected = curve(route, line, s)
    ours = line_pose(lines_of(route)[line].expand(2001, 4, 6), torch.tensor(s)).numpy()
    np.testing.assert_allclose(ours[:, :2], expected[:, :2], atol=1e-9)
    gap = (ours[:, 2] - expected[:, 2] + math.pi) % (2 * math.pi) - math.pi
    np.testing.assert_allclose(gap, 0.0, atol=1e-9)


@pytest.mark.parametrize(("route", "line"), ALL_LINES)
def test_lines_are_smooth_and_measured_by_arc_length(route, line):
    table = lines_of(route)[line]
    s = torch.linspace(-10.0, total_length(route, line) + 10.0, 6001, dtype=torch.float64)
    step = float(s[1] - s[0])
    pose = line_pose(table.expand(len(s), 4, 6), s)
    moved = pose[1:, :2] - pose[:-1, :2]
    assert torch.allclose(moved.norm(dim=-1) / step, torch.ones(6000).double(), atol=1e-4)
    # The heading never jumps (9 m is the tightest bend) and is the direction of travel.
    assert (pose[1:, 2] - pose[:-1, 2]).abs().max() <= step / 9.0 + 1e-9
    middle = (pose[1:, 2] + pose[:-1, 2]) / 2
    travel = torch.atan2(moved[:, 1], moved[:, 0])
    assert wrap(travel - middle).abs().max() < 1e-3


#: Where the lines of each route begin, and where they are 25 m past the box: (x, y, heading).
ENDS = {
    "lt": ((2.0, 115.0), [(-40.0, -2.0), (-40.0, -6.0)], math.pi),
    "gs_inner": ((2.0, 115.0), [(2.0, -40.0), (6.0, -40.0)], -RIGHT_ANGLE),
    "gs_outer": ((6.0, 115.0), [(6.0, -40.0), (2.0, -40.0)], -RIGHT_ANGLE),
    "rt": ((6.0, 115.0), [(40.0, 6.0), (40.0, 2.0)], 0.0),
}


@pytest.mark.parametrize("name", ROUTES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_lines_end_in_their_exit_lanes_and_pass_the_target_points(name, dtype):
    route = ROUTES.index(name)
    start, exits, heading = ENDS[name]
    lines = lines_of(route, dtype)
    begin = line_pose(lines, torch.zeros(2, dtype=dtype))
    assert torch.allclose(begin, torch.tensor([*start, -RIGHT_ANGLE], dtype=dtype).expand(2, 3))
    targets = target_points(torch.tensor(route), torch.zeros(1, dtype=dtype))
    assert targets.dtype == dtype
    assert sorted(targets.tolist()) == sorted(list(point) for point in exits)
    pose, _, distance = project(torch.tensor(exits, dtype=dtype), lines)
    assert distance.abs().max() < 1e-4
    assert wrap(pose[:, 2] - heading).abs().max() < 1e-5


@pytest.mark.parametrize(("route", "line"), ALL_LINES)
def test_project_inverts_line_pose(route, line):
    table = lines_of(route)[line]
    s = torch.linspace(0.0, total_length(route, line), 997, dtype=torch.float64)
    expected = line_pose(table.expand(997, 4, 6), s)
    pose, at, distance = project(expected[:, :2], table.expand(997, 4, 6))
    assert torch.allclose(at, s, atol=1e-7)
    assert torch.allclose(pose, expected, atol=1e-7)
    assert distance.max() < 1e-9
    # A point beside the line, nearer than its tightest radius, comes back to the same place.
    side = torch.stack([-torch.sin(expected[:, 2]), torch.cos(expected[:, 2])], -1)
    for offset in (-3.0, 1.5):
        _, at, distance = project(expected[:, :2] + offset * side, table.expand(997, 4, 6))
        assert torch.allclose(at, s, atol=1e-6)
        assert torch.allclose(distance, torch.full_like(distance, abs(offset)))


@pytest.mark.parametrize(("route", "line"), ALL_LINES)
def test_project_finds_the_nearest_of_all_sampled_points(route, line):
    table = lines_of(route)[line]
    step = 0.01
    s = np.arange(0.0, total_length(route, line), step)
    samples = shapely.linestrings(curve(route, line, s)[:, :2])
    points = np.random.default_rng(8).uniform(-130, 130, (1500, 2))
    points[:750] /= 6
    brute = shapely.distance(shapely.points(points), samples)
    query = torch.tensor(points)
    pose, at, distance = project(query, table.expand(1500, 4, 6))
    assert np.abs(distance.numpy() - brute).max() < step
    # What it returns hangs together: a pose on the line, at that arc length, at that distance.
    assert torch.allclose(line_pose(table.expand(1500, 4, 6), at), pose, atol=1e-8)
    assert torch.allclose((query - pose[:, :2]).norm(dim=-1), distance)


def test_a_line_goes_on_straight_beyond_its_ends():
    for route, line in ALL_LINES:
        table = lines_of(route)[line]
        end = total_length(route, line)
        s = torch.tensor([-12.0, 0.0, end, end + 12.0], dtype=torch.float64)
        before, first, last, after = line_pose(table.expand(4, 4, 6), s)
        for near, far, sign in ((first, before, -1), (last, after, 1)):
            direction = torch.stack([torch.cos(near[2]), torch.sin(near[2])])
            assert torch.allclose(far[:2], near[:2] + sign * 12.0 * direction)
            assert far[2] == near[2]


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_project_and_line_pose_take_any_batch(batch, dtype):
    generator = torch.Generator().manual_seed(2)
    points = torch.rand(*batch, 2, generator=generator, dtype=dtype) * 40 - 20
    route = torch.randint(0, 4, batch, generator=generator)
    pose, at, distance = project(points[..., None, :], reference_lines(route, points))
    assert pose.shape == (*batch, 2, 3) and at.shape == distance.shape == (*batch, 2)
    assert pose.dtype == dtype
    flat = zip(points.reshape(-1, 2), route.reshape(-1), pose.reshape(-1, 2, 3), strict=True)
    for point, one, result in flat:
        single, _, _ = project(point, reference_lines(one, points))
        assert torch.allclose(single, result)
    assert torch.allclose(line_pose(reference_lines(route, points), at), pose, atol=1e-4)


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
