"""The observation along the route against a loop over vehicles and hand-made scenes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from test_observation import NORTH, car, looped, random_scene

from saferl.envs.intersection.geometry import (
    ROUTES,
    line_pose,
    offroad,
    reference_lines,
)
from saferl.envs.intersection.observation import (
    FORMS,
    HORIZON,
    PATIENCE,
    REACH,
    as_world,
    observe,
    reading,
)


def folded(angle):
    return math.atan2(math.sin(angle), math.cos(angle))


def nearest_on(line, x, y):
    """The nearest point of a line of 215 m by trying every centimetre: pose, arc length."""
    s = torch.arange(0.0, float(line[-1, 4] + line[-1, 5]), 0.01, dtype=torch.float64)
    poses = line_pose(line.expand(len(s), 4, 6), s)
    index = int(torch.hypot(poses[:, 0] - x, poses[:, 1] - y).argmin())
    return poses[index].tolist(), float(s[index])


def turned_path(x, y, heading, pace, omega, times):
    """Places at ``times`` of a car that turns until its heading is along an arm, in steps of 1 ms."""
    places, step = [], 1e-3
    arms = [k * math.pi / 2 for k in range(-12, 13)]
    end = (
        min((arm for arm in arms if arm > heading), default=0)
        if omega > 0
        else max(arm for arm in arms if arm < heading)
    )
    for number in range(round(times[-1] / step) + 1):
        if any(abs(number * step - time) < step / 2 for time in times):
            places.append((x, y))
        turn = omega * step if abs(omega) > 0.05 else 0.0
        turn = min(turn, end - heading) if omega > 0 else max(turn, end - heading)
        x += pace * step * math.cos(heading + turn / 2)
        y += pace * step * math.sin(heading + turn / 2)
        heading += turn
    return places


def looped_route(ego, vehicles, present, route, rows):
    """The route's form by plain loops, from the world's and a search along the lines."""
    own, world, nearest = looped(ego, vehicles, present, route, rows)
    line = reference_lines(torch.tensor(int(route)), torch.zeros(1, dtype=torch.float64))[0]
    (x, y, heading), start = nearest_on(line, ego[0], ego[1])
    offset = (ego[1] - y) * math.cos(heading) - (ego[0] - x) * math.sin(heading)
    one_hot = [float(route == k) for k in range(4)]
    error = folded(ego[4] - heading)
    features = [*ego[2:4], ego[5], offset, error, start - 100.0, *one_hot, *own[-2:]]

    table = np.zeros((rows, 12))
    turn = complex(math.cos(ego[4]), -math.sin(ego[4]))
    for row, index in enumerate(nearest):
        place = complex(*world[row, 1:3]) * turn
        speed = complex(*world[row, 3:5]) * turn
        angle = vehicles[index][4] - ego[4]
        where, when = REACH, PATIENCE
        x, y, pace, _, heading, omega = vehicles[index]
        for step in np.arange(0.0, REACH, 2.5):
            point = line_pose(line, torch.tensor(start + step).double())
            way = complex(float(point[0]) - x, float(point[1]) - y)
            way *= complex(math.cos(heading), -math.sin(heading))
            if abs(way.imag) < 2.5 and way.real > -2.5:
                where, when = step, min(max((way.real - 2.5) / max(pace, 1.0), 0.0), PATIENCE)
                break
        lead = min(max(where / max(ego[2], 1.0) - when, -PATIENCE), PATIENCE)
        gaps, times = [], np.arange(0.0, HORIZON + 0.1, 0.25)
        for time, at in zip(times, turned_path(x, y, heading, pace, omega, times), strict=True):
            point = line_pose(line, torch.tensor(start + ego[2] * time).double())
            gaps.append(math.dist(point[:2].tolist(), at))
        table[row] = [1, place.real, place.imag, speed.real, speed.imag, math.sin(angle),
                      math.cos(angle), where, when, lead, min(gaps), 0.25 * int(np.argmin(gaps))]  # fmt: skip
    return np.array(features), table, nearest


def on_the_road(seed, count=8):
    """A scene whose ego is on the pavement, within a lane's width of its route, and headed along it."""
    rng = np.random.default_rng(seed)
    _, vehicles, present, route = random_scene(seed, count)
    line = reference_lines(torch.tensor(int(route)), torch.zeros(1, dtype=torch.float64))[0]
    while True:
        x, y, heading = line_pose(line, torch.tensor(rng.uniform(40, 150)).double()).tolist()
        side = rng.uniform(-3, 3)
        ego = np.array([x - side * math.sin(heading), y + side * math.cos(heading),
                        rng.uniform(0, 12), rng.uniform(-1, 1), heading + rng.uniform(-0.6, 0.6),
                        rng.uniform(-1, 1)])  # fmt: skip
        if not offroad(torch.tensor(ego)):
            return ego, vehicles, present, route


def tensors(scene):
    ego, vehicles, present, route = scene
    return torch.tensor(ego), torch.tensor(vehicles), torch.tensor(present), torch.tensor(route)


@pytest.mark.parametrize("rows", [1, 4, 11])
def test_the_route_form_equals_a_loop(rows):
    for seed in range(12):
        scene = on_the_road(seed)
        own, table, nearest = looped_route(*scene, rows)
        ours = observe(*tensors(scene), rows)
        np.testing.assert_allclose(ours[0].numpy(), own, atol=0.012)  # the search's centimetre
        # A corridor's edge may lie within that centimetre: there the first meeting is another one.
        same = np.isclose(ours[1].numpy(), table, atol=0.015)
        assert same[:, :7].all() and same[:, 10].all() and same[:, 7:].mean() > 0.98
        assert ours[2].nonzero().flatten().tolist() == sorted(nearest)


def test_both_forms_hold_the_same():
    for seed in range(50):
        ego, vehicles, present, route = tensors(on_the_road(seed))
        world = observe(ego, vehicles, present, route, 9, "world")
        back = as_world(*observe(ego, vehicles, present, route, 9, "route")[:2])
        for ours, theirs in zip(back, world[:2], strict=True):
            torch.testing.assert_close(ours, theirs, atol=1e-9, rtol=0)
        assert as_world(*world[:2])[0] is world[0]


def test_a_feature_is_read_by_its_name():
    scene = tensors(on_the_road(0))
    forms = [observe(*scene, 5, form)[0] for form in FORMS]
    for name in ("v_x", "v_y", "omega", "d_veh", "d_des"):
        assert len({float(reading(ego, name)) for ego in forms}) == 1
    assert float(reading(forms[0], "v_x")) == float(scene[0][2])


def test_the_car_that_crosses_and_the_one_that_has_crossed():
    """Straight ahead at x = 2; one car comes from the west along y = 6, one is past the line."""
    ego = torch.tensor(car(2.0, 40.0, 8.0, NORTH)).double()
    comes, gone = car(-18.0, 6.0, 10.0), car(12.0, 6.0, 10.0)
    there, route = torch.ones(2, dtype=torch.bool), torch.tensor(ROUTES.index("gs_inner"))
    table = observe(ego, torch.tensor([comes, gone]).double(), there, route, 3)[1]
    rows = [dict(zip(FORMS["route"].vehicle, row, strict=True)) for row in table.tolist()]
    comes, gone = sorted(rows[:2], key=lambda row: row["y"])
    # 34 m ahead less the 2.5 m of its corridor, the first of the points 2.5 m apart; 20 m less half its length.
    assert (comes["conflict_s"], comes["conflict_t"]) == pytest.approx((32.5, 1.75))
    assert comes["lead"] == pytest.approx(32.5 / 8.0 - 1.75)
    assert (gone["conflict_s"], gone["conflict_t"]) == (REACH, PATIENCE)
    # At 8 m/s northwards and 10 eastwards: the gap (20 - 10 t, 34 - 8 t) is least at t = 472 / 164.
    least = min(math.hypot(20 - 10 * t, 34 - 8 * t) for t in np.arange(0, 4.1, 0.25))
    assert comes["closest"] == pytest.approx(least) and comes["closest_t"] == pytest.approx(3.0)
