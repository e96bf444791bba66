"""Reference lines against analytic curves."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
import torch

from saferl.envs.intersection.geometry import (
    ROUTES,
    line_pose,
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
