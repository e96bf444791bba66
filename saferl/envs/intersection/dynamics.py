"""Vehicle models: the ego's dynamic bicycle (E5_1b) and the others' prediction model (E5_1c).

The state of any vehicle is [..., 6] = x, y (m, world), v_x, v_y (m/s, body frame), phi (rad),
omega (rad/s).
"""

from __future__ import annotations

import torch
from torch import Tensor

from saferl.envs.intersection.geometry import columns

MASS = 1412.0  # kg
INERTIA = 1536.7  # kg m^2, about the vertical axis
L_F, L_R = 1.06, 1.85  # m, centre of gravity to the axles
C_F, C_R = -128915.5, -85943.6  # N/rad, equivalent sideslip stiffness of the axles
ACTION_SCALE = (5.0, 0.6)  # m/s^2, rad


def to_physical(action: Tensor) -> Tensor:
    """Policy units [-1, 1]^2 to (a_x in m/s^2, delta_f in rad), [..., 2]; clipped to the box."""
    return action.clamp(-1.0, 1.0) * action.new_tensor(ACTION_SCALE)


def step_ego(state: Tensor, control: Tensor, dt: float) -> Tensor:
    """One step of the dynamic bicycle, E5_1b (paper), stable at any low speed.

    The lateral equations are solved backwards in time, so that their denominators never vanish.
    v_x is kept at or above 0 (ours: the model has no reverse gear).

    Args:
        state: [..., 6].
        control: [..., 2], acceleration (m/s^2) and front wheel angle (rad).
        dt: seconds.

    >>> step_ego(torch.tensor([0., 0., 9., 0., 0., 0.]), torch.tensor([0., 0.]), 0.1)
    tensor([0.9000, 0.0000, 9.0000, 0.0000, 0.0000, 0.0000])
    """
    x, y, v_x, v_y, phi, omega = state.unbind(-1)
    a_x, delta = control.unbind(-1)
    cos, sin = torch.cos(phi), torch.sin(phi)
    moment = L_F * C_F - L_R * C_R
    new_v_y = (
        MASS * v_x * v_y + dt * (moment * omega - C_F * delta * v_x - MASS * v_x**2 * omega)
    ) / (MASS * v_x - dt * (C_F + C_R))
    new_omega = (-INERTIA * omega * v_x - dt * (moment * v_y - L_F * C_F * delta * v_x)) / (
        dt * (L_F**2 * C_F + L_R**2 * C_R) - INERTIA * v_x
    )
    return columns(
        x + dt * (v_x * cos - v_y * sin),
        y + dt * (v_x * sin + v_y * cos),
        (v_x + dt * (a_x + v_y * omega)).clamp_min(0.0),
        new_v_y,
        phi + dt * omega,
        new_omega,
    )


def step_vehicle(state: Tensor, dt: float) -> Tensor:
    """One step of the prediction model of other vehicles, E5_1c: constant speed and yaw rate.

    Args:
        state: [..., 6].
        dt: seconds.
    """
    x, y, v_x, v_y, phi, omega = state.unbind(-1)
    cos, sin = torch.cos(phi), torch.sin(phi)
    return columns(
        x + dt * (v_x * cos - v_y * sin),
        y + dt * (v_x * sin + v_y * cos),
        v_x,
        torch.zeros_like(v_y),
        phi + dt * omega,
        omega,
    )


def predict_vehicles(state: Tensor, dt: float, steps: int) -> tuple[Tensor, Tensor, Tensor]:
    """x, y and heading, each [steps, ...], that ``steps`` calls of :func:`step_vehicle` give.

    The sums over time are taken at once, in closed form: sum of cos(phi + k a) for k = 0 .. n - 1 is
    sin(n a / 2) / sin(a / 2) cos(phi + (n - 1) a / 2).

    Args:
        state: [..., 6].
        dt: seconds.
        steps: how many.
    """
    x, y, v_x, v_y, phi, omega = state.unbind(-1)
    count = torch.arange(1, steps + 1, dtype=state.dtype, device=state.device)
    count = count.reshape(-1, *[1] * x.ndim)
    half = dt * omega / 2
    turning = half.abs() > 1e-6
    share = torch.where(
        turning, torch.sin(count * half) / torch.where(turning, half, 1.0).sin(), count
    )
    middle = phi + (count - 1) * half
    forward = dt * v_x * share
    # The sideways speed lasts for the first step.
    cos, sin = torch.cos(phi), torch.sin(phi)
    return (
        x + forward * torch.cos(middle) - dt * v_y * sin,
        y + forward * torch.sin(middle) + dt * v_y * cos,
        phi + dt * omega * count,
    )
