"""Scripted drivers: baselines that follow the reference line, with and without eyes for traffic."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from saferl.envs.intersection.dynamics import ACTION_SCALE, L_F, L_R
from saferl.envs.intersection.geometry import (
    line_pose,
    overlap,
    project,
    reference_lines,
    wrap,
)
from saferl.envs.intersection.observation import as_world
from saferl.envs.intersection.yielding import STOP
from saferl.envs.seeding import mix, uniform

CRUISE = 9.0  # m/s
_LATERAL = 4.5  # m/s^2, the most that a driver asks of a bend
_BRAKE = 3.0  # m/s^2, comfortable
_NARROW = 1.1  # enlargement of the rectangles of standing vehicles


class Driver(TensorDictModuleBase):
    """Follows the lane of its route at up to ``speed``, slower in bends; blind to traffic.

    Steering is pure pursuit of a point on the reference line; speed is a proportional controller.

    Args:
        speed: m/s.

    Reads ``ego`` [*B, F], ``vehicles`` [*B, M, G] and ``route`` [*B, 1], of either form. Writes
    ``action`` [*B, 2] in [-1, 1].

    >>> from saferl.envs.intersection import BatchedIntersection, Scenario
    >>> env = BatchedIntersection(Scenario(task="lt", vehicles=0), num_envs=4)
    >>> data = env.rollout(125, Driver(), break_when_any_done=False)
    >>> bool(data["next", "success"].any(1).all())
    True
    """

    def __init__(self, speed: float = CRUISE):
        super().__init__()
        self.in_keys, self.out_keys = ["ego", "vehicles", "route"], ["action"]
        self.speed = speed

    def target_speed(self, ego: Tensor, vehicles: Tensor, line: Tensor, s: Tensor) -> Tensor:
        """Speed to aim for [*B], m/s, at arc length ``s`` [*B] of ``line`` [*B, 4, 6]."""
        return self.bend_speed(line, s)

    def bend_speed(self, line: Tensor, s: Tensor) -> Tensor:
        """``speed``, or what the sharpest bend of the next 12 m allows."""
        start, length, curvature = line[..., 5], line[..., 4], line[..., 3].abs()
        near = (start < s[..., None] + 12.0) & (start + length > s[..., None])
        limit = torch.sqrt(_LATERAL / curvature.clamp_min(1e-3))
        return torch.where(near, limit, self.speed).amin(-1).clamp_max(self.speed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        route = tensordict["route"].squeeze(-1)
        ego, vehicles = as_world(tensordict["ego"], tensordict["vehicles"])
        line = reference_lines(route, ego)[..., 0, :, :]
        _, s, _ = project(ego[..., 1:3], line)
        v = ego[..., 3]
        target = self.target_speed(ego, vehicles, line, s)
        aim = line_pose(line, s + 2.0 + 0.5 * v)
        dx, dy = aim[..., 0] - ego[..., 1], aim[..., 1] - ego[..., 2]
        bearing = wrap(torch.atan2(dy, dx) - ego[..., 5])
        curvature = 2 * torch.sin(bearing) / torch.hypot(dx, dy).clamp_min(1.0)
        action = torch.stack(
            [1.5 * (target - v) / ACTION_SCALE[0], (L_F + L_R) * curvature / ACTION_SCALE[1]], -1
        )
        return tensordict.set("action", action.clamp(-1.0, 1.0))


class Brake(Driver):
    """Brakes along the lane of its route as hard as it can.

    >>> from saferl.envs.intersection import BatchedIntersection, Scenario
    >>> env = BatchedIntersection(Scenario(task="lt", vehicles=0), num_envs=4)
    >>> bool((env.rollout(11, Brake())["next", "ego"][:, -1, 0] < 0.1).all())  # from 10 m/s and below
    True
    """

    def target_speed(self, ego: Tensor, vehicles: Tensor, line: Tensor, s: Tensor) -> Tensor:
        return torch.full_like(s, -self.speed)


class Hold(Driver):
    """Follows the lane of its route at the speed that it has."""

    def target_speed(self, ego: Tensor, vehicles: Tensor, line: Tensor, s: Tensor) -> Tensor:
        return ego[..., 3]


class CautiousDriver(Driver):
    """Follows its lane as fast as is predicted to hit nobody, and creeps or waits meanwhile.

    Every choice of speed is played forward along the line for 4 s against the observed vehicles at
    constant velocity, all rectangles enlarged; the fastest choice that hits nobody is taken, and the
    hardest braking if every one does. Before the box it takes full speed or none: it stops at the
    line, rather than creep into the way of others.

    Args:
        speed: m/s, of the free road.
        margin: enlargement of the predicted rectangles of moving vehicles.
    """

    choices = (1.0, 0.66, 0.33, 0.0)  # of the free speed

    def __init__(self, speed: float = CRUISE, margin: float = 1.5):
        super().__init__(speed)
        self.margin = margin

    def target_speed(self, ego: Tensor, vehicles: Tensor, line: Tensor, s: Tensor) -> Tensor:
        free = self.bend_speed(line, s)
        times = torch.arange(1, 17, dtype=ego.dtype, device=ego.device) * 0.25
        choice = free[..., None] * ego.new_tensor(self.choices)
        v = ego[..., 3, None, None]
        # Speed moves to the choice at a fixed rate: closed form of the distance covered.
        rate = torch.where(choice[..., None] < v, -1.5 * _BRAKE, _BRAKE)
        reach = ((choice[..., None] - v) / rate).clamp_min(0.0)
        within = torch.minimum(times, reach)
        ahead = v * within + rate * within.square() / 2 + choice[..., None] * (times - within)
        pose = line_pose(
            line[..., None, None, :, :].expand(*ahead.shape, 4, 6), s[..., None, None] + ahead
        )
        world = _world_velocity(ego)
        speed = vehicles[..., 3:5] + world[..., None, :]
        start = vehicles[..., 1:3] + ego[..., None, 1:3]
        moved = start[..., None, :] + speed[..., None, :] * times[:, None]  # [*B, M, T, 2]
        heading = vehicles[..., None, 5:6].expand(*moved.shape[:-1], 1)
        other = torch.cat([moved, heading], -1).transpose(-3, -2)[
            ..., None, :, :, :
        ]  # [*B, 1, T, M, 3]
        # Room for what may change: less of it beside a car that stands and waits.
        moving = (speed.norm(dim=-1) / 2.0).clamp_max(1.0)[..., None, None, :]  # [*B, 1, 1, M]
        scale = _NARROW + (self.margin - _NARROW) * moving
        hit = overlap(pose[..., None, :], other, scale=scale)
        hit &= vehicles[..., None, None, :, 0] > 0.5
        free_choice = ~hit.flatten(-2).any(-1)
        fastest = torch.where(free_choice, choice, 0.0).amax(-1)
        to_line = STOP - s
        halting = torch.sqrt(2 * _BRAKE * to_line.clamp_min(0.0))
        waits = (to_line > 0) & ~free_choice[..., 0]
        return torch.where(waits, torch.minimum(fastest, halting), fastest)


def _world_velocity(ego: Tensor) -> Tensor:
    cos, sin = torch.cos(ego[..., 5]), torch.sin(ego[..., 5])
    return torch.stack(
        [ego[..., 3] * cos - ego[..., 4] * sin, ego[..., 3] * sin + ego[..., 4] * cos], -1
    )


class RandomDriver(Driver):
    """Uniform random actions, the floor of every table.

    An action is a hash of ``ego`` and of ``seed``, so that an episode is the same alone, in a batch,
    and when it is played again. What is seen is rounded to 1e-3 first: the last bits of a simulated
    state may depend on how many are simulated at once.

    Args:
        seed: another seed, other actions.
    """

    def __init__(self, seed: int = 0):
        super().__init__()
        self.seed = seed

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        ego = tensordict["ego"]
        key = mix(torch.full(ego.shape[:-1], self.seed, dtype=torch.int64, device=ego.device), 0)
        for number in (ego.double() * 1e3).round().long().unbind(-1):
            key = mix(key ^ number, 0)
        action = torch.stack([uniform(key, 0), uniform(key, 1)], -1)
        return tensordict.set("action", (2 * action - 1).to(ego.dtype))


#: Scripted drivers by the names that commands give them, each from a seed.
DRIVERS: dict[str, Callable[[int], Driver]] = {
    "random": RandomDriver,
    "blind": lambda seed: Driver(),
    "scripted": lambda seed: CautiousDriver(),
}
