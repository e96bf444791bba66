"""The cost against Algorithm 2 by hand: a loop over vehicles and steps, with shapely."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
import torch
from shapely import affinity

from saferl.envs.intersection.collision_cost import CollisionCost

MASS, INERTIA, L_F, L_R, C_F, C_R = 1412.0, 1536.7, 1.06, 1.85, -128915.5, -85943.6
BETA = np.linspace(1.2, 1.5, 15)


def car(x, y, speed=0.0, heading=0.0, turn=0.0, side=0.0):
    return np.array([x, y, speed, side, heading, turn])


def predict_ego(state, control, dt):
    """E5_1b as printed."""
    x, y, v_x, v_y, phi, omega = state
    a_x, delta = control
    moment = L_F * C_F - L_R * C_R
    return np.array(
        [
            x + dt * (v_x * math.cos(phi) - v_y * math.sin(phi)),
            y + dt * (v_x * math.sin(phi) + v_y * math.cos(phi)),
            max(0.0, v_x + dt * (a_x + v_y * omega)),
            (MASS * v_x * v_y + dt * (moment * omega - C_F * delta * v_x - MASS * v_x**2 * omega))
            / (MASS * v_x - dt * (C_F + C_R)),
            phi + dt * omega,
            (-INERTIA * omega * v_x - dt * (moment * v_y - L_F * C_F * delta * v_x))
            / (dt * (L_F**2 * C_F + L_R**2 * C_R) - INERTIA * v_x),
        ]
    )


def predict_vehicle(state, dt):
    """E5_1c as printed."""
    x, y, v_x, v_y, phi, omega = state
    return np.array(
        [
            x + dt * (v_x * math.cos(phi) - v_y * math.sin(phi)),
            y + dt * (v_x * math.sin(phi) + v_y * math.cos(phi)),
            v_x,
            0.0,
            phi + dt * omega,
            omega,
        ]
    )


def polygon(state, beta):
    box = shapely.box(-2.5 * beta, -beta, 2.5 * beta, beta)
    turned = affinity.rotate(box, state[4], origin=(0, 0), use_radians=True)
    return affinity.translate(turned, state[0], state[1])


def algorithm_2(ego, control, vehicles, observed, steps=15, dt=1 / 15, beta=BETA, decay=1.0,
                base=9.0, initial=0.05):  # fmt: skip
    """Algorithm 2, line by line."""
    speed = math.hypot(ego[2], ego[3])
    cost, count = 0.0, 0
    for vehicle, seen in zip(vehicles, observed, strict=True):
        if not seen:
            continue
        count += 1
        own, other = ego, vehicle
        for i in range(steps):
            own, other = predict_ego(own, control, dt), predict_vehicle(other, dt)
            if polygon(own, beta[i]).intersects(polygon(other, beta[i])):
                cost += initial * speed / base * math.exp(-decay * beta[i])
    return cost / max(count, 1)


def ours(ego, control, vehicles, observed, dtype=torch.float64, **settings):
    return CollisionCost(**settings)(
        torch.tensor(np.asarray(ego), dtype=dtype),
        torch.tensor(control, dtype=dtype),
        torch.tensor(np.array(vehicles), dtype=dtype).reshape(-1, 6),
        torch.tensor(observed, dtype=torch.bool),
    ).item()


WEST = math.pi
SCENES = {
    "head-on": (car(0, 0, 9.0), (0.0, 0.0), [car(14.0, 0.0, 9.0, WEST)]),
    "parallel": (car(0, 0, 9.0), (0.0, 0.0), [car(0.0, 4.0, 9.0)]),
    "crossing": (car(0, 0, 9.0), (0.0, 0.0), [car(9.0, 8.0, 8.0, -math.pi / 2)]),
    "standing": (car(0, 0, 9.0), (0.0, 0.0), [car(10.0, 0.0)]),
    "braking for a standing car": (car(0, 0, 6.0), (-5.0, 0.0), [car(10.0, 0.0)]),
    "swerving round a standing car": (car(0, 0, 8.0), (0.0, 0.4), [car(10.0, 0.0)]),
    "turning car": (car(0, 0, 7.0), (1.0, -0.1), [car(8.0, 6.0, 6.0, -2.0, -0.6)]),
    "ego stands": (car(0, 0, 0.0), (0.0, 0.3), [car(4.0, 0.0, 3.0, WEST)]),
    "several": (
        car(1, 2, 8.0, 0.3, 0.1, 0.2),
        (2.0, 0.1),
        [car(8, 4, 2.0, 0.4), car(12, 9, 7.0, -1.5), car(-40, 0, 9.0), car(10, 2, 0.0, 1.2)],
    ),
}


@pytest.mark.parametrize("name", SCENES)
def test_cost_of_scenes_is_algorithm_2(name):
    ego, control, vehicles = SCENES[name]
    seen = [True] * len(vehicles)
    expected = algorithm_2(ego, control, vehicles, seen)
    assert ours(ego, control, vehicles, seen) == pytest.approx(expected, abs=1e-12)
    assert ours(ego, control, vehicles, seen, torch.float32) == pytest.approx(expected, abs=1e-6)
    assert (expected > 0) == (name not in ("parallel", "ego stands"))


def test_standing_car_by_hand():
    """9 m/s towards a standing car 10 m ahead: the bumpers of boxes of 5 beta meet once
    9 t >= 10 - 5 beta."""
    hits = [9.0 * (i + 1) / 15 >= 10.0 - 5.0 * BETA[i] for i in range(15)]
    assert sum(hits) == 10  # from step 6 on
    expected = 0.05 * sum(math.exp(-b) for b, hit in zip(BETA, hits, strict=True) if hit)
    ego, control, vehicles = SCENES["standing"]
    assert ours(ego, control, vehicles, [True]) == pytest.approx(expected, abs=1e-12)


def test_head_on_by_hand():
    """Closing at 18 m/s over 14 m: they meet when 14 - 18 t <= 5 beta, and pass through each other
    until 14 - 18 t < -5 beta, which is later than a second."""
    hits = [abs(14.0 - 18.0 * (i + 1) / 15) <= 5.0 * BETA[i] for i in range(15)]
    expected = 0.05 * sum(math.exp(-b) for b, hit in zip(BETA, hits, strict=True) if hit)
    ego, control, vehicles = SCENES["head-on"]
    assert ours(ego, control, vehicles, [True]) == pytest.approx(expected, abs=1e-12)


def test_parallel_lanes_by_hand():
    """Side by side, boxes of width 2 beta: 4 m apart they never meet, 2.5 m apart from
    beta = 1.25 on."""
    ego = car(0, 0, 9.0)
    assert ours(ego, (0.0, 0.0), [car(0, 4.0, 9.0)], [True]) == 0.0
    hits = BETA >= 1.25
    expected = 0.05 * np.exp(-BETA[hits]).sum()
    assert ours(ego, (0.0, 0.0), [car(0, 2.5, 9.0)], [True]) == pytest.approx(expected, abs=1e-12)


def test_cost_is_proportional_to_the_present_speed():
    """The same overlaps (a car on top of the other, both moving alike) at 3 and 6 m/s."""
    every = np.exp(-BETA).sum() * 0.05
    for speed in (3.0, 6.0):
        cost = ours(car(0, 0, speed), (0.0, 0.0), [car(1.0, 0, speed)], [True])
        assert cost == pytest.approx(every * speed / 9.0, abs=1e-12)
    side = ours(car(0, 0, 3.0, side=4.0), (0.0, 0.0), [car(0.5, 0, 3.0)], [True])
    expected = algorithm_2(car(0, 0, 3.0, side=4.0), (0.0, 0.0), [car(0.5, 0, 3.0)], [True])
    assert side == pytest.approx(expected, abs=1e-12)


def test_the_sum_is_divided_by_the_observed_vehicles():
    ego, control, (ahead,) = SCENES["standing"]
    alone = ours(ego, control, [ahead], [True])
    far = car(-40.0, 30.0, 5.0)
    assert ours(ego, control, [ahead, far], [True, True]) == pytest.approx(alone / 2)
    assert ours(ego, control, [far, ahead, far], [True, True, True]) == pytest.approx(alone / 3)
    assert ours(ego, control, [ahead, ahead], [True, True]) == pytest.approx(alone)


def test_unobserved_vehicles_do_not_count():
    ego, control, (ahead,) = SCENES["standing"]
    far = car(-40.0, 30.0, 5.0)
    alone = ours(ego, control, [ahead], [True])
    assert ours(ego, control, [far, ahead], [False, True]) == pytest.approx(alone)
    assert ours(ego, control, [far, ahead], [True, False]) == 0.0
    assert ours(ego, control, [ahead], [False]) == 0.0


def test_no_vehicle_costs_nothing():
    cost = CollisionCost()
    for batch in ((), (2, 1)):
        zero = cost(
            torch.ones(*batch, 6), torch.ones(*batch, 2), torch.zeros(*batch, 0, 6),
            torch.zeros(*batch, 0, dtype=torch.bool),
        )  # fmt: skip
        assert zero.shape == batch and (zero == 0).all()


@pytest.mark.parametrize("batch", [(), (2, 1), (40,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_random_scenes_in_batches_are_algorithm_2(batch, dtype):
    count = max(1, math.prod(batch))
    rng = np.random.default_rng(count)
    ego = rng.uniform([-2, -2, 0, -1, -4, -1], [2, 2, 12, 1, 4, 1], (count, 6))
    control = rng.uniform([-5, -0.6], [5, 0.6], (count, 2))
    vehicles = rng.uniform([-15, -15, 0, 0, -4, -0.6], [15, 15, 10, 0, 4, 0.6], (count, 5, 6))
    observed = rng.random((count, 5)) < 0.7
    result = CollisionCost()(
        torch.tensor(ego, dtype=dtype).reshape(*batch, 6),
        torch.tensor(control, dtype=dtype).reshape(*batch, 2),
        torch.tensor(vehicles, dtype=dtype).reshape(*batch, 5, 6),
        torch.tensor(observed).reshape(*batch, 5),
    )
    assert result.shape == batch and result.dtype == dtype
    expected = [algorithm_2(*row) for row in zip(ego, control, vehicles, observed, strict=True)]
    np.testing.assert_allclose(result.numpy().reshape(-1), expected, atol=1e-6)
    if count > 2:
        assert np.mean(np.array(expected) > 0) > 0.3


def test_settings_reach_the_formula():
    ego, control, vehicles = SCENES["several"]
    seen = [True, True, False, True]
    expected = algorithm_2(ego, control, vehicles, seen, steps=6, dt=0.2,
                           beta=np.linspace(1.0, 2.0, 6), decay=0.5, base=5.0, initial=0.3)  # fmt: skip
    assert expected > 0
    settings = {"steps": 6, "dt": 0.2, "growth": (1.0, 2.0), "decay": 0.5, "base_speed": 5.0,
                "initial": 0.3}  # fmt: skip
    assert ours(ego, control, vehicles, seen, **settings) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    "settings", [{"steps": 0}, {"dt": 0.0}, {"base_speed": -1.0}, {"initial": -0.1}]
)
def test_bad_settings_are_named(settings):
    (name,) = settings
    with pytest.raises(ValueError, match=f"cost.{name} must be"):
        CollisionCost(**settings)
