"""What may be limited on the road, each cost by its name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from saferl.envs.intersection.collision_cost import CollisionCost

COMFORT = 3.0  # m/s^2
SPEED = 10.0  # m/s, the fastest start


class Decision(NamedTuple):
    """What the costs of a decision follow from.

    Attributes:
        cost: the settings of what collisions cost.
        predicted: what Algorithm 2 foresees, [*B].
        collision: whether it ended in a vehicle, bool [*B].
        offroad: whether it ended off the road, bool [*B].
        ego: the state after it, [*B, 6].
        control: held in it, [*B, 2], physical units.
        seconds: its length.
    """

    cost: CollisionCost
    predicted: Tensor
    collision: Tensor
    offroad: Tensor
    ego: Tensor
    control: Tensor
    seconds: float


def crashes(decision: Decision) -> Tensor:
    """Predicted collisions, and ``crash`` for a collision or leaving the road: the default, in one."""
    d = decision
    return d.cost.with_crash(d.predicted, d.offroad | d.collision)


def collision(decision: Decision) -> Tensor:
    """Predicted collisions, and ``crash`` for a collision with a vehicle."""
    return decision.cost.with_crash(decision.predicted, decision.collision)


def road(decision: Decision) -> Tensor:
    """1 for leaving the road, which ends the episode: its mean is the share of episodes that end so."""
    return decision.offroad.to(decision.ego)


def comfort(decision: Decision) -> Tensor:
    """Acceleration beyond 3 m/s^2, along and across, by the time that it lasts: m/s."""
    ahead, across = decision.control[..., 0], decision.ego[..., 2] * decision.ego[..., 5]
    return (torch.hypot(ahead, across) - COMFORT).clamp_min(0.0) * decision.seconds


def speed(decision: Decision) -> Tensor:
    """Speed beyond 10 m/s, by the time that it lasts: m."""
    over = torch.hypot(decision.ego[..., 2], decision.ego[..., 3]) - SPEED
    return over.clamp_min(0.0) * decision.seconds


#: By the names that ``task.costs`` takes.
COSTS: dict[str, Callable[[Decision], Tensor]] = {
    "cost": crashes,
    "collision": collision,
    "road": road,
    "comfort": comfort,
    "speed": speed,
}


def costs_of(names: Sequence[str], decision: Decision) -> Tensor:
    """The costs of these names, [*B, K].

    >>> at = torch.tensor([0.0, 0.0, 12.0, 0.0, 0.0, 0.0])
    >>> yes, no = torch.tensor(True), torch.tensor(False)
    >>> costs_of(
    ...     ["road", "comfort", "speed"],
    ...     Decision(CollisionCost(), torch.tensor(0.0), no, yes, at, torch.tensor([-5.0, 0.0]), 0.2),
    ... )
    tensor([1.0000, 0.4000, 0.4000])
    """
    return torch.stack([COSTS[name](decision) for name in names], -1)
