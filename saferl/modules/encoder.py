"""An encoder: how the networks of an algorithm see what is observed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

from torch import nn


@dataclass(frozen=True)
class Encoder(ABC):
    """Settings from which an algorithm makes all its networks: one choice of ``conf/encoder``.

    A subclass is a dataclass with the settings of both networks as its fields. It gets what the task knows of its
    observation (``Task.network``) where a field has that name.

    Attributes:
        width: size of the policy's features.
    """

    width: int

    @abstractmethod
    def policy(self) -> nn.Module:
        """A network of the features [*B, width] that a policy, or the value of a state, reads.

        Its ``in_keys`` are what it observes.
        """

    @abstractmethod
    def value(self, **options: Any) -> nn.Module:
        """A network of an action's value [*B, outputs], from what it observes (``in_keys``) and the action.

        Args:
            **options: ``outputs`` and ``layer_norm``, where a group of critics asks for others than 1 and false.
        """

    def settings(self, *without: str) -> dict[str, Any]:
        """All fields by name, except the ones given."""
        return {name: value for name, value in vars(self).items() if name not in without}
