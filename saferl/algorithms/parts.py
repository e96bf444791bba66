"""What an algorithm is composed of, and how a node of a configuration becomes an object."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import hydra
import torch
from omegaconf import DictConfig

from saferl.config.check import arguments, described, part
from saferl.envs.task import Task


def device_of(name: str) -> torch.device:
    """A device by its name; ``auto`` is a GPU where there is one.

    Raises:
        ValueError: CUDA without a GPU.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("device=cuda, but torch sees no GPU; use device=cpu or auto.")
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)


def make(node: DictConfig, settings: Mapping[str, Any] | None = None, **objects: Any) -> Any:
    """Instantiate a node with live objects, which Hydra itself would turn into configurations.

    Args:
        node: with a ``_target_``.
        settings: in place of the node's own.
        **objects: arguments that the node may not set.

    Raises:
        ValueError: the node sets what the composition gives, does not take it, or makes no such part.
    """
    name, takes = str(node._get_full_key(None)), arguments(node._target_)
    for key in objects:
        if key in node:
            raise ValueError(
                f"{name}.{key} cannot be set: it follows from the rest of the configuration."
            )
        if takes is not None and key not in takes:
            raise ValueError(
                f"{name}: {node._target_} takes no {key}, which the composition gives."
            )
    build = partial(hydra.utils.instantiate, node, **(settings or {}))
    made = build(_partial_=True)(**objects) if objects else build()
    kind = part(name)
    if kind is not None and not isinstance(made, kind):
        raise ValueError(f"{name}._target_ must name {described(kind)}, got {node._target_!r}.")
    return made


def offered(node: DictConfig, network: Mapping[str, Any]) -> dict[str, Any]:
    """What a task offers to a network (``Task.network``) and its configuration leaves open, as far as the network takes it."""
    accepted = arguments(node._target_)
    return {
        key: value
        for key, value in network.items()
        if key not in node and (accepted is None or key in accepted)
    }


def takes(node: DictConfig, key: str) -> bool:
    """Whether what a node makes takes an argument of this name."""
    accepted = arguments(node._target_)
    return accepted is None or key in accepted


@dataclass(frozen=True)
class Parts:
    """What an algorithm is composed of: the nodes of a configuration, and the task.

    Attributes:
        task: what is learned.
        encoder, critic, cost_critic, risk, loss, lagrange, projector, transform: nodes of these groups; a run of an
            older version has no transform.
        gamma: discount.
        device: of everything.
    """

    task: Task
    encoder: DictConfig
    critic: DictConfig
    cost_critic: DictConfig
    risk: DictConfig
    loss: DictConfig
    lagrange: DictConfig
    projector: DictConfig
    transform: DictConfig | None
    gamma: float
    device: torch.device

    @classmethod
    def of(cls, cfg: DictConfig) -> Parts:
        """The parts of a run's configuration."""
        groups = (
            "encoder",
            "critic",
            "cost_critic",
            "risk",
            "loss",
            "lagrange",
            "projector",
            "transform",
        )
        return cls(
            task=make(cfg.task),
            gamma=cfg.gamma,
            device=device_of(cfg.device),
            **{group: cfg.get(group) for group in groups},
        )

    @property
    def takes(self) -> set[str]:
        """Names of what the loss is built from."""
        return set(inspect.signature(hydra.utils.get_object(self.loss._target_)).parameters)
