"""The observation against hand-made scenes and a loop over vehicles."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from saferl.envs.intersection.geometry import (
    ROUTES,
)
from saferl.envs.intersection.observation import (
    FORMS,
    destination_distance,
    observe,
    vehicle_distance,
)

NORTH = -math.pi / 2
RADIUS = math.sqrt(1.25**2 + 1.0**2)
TARGETS = {
    "lt": [(-40, -2), (-40, -6)],
    "gs_inner": [(2, -40), (6, -40)],
    "gs_outer": [(2, -40), (6, -40)],
    "rt": [(40, 2), (40, 6)],
}


def car(x, y, speed=0.0, heading=0.0, side=0.0, turn=0.0):
    return [x, y, speed, side, heading, turn]


def scene(ego, *vehicles, route="gs_inner", rows=11, present=None, dtype=torch.float64):
    table = torch.tensor(vehicles, dtype=dtype).reshape(-1, 6)
    shown = torch.ones(len(table), dtype=torch.bool) if present is None else torch.tensor(present)
    own, rows, observed = observe(
        torch.tensor(ego, dtype=dtype),
        table,
        shown,
        torch.tensor(ROUTES.index(route)),
        rows,
        "world",
    )
    return own, rows, observed.tolist()


def circle_gap(a, b):
    """Smallest gap between the two circles of two vehicles, by the four pairs."""
    gaps = []
    for i in (1.25, -1.25):
        for j in (1.25, -1.25):
            p = (a[0] + i * math.cos(a[4]), a[1] + i * math.sin(a[4]))
            q = (b[0] + j * math.cos(b[4]), b[1] + j * math.sin(b[4]))
            gaps.append(math.dist(p, q) - 2 * RADIUS)
    return min(gaps)


def looped(ego, vehicles, present, route, rows):
    """The same observation by plain loops over one scene."""
    seen = []
    for index, vehicle in enumerate(vehicles):
        dx, dy = vehicle[0] - ego[0], vehicle[1] - ego[1]
        ahead = dx * math.cos(ego[4]) + dy * math.sin(ego[4])
        if present[index] and -30 <= ahead <= 70:
            seen.append((math.hypot(dx, dy), index))
    nearest = [index for _, index in sorted(seen)[: rows - 1]]
    table = np.zeros((rows, 6))

    def velocity(state):
        turn = complex(math.cos(state[4]), math.sin(state[4]))
        return complex(state[2], state[3]) * turn

    for row, index in enumerate(nearest):
        vehicle = vehicles[index]
        relative = velocity(vehicle) - velocity(ego)
        heading = math.atan2(math.sin(vehicle[4]), math.cos(vehicle[4]))
        heading += 2 * math.pi if heading < -0.75 * math.pi else 0.0
        table[row] = [1, vehicle[0] - ego[0], vehicle[1] - ego[1],
                      relative.real, relative.imag, heading]  # fmt: skip
    d_veh = min((circle_gap(ego, vehicles[index]) for index in nearest), default=70.0)
    d_des = min(abs(x - ego[0]) + abs(y - ego[1]) for x, y in TARGETS[ROUTES[route]])
    return np.array([1, *ego, d_veh, d_des]), table, nearest


def random_scene(seed, count=14, reach=45.0):
    rng = np.random.default_rng(seed)
    low = [-reach, -reach, 0, -1, -7, -1]
    high = [reach, reach, 12, 1, 7, 1]
    ego, *vehicles = rng.uniform(low, high, (count + 1, 6))
    return ego, np.array(vehicles).reshape(count, 6), rng.random(count) < 0.8, rng.integers(0, 4)


@pytest.mark.parametrize("rows", [1, 4, 11, 20])
@pytest.mark.parametrize("count", [0, 1, 14])
def test_observe_equals_a_loop_over_vehicles(rows, count):
    for seed in range(25):
        ego, vehicles, present, route = random_scene(seed, count)
        own, table, nearest = looped(ego, vehicles, present, route, rows)
        ours = observe(
            torch.tensor(ego), torch.tensor(vehicles), torch.tensor(present),
            torch.tensor(route), rows, "world",
        )  # fmt: skip
        np.testing.assert_allclose(ours[0].numpy(), own, atol=1e-9)
        np.testing.assert_allclose(ours[1].numpy(), table, atol=1e-9)
        assert ours[2].nonzero().flatten().tolist() == sorted(nearest)


@pytest.mark.parametrize("batch", [(), (2, 1), (3,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batches_give_what_singles_give(batch, dtype):
    scenes = [random_scene(seed, 6) for seed in range(max(1, math.prod(batch)))]
    ego, vehicles, present, route = (
        torch.as_tensor(np.stack(part)).reshape((*batch, *np.shape(part[0])))
        for part in zip(*scenes, strict=True)
    )
    own, table, observed = observe(ego.to(dtype), vehicles.to(dtype), present, route, 5, "world")
    assert own.shape == (*batch, 9) and table.shape == (*batch, 5, 6)
    assert observed.shape == (*batch, 6) and observed.dtype == torch.bool
    assert own.dtype == table.dtype == dtype
    for single, a, b in zip(scenes, own.reshape(-1, 9), table.reshape(-1, 5, 6), strict=True):
        expected = looped(*single, 5)
        np.testing.assert_allclose(a.numpy(), expected[0], atol=1e-4)
        np.testing.assert_allclose(b.numpy(), expected[1], atol=1e-4)


def test_a_scene_by_hand():
    """North-bound at 8 m/s; one car follows at 6, one crosses from the west at 10."""
    own, table, observed = scene(
        car(2.0, 30.0, 8.0, NORTH, turn=0.1),
        car(-18.0, 10.0, 10.0, 0.0),
        car(2.0, 42.0, 6.0, NORTH),
        route="lt",
    )
    expected = [
        [1, 0, 12, 0, 2, NORTH],  # y points down: behind is +12, 2 m/s slower is +2
        [1, -20, -20, 10, 8, 0],
    ]
    assert torch.allclose(table[:2], torch.tensor(expected, dtype=torch.float64), atol=1e-12)
    assert (table[2:] == 0).all() and table.shape == (11, 6)
    assert observed == [True, True]
    # Bumper circles 12 - 2.5 m apart; |2 + 40| + |30 + 2| to the nearer target.
    expected = [1, 2, 30, 8, 0, NORTH, 0.1, 9.5 - 2 * RADIUS, 74]
    assert torch.allclose(own, torch.tensor(expected, dtype=torch.float64))


@pytest.mark.parametrize("heading", [NORTH, 0.0, 2.0])
@pytest.mark.parametrize(
    ("along", "across", "seen"),
    [
        (69.99, 0.0, True),
        (70.01, 0.0, False),
        (-29.99, 0.0, True),
        (-30.01, 0.0, False),
        (69.99, 40.0, True),  # the window is along the heading, not a circle
        (0.0, 60.0, True),
        (-31.0, 1.0, False),
    ],
)
def test_window_along_the_heading(heading, along, across, seen):
    x = along * math.cos(heading) - across * math.sin(heading)
    y = along * math.sin(heading) + across * math.cos(heading)
    own, table, observed = scene(car(3.0, -4.0, 5.0, heading), car(3.0 + x, -4.0 + y))
    assert observed == [seen]
    assert table[0, 0] == float(seen)
    if not seen:
        assert (table == 0).all() and own[7] == 70.0


def test_window_turns_with_the_ego():
    north, east = (scene(car(0, 0, 5, phi), car(0, 50))[2] for phi in (NORTH, 0.0))
    assert north == [False] and east == [True]  # 50 m behind; abeam


def test_nearest_first_and_one_row_always_padding():
    ego = car(0.0, 0.0, 5.0, 0.0)
    distances = [30.0, 10.0, 50.0, 20.0, 40.0]
    _, table, observed = scene(ego, *[car(d, 0.0) for d in distances], rows=4)
    assert table[:, 1].tolist() == [10.0, 20.0, 30.0, 0.0]
    assert table[:, 0].tolist() == [1.0, 1.0, 1.0, 0.0]
    assert observed == [True, True, False, True, False]
    _, table, _ = scene(ego, *[car(d, 0.0) for d in distances], rows=6)
    assert table[:, 0].tolist() == [1.0] * 5 + [0.0]
    _, table, observed = scene(ego, *[car(d, 0.0) for d in distances], rows=1)
    assert (table == 0).all() and not any(observed)


def test_vehicles_that_are_not_present_are_not_observed():
    _, table, observed = scene(
        car(0, 0, 5), car(10, 0, 3.0), car(20, 0, 4.0), car(30, 0), present=[False, True, False]
    )
    assert observed == [False, True, False]
    assert table[:, 0].sum() == 1 and table[0, 1] == 20.0
    nowhere = car(math.nan, math.nan, math.nan)
    own, table, _ = scene(car(0, 0, 5), nowhere, car(20, 0, 4.0), present=[False, True])
    assert own.isfinite().all() and table.isfinite().all()


def test_no_vehicle_at_all():
    own, table, observed = scene(car(2, 50, 8, NORTH))
    assert own[7] == 70.0
    assert table.shape == (11, 6) and (table == 0).all() and observed == []
    assert vehicle_distance(torch.zeros(4, 6), torch.zeros(4, 0, 6), torch.zeros(4, 0).bool()).eq(70).all()  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_permuting_the_vehicles_changes_nothing(form):
    for seed in range(10):
        ego, vehicles, present, route = random_scene(seed)
        order = np.random.default_rng(seed).permutation(len(vehicles))
        first, second = (
            observe(
                torch.tensor(ego), torch.tensor(vehicles[index]), torch.tensor(present[index]),
                torch.tensor(route), 6, form,
            )
            for index in (np.arange(len(vehicles)), order)
        )  # fmt: skip
        assert torch.equal(first[0], second[0])
        assert torch.equal(first[1], second[1])
        assert torch.equal(first[2][order], second[2])


@pytest.mark.parametrize(
    ("heading", "expected"),
    [
        (0.0, 0.0),
        (NORTH, NORTH),
        (1.5 * math.pi, NORTH),
        (math.pi, math.pi),
        (-math.pi, math.pi),
        (-math.pi + 0.05, math.pi + 0.05),  # a west-bound car that wobbles makes no jump
        (math.pi - 0.05, math.pi - 0.05),
        (4 * math.pi + 0.3, 0.3),
        (-0.75 * math.pi + 1e-6, -0.75 * math.pi + 1e-6),
        (-0.75 * math.pi - 1e-6, 1.25 * math.pi - 1e-6),
    ],
)
def test_heading_seam_lies_between_the_lanes(heading, expected):
    _, table, _ = scene(car(0, 0, 5), car(10, 0, 0, heading))
    assert table[0, 5].item() == pytest.approx(expected, abs=1e-9)


def test_vehicle_distance_ignores_the_unobserved_and_goes_below_zero():
    ego = torch.tensor(car(0, 0, 5)).double()
    vehicles = torch.tensor([car(1.0, 0.5), car(12.0, 3.0, heading=1.0)]).double()
    both, second, none = (
        vehicle_distance(ego, vehicles, torch.tensor(mask)).item()
        for mask in ([True, True], [False, True], [False, False])
    )
    assert both == pytest.approx(circle_gap(car(0, 0), car(1.0, 0.5)))
    assert both < 0
    assert second == pytest.approx(circle_gap(car(0, 0), car(12.0, 3.0, heading=1.0)))
    assert none == 70.0


def test_vehicle_distance_of_a_far_car_abeam():
    """A car inside the window but further than 70 m to the side."""
    own, table, observed = scene(car(0, 0, 5, NORTH), car(90.0, 0.0))
    assert observed == [True] and table[0, 1] == 90.0
    assert own[7].item() == pytest.approx(circle_gap(car(0, 0, heading=NORTH), car(90.0, 0.0)))


@pytest.mark.parametrize("name", ROUTES)
def test_destination_distance_is_manhattan_to_the_nearer_target(name):
    points = np.random.default_rng(4).uniform(-60, 60, (50, 2))
    state = torch.zeros(50, 6, dtype=torch.float64)
    state[:, :2] = torch.tensor(points)
    ours = destination_distance(state, torch.full((50,), ROUTES.index(name)))
    expected = [min(abs(x - a) + abs(y - b) for a, b in TARGETS[name]) for x, y in points]
    np.testing.assert_allclose(ours.numpy(), expected)


# --- along the route -----------------------------------------------------------------------------
