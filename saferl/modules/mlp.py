"""Plain MLPs over the flattened scene: the encoder and value network of the baselines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from saferl.modules.encoder import Encoder
from saferl.modules.scene import (
    EGO_SCALE,
    VEHICLE_SCALE,
    check_sizes,
    feature_scale,
    scale_ego,
    scale_vehicles,
)


class _FlatScene(nn.Module):
    """Scaled ego features and all vehicle rows in one vector [*B, 9 + 6 rows]."""

    ego_scale: Tensor
    vehicle_scale: Tensor

    def __init__(self, rows: int, ego_scale: Sequence[float], vehicle_scale: Sequence[float]):
        super().__init__()
        self.rows = rows
        self.size = len(ego_scale) + rows * len(vehicle_scale)
        self.register_buffer("ego_scale", feature_scale("ego_scale", ego_scale))
        self.register_buffer("vehicle_scale", feature_scale("vehicle_scale", vehicle_scale))

    def forward(self, ego: Tensor, vehicles: Tensor) -> Tensor:
        if vehicles.shape[-2] != self.rows:
            raise ValueError(
                f"vehicles must have rows={self.rows} rows, got {vehicles.shape[-2]}: an MLP is "
                f"bound to the number of rows it was built for. Set rows to the environment's."
            )
        features, _ = scale_vehicles(vehicles, self.vehicle_scale)
        return torch.cat([scale_ego(ego, self.ego_scale), features.flatten(-2)], dim=-1)


class _Vector(nn.Module):
    """A plain observation as it is."""

    def __init__(self, size: int):
        super().__init__()
        self.size = size

    def forward(self, observation: Tensor) -> Tensor:
        if observation.shape[-1] != self.size:
            raise ValueError(
                f"observation must have size={self.size}, got {observation.shape[-1]}."
            )
        return observation


def _front(
    size: int | None, rows: int | None, ego_scale: Sequence[float], vehicle_scale: Sequence[float]
) -> _FlatScene | _Vector:
    """What an MLP's first layer sees."""
    if size is not None:
        return _Vector(size)
    if rows is None:
        raise ValueError("An MLP needs rows, of the vehicles, or size, of a plain observation.")
    return _FlatScene(rows, ego_scale, vehicle_scale)


def _hidden(size: int, width: int, depth: int, activation: type[nn.Module]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for _ in range(depth):
        layers += [nn.Linear(size, width), activation()]
        size = width
    return nn.Sequential(*layers)


class MLPPolicyEncoder(nn.Module):
    """Hidden layers over ego and vehicles, flattened: features of a scene for a policy.

    Args:
        rows: M, the number of vehicle rows; other numbers are refused.
        width: units of each hidden layer, and the size of the output.
        depth: number of hidden layers, at least 1.
        activation: the module class of the activation, one without parameters.
        ego_scale: divisors of the ego features.
        vehicle_scale: divisors of a vehicle's features; I_veh comes first.
        size: of a plain ``observation`` [*B, size] that takes the place of ego and vehicles; None: these.

    Reads ``ego`` [*B, F] and ``vehicles`` [*B, M, G], SI units, as many features as scales; returns features [*B, width].

    Raises:
        ValueError: if ``depth < 1``, a feature scale is not positive and finite, or (at the call)
            the number of vehicle rows is not ``rows``.

    Examples:
        >>> import torch
        >>> from saferl.modules import MLPPolicyEncoder
        >>> MLPPolicyEncoder(rows=3, width=32)(torch.randn(5, 9), torch.zeros(5, 3, 6)).shape
        torch.Size([5, 32])
    """

    def __init__(
        self,
        rows: int | None = 11,
        width: int = 256,
        depth: int = 3,
        activation: type[nn.Module] = nn.GELU,
        ego_scale: Sequence[float] = EGO_SCALE,
        vehicle_scale: Sequence[float] = VEHICLE_SCALE,
        size: int | None = None,
    ):
        scene = _front(size, rows, ego_scale, vehicle_scale)
        keys = ("ego", "vehicles") if size is None else ("observation",)
        self._build(scene, keys, width, depth, activation)

    def _build(
        self,
        scene: Any,
        in_keys: tuple[str, ...],
        width: int,
        depth: int,
        activation: type[nn.Module],
    ) -> None:
        check_sizes(width=width, depth=depth)
        super().__init__()
        self.scene, self.in_keys = scene, in_keys
        self.layers = _hidden(scene.size, width, depth, activation)

    def forward(self, *observed: Tensor) -> Tensor:
        return self.layers(self.scene(*observed))


class MLPValue(nn.Module):
    """Action value from an MLP over ego, vehicles and action, flattened.

    Args:
        rows: M, the number of vehicle rows; other numbers are refused.
        width: units of each hidden layer.
        depth: number of hidden layers, at least 1.
        action_dim: size of the action.
        activation: the module class of the activation, one without parameters.
        ego_scale: divisors of the ego features.
        vehicle_scale: divisors of a vehicle's features; I_veh comes first.
        size: of a plain ``observation`` [*B, size] that takes the place of ego and vehicles; None: these.
        outputs: K, more than one for the quantiles of a distributional critic.
        layer_norm: normalise each hidden layer before its activation, without gain or bias.

    Reads ``ego`` [*B, F], ``vehicles`` [*B, M, G] (SI units, as many features as scales) and ``action`` [*B, 2] in [-1, 1];
    returns values [*B, K].

    Raises:
        ValueError: as :class:`MLPPolicyEncoder`.

    Examples:
        >>> import torch
        >>> from saferl.modules import MLPValue
        >>> value = MLPValue(rows=3, width=32)
        >>> value(torch.randn(5, 9), torch.zeros(5, 3, 6), torch.zeros(5, 2)).shape
        torch.Size([5, 1])
    """

    def __init__(
        self,
        rows: int | None = 11,
        width: int = 256,
        depth: int = 3,
        action_dim: int = 2,
        activation: type[nn.Module] = nn.GELU,
        ego_scale: Sequence[float] = EGO_SCALE,
        vehicle_scale: Sequence[float] = VEHICLE_SCALE,
        size: int | None = None,
        outputs: int = 1,
        layer_norm: bool = False,
    ):
        scene = _front(size, rows, ego_scale, vehicle_scale)
        keys = ("ego", "vehicles") if size is None else ("observation",)
        self._build(scene, keys, width, depth, action_dim, activation, outputs, layer_norm)

    def _build(
        self,
        scene: Any,
        in_keys: tuple[str, ...],
        width: int,
        depth: int,
        action_dim: int,
        activation: type[nn.Module],
        outputs: int,
        layer_norm: bool,
    ) -> None:
        check_sizes(width=width, depth=depth, action_dim=action_dim, outputs=outputs)
        super().__init__()
        self.scene, self.in_keys = scene, in_keys
        self.first = nn.Linear(scene.size + action_dim, width)
        self.activation = activation()
        sizes = [width] * (depth - 1) + [outputs]
        self.layers = nn.ModuleList(nn.Linear(width, size) for size in sizes)
        self.layer_norm = layer_norm

    @property
    def readouts(self) -> list[nn.Linear]:
        """The last layer."""
        return [self.layers[-1]]  # pyright: ignore[reportReturnType]

    def encode(self, *observed: Tensor) -> dict[str, Any]:
        """All that :meth:`value` needs: the first layer's sum over the scene, and the weights."""
        on_scene, on_action = self.first.weight.tensor_split([self.scene.size], dim=-1)
        return {
            "first": F.linear(self.scene(*observed), on_scene, self.first.bias),
            "on_action": on_action,
            "layers": [[layer.weight, layer.bias] for layer in self.layers],
        }

    def value(self, scene: dict[str, Any], action: Tensor) -> Tensor:
        """The value of ``action`` [*B, A] in the states of ``scene``, [*B, K]."""
        hidden = scene["first"] + F.linear(action, scene["on_action"])
        for weight, bias in scene["layers"]:
            if self.layer_norm:
                hidden = F.layer_norm(hidden, hidden.shape[-1:])
            hidden = F.linear(self.activation(hidden), weight, bias)
        return hidden

    def forward(self, *inputs: Tensor) -> Tensor:
        *observed, action = inputs
        return self.value(self.encode(*observed), action)


@dataclass(frozen=True)
class MLP(Encoder):
    """Plain layers for all networks of an algorithm.

    Args:
        width, depth, activation: of the hidden layers.
        rows: M, the number of vehicle rows.
        size: of a plain ``observation``, in place of a scene.
        action_dim: size of the action.
        ego_scale: divisors of the ego features.
        vehicle_scale: divisors of a vehicle's features; I_veh comes first.

    Examples:
        >>> from saferl.modules import MLP
        >>> encoder = MLP(width=32, size=4)
        >>> encoder.policy().in_keys, type(encoder.value()).__name__
        (('observation',), 'MLPValue')
    """

    width: int = 256
    depth: int = 3
    activation: type[nn.Module] = nn.GELU
    rows: int | None = 11
    size: int | None = None
    action_dim: int = 2
    ego_scale: Sequence[float] = EGO_SCALE
    vehicle_scale: Sequence[float] = VEHICLE_SCALE

    def policy(self) -> MLPPolicyEncoder:
        return MLPPolicyEncoder(**self.settings("action_dim"))

    def value(self, **options: Any) -> MLPValue:
        return MLPValue(**self.settings(), **options)
