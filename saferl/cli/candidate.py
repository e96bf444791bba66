"""Who is tested, and with what it drives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.transforms import Transform

from saferl.algorithms.parts import make
from saferl.algorithms.policy import trained_agent


@dataclass(frozen=True)
class Candidate:
    """Who is tested.

    Attributes:
        name: what to call it.
        policy: acts.
        transforms: what it drives with.
        projects: whether a projector is among them.
        critics: Q_c(s, a) that it has learned, if it has, and their ``limit``.
        about: what else is known of its training.
        origin: what a trace says of it.
    """

    name: str
    policy: TensorDictModuleBase
    transforms: Sequence[Transform] = ()
    projects: bool = False
    critics: TensorDictModuleBase | None = None
    limit: float | Sequence[float] | None = None
    about: Mapping[str, Any] = field(default_factory=dict)
    origin: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def trained(cls, name: str, cfg: DictConfig, path: Path, project: bool = True) -> Candidate:
        """The policy of a run or checkpoint.

        Args:
            name: what to call it.
            cfg: the run's configuration.
            path: the run or checkpoint.
            project: whether it drives with its projector, if it has one.
        """
        agent = trained_agent(cfg, path)
        projects = project and agent.projector is not None
        limit: Any = cfg.cost_limit
        about = {"cost_limit": OmegaConf.to_object(limit) if OmegaConf.is_config(limit) else limit}
        origin = {"algo": cfg.algo_name, "training_seed": cfg.seed}
        if not project and agent.projector is not None:
            origin["algo"] += " unprojected"
        transforms = agent.transforms if projects else agent.wraps
        who = cls(name, agent.actor, transforms, projects, agent.risk, agent.limit, about, origin)
        return who.called(cfg.projector.get("name")) if project else who

    def behind(self, node: DictConfig) -> Candidate:
        """The same with a projector behind its own, which has the last word; itself where the node is of none."""
        if node.get("_target_") is None:
            return self
        *wraps, own = self.transforms if self.projects else [*self.transforms, None]
        given: dict[str, Any] = {} if own is None else {"first": own}
        who = replace(self, transforms=[*wraps, make(node, **given)], projects=True)
        return who.called(node.get("name"))

    def called(self, name: str | None) -> Candidate:
        """The same in a row of its own, ``arsac + shield``, where what corrects it has a name."""
        if name is None:
            return self
        own, of, run = self.name.partition(" (")
        origin = {**self.origin, "algo": f"{self.origin['algo']} + {name}"}
        return replace(self, name=f"{own} + {name}{of}{run}", origin=origin)
