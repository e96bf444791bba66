"""A set encoder: one layer for each vehicle, then their largest values, then an MLP."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from saferl.modules.encoder import Encoder
from saferl.modules.mlp import MLPPolicyEncoder, MLPValue
from saferl.modules.scene import (
    EGO_SCALE,
    VEHICLE_SCALE,
    check_sizes,
    feature_scale,
    flat_linear,
    largest,
    scale_ego,
    scale_vehicles,
)


class _PooledScene(nn.Module):
    """Scaled ego features and the largest of the vehicles' embeddings, in one vector [*B, F + width]."""

    ego_scale: Tensor
    vehicle_scale: Tensor

    def __init__(self, width: int, ego_scale: Sequence[float], vehicle_scale: Sequence[float]):
        super().__init__()
        self.size = len(ego_scale) + width
        self.register_buffer("ego_scale", feature_scale("ego_scale", ego_scale))
        self.register_buffer("vehicle_scale", feature_scale("vehicle_scale", vehicle_scale))
        self.vehicle = nn.Linear(len(vehicle_scale), width)
        self.ego = nn.Linear(len(ego_scale), width, bias=False)

    def forward(self, ego: Tensor, vehicles: Tensor) -> Tensor:
        ego = scale_ego(ego, self.ego_scale)
        features, present = scale_vehicles(vehicles, self.vehicle_scale)
        rows = flat_linear(features, self.vehicle.weight, self.vehicle.bias)
        # What the ego adds is the same for all vehicles, and a ReLU keeps their order.
        pooled = F.relu(largest(rows, present.unsqueeze(-1)) + self.ego(ego))
        return torch.cat([ego, pooled], dim=-1)


class SetPolicyEncoder(MLPPolicyEncoder):
    """Features of a scene for a policy from an MLP over the ego and a max-pool over the vehicles.

    A layer sees each vehicle together with the ego; of its outputs the largest over all vehicles go on (deep
    sets, Zaheer et al., 2017, with the pooling of PointNet, Qi et al., 2017). Permuting vehicles, or adding
    absent rows, changes nothing, and any number of rows will do. It is cheaper than
    :class:`~saferl.modules.MMAMPolicyEncoder`.

    Args:
        width: units of each hidden layer, and the size of the output.
        depth: number of hidden layers after the pooling, at least 1.
        vehicle_width: units of the layer on each vehicle; None: ``width``.
        activation: the module class of the activation of the hidden layers, one without parameters.
        ego_scale: divisors of the ego features.
        vehicle_scale: divisors of a vehicle's features; its presence comes first.

    Reads ``ego`` [*B, F] and ``vehicles`` [*B, M, G], SI units; returns features [*B, width].

    Raises:
        ValueError: if a size is below 1 or a feature scale is not positive and finite.

    Examples:
        >>> import torch
        >>> from saferl.modules import SetPolicyEncoder
        >>> encoder = SetPolicyEncoder(width=32)
        >>> ego, vehicles = torch.randn(5, 9), torch.rand(5, 3, 6)
        >>> torch.equal(encoder(ego, vehicles), encoder(ego, vehicles.flip(1)))
        True
    """

    def __init__(
        self,
        width: int = 128,
        depth: int = 2,
        vehicle_width: int | None = None,
        activation: type[nn.Module] = nn.GELU,
        ego_scale: Sequence[float] = EGO_SCALE,
        vehicle_scale: Sequence[float] = VEHICLE_SCALE,
    ):
        vehicle_width = width if vehicle_width is None else vehicle_width
        check_sizes(vehicle_width=vehicle_width)
        scene = _PooledScene(vehicle_width, ego_scale, vehicle_scale)
        self._build(scene, ("ego", "vehicles"), width, depth, activation)


class SetValue(MLPValue):
    """Action value from an MLP over the ego, the action and a max-pool over the vehicles.

    Args:
        width: units of each hidden layer.
        depth: number of hidden layers after the pooling, at least 1.
        vehicle_width: units of the layer on each vehicle, which sees no action; None: ``width``.
        action_dim: size of the action.
        activation: the module class of the activation of the hidden layers, one without parameters.
        ego_scale: divisors of the ego features.
        vehicle_scale: divisors of a vehicle's features; its presence comes first.
        outputs: K, more than one for the quantiles of a distributional critic.
        layer_norm: normalise each hidden layer before its activation, without gain or bias.

    Reads ``ego`` [*B, F], ``vehicles`` [*B, M, G] (SI units) and ``action`` [*B, A] in [-1, 1];
    returns values [*B, K].

    Raises:
        ValueError: as :class:`SetPolicyEncoder`.

    Examples:
        >>> import torch
        >>> from saferl.modules import SetValue
        >>> value = SetValue(width=32)
        >>> value(torch.randn(5, 9), torch.zeros(5, 3, 6), torch.zeros(5, 2)).shape
        torch.Size([5, 1])
    """

    def __init__(
        self,
        width: int = 128,
        depth: int = 2,
        vehicle_width: int | None = None,
        action_dim: int = 2,
        activation: type[nn.Module] = nn.GELU,
        ego_scale: Sequence[float] = EGO_SCALE,
        vehicle_scale: Sequence[float] = VEHICLE_SCALE,
        outputs: int = 1,
        layer_norm: bool = False,
    ):
        vehicle_width = width if vehicle_width is None else vehicle_width
        check_sizes(vehicle_width=vehicle_width)
        scene = _PooledScene(vehicle_width, ego_scale, vehicle_scale)
        keys = ("ego", "vehicles")
        self._build(scene, keys, width, depth, action_dim, activation, outputs, layer_norm)


@dataclass(frozen=True)
class MaxPool(Encoder):
    """A layer on each vehicle and their largest values, for all networks of an algorithm.

    Args:
        width, depth, vehicle_width, activation: see :class:`SetPolicyEncoder`.
        action_dim: size of the action.
        ego_scale: divisors of the ego features.
        vehicle_scale: divisors of a vehicle's features; its presence comes first.

    Examples:
        >>> from saferl.modules import MaxPool
        >>> type(MaxPool(width=32).policy()).__name__
        'SetPolicyEncoder'
    """

    width: int = 128
    depth: int = 2
    vehicle_width: int | None = None
    activation: type[nn.Module] = nn.GELU
    action_dim: int = 2
    ego_scale: Sequence[float] = EGO_SCALE
    vehicle_scale: Sequence[float] = VEHICLE_SCALE

    def policy(self) -> SetPolicyEncoder:
        return SetPolicyEncoder(**self.settings("action_dim"))

    def value(self, **options: Any) -> SetValue:
        return SetValue(**self.settings(), **options)
