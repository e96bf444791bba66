"""The vehicle models against kinematics, closed forms and the printed force balance."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from saferl.envs.intersection.dynamics import ACTION_SCALE, step_ego, step_vehicle, to_physical

MASS, INERTIA = 1412.0, 1536.7
L_F, L_R = 1.06, 1.85
C_F, C_R = -128915.5, -85943.6
STEPS = {1 / 15: 375, 1 / 30: 750}  # 25 s
FAST = 20.0  # m/s
YAW_LIMIT = FAST * 0.6 / (L_F + L_R)  # rad/s, kinematics at 20 m/s and full lock
SIDE_LIMIT = L_R * YAW_LIMIT  # m/s, sideways speed at the centre when the rear axle does not slip


def run(state, controls, dt):
    """Every state [T + 1, ..., 6] of a car under ``controls`` [T, ..., 2]."""
    states = [state]
    for control in controls:
        states.append(step_ego(states[-1], control, dt))
    return torch.stack(states)


def numpy_step(state, control, dt):
    """E5_1b from its force balance: axle forces C (slip), the lateral speed and the yaw rate each
    taken at the end of the step (backward Euler), everything else at its start."""
    x, y, v_x, v_y, phi, omega = state
    a_x, delta = control
    # m (v' - v) / dt = F_f + F_r - m v_x w, F_f = C_f ((v' + L_f w) / v_x - delta), and so on;
    # times v_x, and solved for v'.
    left = MASS * v_x / dt - C_F - C_R
    right = MASS * v_x * v_y / dt + C_F * (L_F * omega - delta * v_x) - C_R * L_R * omega
    side = (right - MASS * v_x**2 * omega) / left
    # I_z (w' - w) / dt = L_f F_f - L_r F_r, F_f = C_f ((v + L_f w') / v_x - delta), and so on.
    left = INERTIA * v_x / dt - C_F * L_F**2 - C_R * L_R**2
    right = INERTIA * v_x * omega / dt + L_F * C_F * (v_y - delta * v_x) - L_R * C_R * v_y
    return np.array(
        [
            x + dt * (v_x * np.cos(phi) - v_y * np.sin(phi)),
            y + dt * (v_x * np.sin(phi) + v_y * np.cos(phi)),
            max(v_x + dt * (a_x + v_y * omega), 0.0),
            side,
            phi + dt * omega,
            right / left,
        ]
    )


unit = st.floats(-1.0, 1.0)


@settings(max_examples=20, database=None, deadline=None)
@given(
    actions=st.lists(st.tuples(unit, unit), min_size=1, max_size=25),
    dt=st.sampled_from(sorted(STEPS)),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_finite_and_sensible_at_every_speed_under_every_action(actions, dt, dtype):
    speeds = torch.linspace(0.0, FAST, 81, dtype=dtype)
    state = torch.zeros(81, 6, dtype=dtype)
    state[:, 2] = speeds
    control = to_physical(torch.tensor(actions, dtype=dtype))
    held = control[torch.arange(STEPS[dt]) * len(actions) // STEPS[dt]]
    states = run(state, held[:, None].expand(-1, 81, -1), dt)
    assert states.isfinite().all()
    assert (states[..., 2] >= 0).all()
    # The model is meant for town speeds: as long as a car has never been faster than 20 m/s it
    # turns no faster than kinematics allows there.
    slow = (states[..., 2] <= FAST).cumprod(0).bool()
    assert states[..., 5][slow].abs().max() <= YAW_LIMIT
    assert states[..., 3][slow].abs().max() <= SIDE_LIMIT
    # Beyond that speeds stay of the size that 25 s of 5 m/s^2 can give.
    assert torch.hypot(states[..., 2], states[..., 3]).max() <= 200.0
    assert states[..., 5].abs().max() <= 30.0


@pytest.mark.parametrize("dt", sorted(STEPS))
@pytest.mark.parametrize("lock", [-1.0, 0.0, 1.0])
def test_a_standing_car_stays_where_it_is(dt, lock):
    state = torch.tensor([3.0, -7.0, 0.0, 0.0, 0.4, 0.0], dtype=torch.float64)
    for pedal in (-1.0, 0.0):
        control = to_physical(torch.tensor([pedal, lock], dtype=torch.float64))
        states = run(state, control.expand(STEPS[dt], 2), dt)
        assert torch.equal(states, state.expand_as(states))


@pytest.mark.parametrize("dt", sorted(STEPS))
def test_braking_ends_in_a_standstill_and_never_in_reverse(dt):
    state = torch.tensor([0.0, 0.0, 9.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    states = run(state, torch.tensor([-5.0, 0.0], dtype=torch.float64).expand(STEPS[dt], 2), dt)
    expected = torch.tensor([max(9.0 - 5.0 * dt * k, 0.0) for k in range(STEPS[dt] + 1)]).double()
    assert torch.allclose(states[:, 2], expected, atol=1e-6)
    assert torch.allclose(states[:, 0], torch.cat([torch.zeros(1), expected[:-1].cumsum(0) * dt]))
    assert (states[:, [1, 3, 4, 5]] == 0).all()


@pytest.mark.parametrize("delta", [0.02, 0.1, -0.3, 0.6, -0.6])
@pytest.mark.parametrize("speed", [0.25, 1.0, 2.0])
def test_turning_radius_at_low_speed_is_kinematic(speed, delta):
    dt = 1 / 15
    state = torch.tensor([0.0, 0.0, speed, 0.0, 0.3, 0.0], dtype=torch.float64)
    states = [state]
    for _ in range(300):
        # The acceleration that keeps v_x.
        pedal = -states[-1][3] * states[-1][5]
        control = torch.stack([pedal, torch.tensor(delta, dtype=torch.float64)])
        states.append(step_ego(states[-1], control, dt))
    states = torch.stack(states)[-100:]
    assert torch.allclose(states[:, 2], torch.full((100,), speed, dtype=torch.float64))
    radius = (L_F + L_R) / delta
    assert speed / states[-1, 5].item() == pytest.approx(radius, rel=0.01)
    # The same from the path alone: the circle through three of its points.
    (a, b, c) = states[[0, 40, 99], :2].numpy()
    sides = [math.dist(a, b), math.dist(b, c), math.dist(a, c)]
    area = abs((b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0]) / 2
    assert math.prod(sides) / (4 * area) == pytest.approx(math.hypot(radius, L_R), rel=0.01)


@pytest.mark.parametrize("delta", [0.01, 0.05, -0.1])
def test_small_wheel_angles_agree_with_the_tangent_of_kinematics(delta):
    state = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    for _ in range(100):
        control = torch.stack([-state[3] * state[5], torch.tensor(delta, dtype=torch.float64)])
        state = step_ego(state, control, 1 / 15)
    assert (state[2] / state[5]).item() == pytest.approx((L_F + L_R) / math.tan(delta), rel=0.01)


@pytest.mark.parametrize("dt", sorted(STEPS))
def test_step_ego_equals_the_force_balance_over_a_whole_episode(dt):
    rng = np.random.default_rng(7)
    for _ in range(4):
        state = np.array([*rng.uniform(-50, 50, 2), rng.uniform(0, 12), 0.0, rng.uniform(-3, 3), 0])
        actions = rng.uniform(-1, 1, (STEPS[dt] // 3, 2)).repeat(3, 0) * ACTION_SCALE
        ours = run(torch.tensor(state), torch.tensor(actions), dt)
        theirs = [state]
        for action in actions:
            theirs.append(numpy_step(theirs[-1], action, dt))
        np.testing.assert_allclose(ours.numpy(), np.stack(theirs), rtol=0, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (2, 1)])
def test_batches_give_what_singles_give(batch, dtype):
    generator = torch.Generator().manual_seed(1)
    state = torch.randn(*batch, 6, generator=generator, dtype=dtype)
    state[..., 2] = state[..., 2].abs() * 5
    control = torch.randn(*batch, 2, generator=generator, dtype=dtype)
    ego, vehicle = step_ego(state, control, 0.1), step_vehicle(state, 0.1)
    assert ego.shape == vehicle.shape == (*batch, 6)
    assert ego.dtype == vehicle.dtype == dtype
    tolerance = 1e-5 if dtype is torch.float32 else 1e-12
    for row, command, result in zip(
        state.reshape(-1, 6), control.reshape(-1, 2), ego.reshape(-1, 6), strict=True
    ):
        expected = numpy_step(row.double().numpy(), command.double().numpy(), 0.1)
        np.testing.assert_allclose(result.numpy(), expected, atol=tolerance, rtol=tolerance)


@pytest.mark.parametrize("omega", [0.0, 0.25, -0.7])
def test_step_vehicle_sums_to_its_closed_form(omega):
    dt, speed, phi, steps = 1 / 15, 8.0, 0.6, 30
    state = torch.tensor([1.0, 2.0, speed, 0.0, phi, omega], dtype=torch.float64)
    for _ in range(steps):
        state = step_vehicle(state, dt)
    # sum of exp(i (phi + j a)), j = 0 .. n - 1
    turn = omega * dt
    if turn:
        chord = dt * speed * math.sin(steps * turn / 2) / math.sin(turn / 2)
    else:
        chord = dt * speed * steps
    middle = phi + (steps - 1) * turn / 2
    expected = [
        1.0 + chord * math.cos(middle),
        2.0 + chord * math.sin(middle),
        speed,
        0.0,
        phi + steps * turn,
        omega,
    ]
    assert state.tolist() == pytest.approx(expected, abs=1e-12)


def test_step_vehicle_spends_sideways_speed_in_one_step():
    state = torch.tensor([0.0, 0.0, 2.0, 1.0, math.pi / 2, 0.0], dtype=torch.float64)
    once = step_vehicle(state, 0.5)
    assert once.tolist() == pytest.approx([-0.5, 1.0, 2.0, 0.0, math.pi / 2, 0.0], abs=1e-12)
    twice = step_vehicle(once, 0.5)
    assert twice.tolist() == pytest.approx([-0.5, 2.0, 2.0, 0.0, math.pi / 2, 0.0], abs=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_to_physical_scales_and_clips(dtype):
    action = torch.tensor([[1.0, -1.0], [0.5, 0.25], [0.0, 0.0], [3.0, -2.0]], dtype=dtype)
    expected = torch.tensor([[5.0, -0.6], [2.5, 0.15], [0.0, 0.0], [5.0, -0.6]], dtype=dtype)
    assert to_physical(action).dtype == dtype
    assert torch.allclose(to_physical(action), expected)
