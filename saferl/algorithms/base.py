"""A family of algorithms, and the agents that it builds from a composition's parts."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, Transform
from torchrl.objectives import LossModule

from saferl.algorithms.networks import NetworkBuilder, critic_options, refuse_options
from saferl.algorithms.parts import Parts, make, takes
from saferl.envs.task import Task
from saferl.envs.transforms import Correction, Saute
from saferl.modules import CriticEnsemble, CVaR, MeanStd
from saferl.training.learner import Learner
from saferl.training.trainer import Experience

#: What is kept of a transition besides the observation.
STORED = (
    "action",
    *(("next", key) for key in ("reward", "cost", "done", "terminated")),
    ("next", "action_executed"),
)

#: Networks of a loss that no decision reads, by how their names begin.
_UNREAD = ("target_", "qvalue_network", "critic_network")


@dataclass
class Agent:
    """Networks and loss of one composition.

    Attributes:
        actor: the policy.
        observed: keys of the observation that the networks read.
        loss: owns the live parameters of all networks, targets, temperature and multiplier.
        projector: what corrects its actions, such as a :class:`SafetyProjector` on the loss's live cost critics, or None.
        transform: a :class:`Saute` of the task, or None.
    """

    actor: TensorDictModuleBase
    observed: tuple[str, ...]
    loss: LossModule
    projector: Correction | None
    transform: Saute | None = None

    @property
    def wraps(self) -> list[Transform]:
        """What makes the task the one that the policy knows."""
        return [] if self.transform is None else [self.transform]

    @property
    def transforms(self) -> list[Transform]:
        """What the policy drives with, from the inside outwards."""
        return [*self.wraps, *([] if self.projector is None else [self.projector])]

    @property
    def risk(self) -> CriticEnsemble | None:
        """Q_c(s, a) of the live cost critics; None where the loss has none."""
        return getattr(self.loss, "cost_value", None)

    @property
    def limit(self) -> float | list[float] | None:
        """What the risk is to stay below in each state, of several costs each: the projector's, else the loss's; None where
        nothing limits it there."""
        limit = getattr(self.projector, "limit", None)
        if limit is not None:
            return limit
        return torch.as_tensor(getattr(self.loss, "risk_limit", 0.0)).tolist() or None

    @property
    def stored(self) -> tuple[Any, ...]:
        """Keys of a transition that are kept: what the networks read of a state and of the next, and :data:`STORED`."""
        return (*self.observed, *(("next", key) for key in self.observed), *STORED)

    def switches(self) -> dict[str, Tensor]:
        """What the transforms are told in training (whether a projector acts yet), by name."""
        return {
            f"transform{index}.{name}": torch.as_tensor(value)
            for index, transform in enumerate(self.transforms)
            for name, value in transform.state_dict().items()
        }

    def learned(self) -> dict[str, Tensor]:
        """All that decides what is executed, by name: live tensors of the loss, without its targets and values of rewards,
        and :meth:`switches`."""
        return self._read() | self.switches()

    def _read(self) -> dict[str, Tensor]:
        return {
            name: value
            for name, value in self.loss.state_dict().items()
            if isinstance(value, Tensor) and not name.startswith(_UNREAD)
        }

    @torch.no_grad()
    def take(self, learned: Mapping[str, Tensor]) -> None:
        """Decide as another agent of this composition would, of which this is :meth:`learned`; what it lacks stays."""
        for name, value in self._read().items():
            if name in learned:
                value.copy_(learned[name])
        for index, transform in enumerate(self.transforms):
            own = transform.state_dict()
            told = {name: learned[f"transform{index}.{name}"] for name in own}
            transform.load_state_dict(
                {k: v if isinstance(own[k], Tensor) else v.item() for k, v in told.items()}
            )


def chain(projector: DictConfig) -> list[DictConfig]:
    """The node of a projector, before it those of what corrects first; none where actions are executed as proposed."""
    if projector.get("_target_") is None:
        return []
    return [*(chain(projector.first) if "first" in projector else []), projector]


class Algorithm(ABC):
    """A family of algorithms: what it builds from its own settings and a composition's parts.

    A subclass is a dataclass of the settings in conf/learning.

    Attributes:
        values: the argument by which a loss of this family takes the values of rewards.
        risks: the argument by which it takes Q_c(s, a), if it does.
        kept: the option that says how many transitions are kept.
    """

    values: ClassVar[str]
    risks: ClassVar[str]
    kept: ClassVar[str]
    initial_std: float
    lr: Any

    @abstractmethod
    def loss_parts(self, networks: NetworkBuilder) -> dict[str, Callable[[], Any]]:
        """What losses of this family are built from, by the names of their arguments, in the order of building."""

    @abstractmethod
    def estimate(self, loss: LossModule, gamma: float) -> None:
        """Tell a loss how it finds the values that it learns."""

    @abstractmethod
    def learner(self, loss: LossModule, compile: bool) -> Learner:
        """What makes an update of a loss."""

    @abstractmethod
    def experience(
        self,
        agent: Agent,
        task: Task,
        build_env: Callable[[int, int], EnvBase],
        num_envs: int,
        seed: int,
    ) -> Experience:
        """What the learner updates from.

        Args:
            agent, task: what learns what.
            build_env: makes more environments from their number and a seed.
            num_envs: environments at once.
            seed: of the mini-batches.
        """

    @abstractmethod
    def decisions(self, num_envs: int) -> int:
        """Decisions of each environment between two rounds of updates."""

    def transforms(self) -> list[Transform]:
        """What the family needs around its environment."""
        return []

    def behaviour(self, actor: Any, env: EnvBase) -> Any:
        """What acts while experience is collected."""
        return actor

    def random_frames(self) -> int:
        """Frames of random actions at the start of a new policy."""
        return 0

    @abstractmethod
    def check_collecting(self, task: Task, num_envs: int) -> None:
        """Refuse settings that do not fit what is collected, before anything is built.

        Raises:
            ValueError: names them, and what they must be.
        """

    def check(self, parts: Parts) -> None:
        """Refuse parts that do not go together.

        Raises:
            ValueError: names them, and what to set.
        """
        accepted, loss = parts.takes, parts.loss._target_
        if self.values not in accepted:
            raise ValueError(
                f"{type(self).__name__} learns by losses with a {self.values}, which {loss} has not: "
                "leave learning= to the algorithm."
            )
        groups = {
            "cost_critic": parts.cost_critic.members > 0,
            "lagrange": parts.lagrange.multiplier._target_ is not None,
            "risk": parts.risk._target_ is not None,
        }
        for name, present in groups.items():
            if present and name not in accepted:
                raise ValueError(f"{loss} takes no {name}: set {name}=none, or another loss.")
            if name in accepted and not present:
                raise ValueError(f"{loss} needs {name}, got {name}=none.")
        if not groups["cost_critic"]:
            refuse_options(
                "cost_critic", parts.cost_critic, "is of cost critics, but cost_critic=none"
            )
        if self.risks not in accepted and any(
            takes(node, "risk") for node in chain(parts.projector)
        ):
            raise ValueError(
                f"projector needs cost critics Q_c(s, a), which {loss} has not: "
                "set projector=none, or loss=sac_lag or ppo_risk."
            )
        if not groups["risk"]:
            return
        risk = hydra.utils.get_object(parts.risk._target_)

        def risk_is(kind: type) -> bool:
            return isinstance(risk, type) and issubclass(risk, kind)

        if risk_is(CVaR) and parts.cost_critic.get("outputs", 1) == 1:
            raise ValueError("risk=cvar is of quantiles: set cost_critic=quantile.")
        if risk_is(MeanStd) and parts.cost_critic.members == 1:
            raise ValueError("risk=mean_std is of several members: set cost_critic=ensemble.")

    def agent(self, parts: Parts) -> Agent:
        """Networks, loss and projector.

        Raises:
            ValueError: parts that do not go together.
        """
        self.check(parts)
        transform = None
        if parts.transform is not None and parts.transform._target_ is not None:
            transform = make(parts.transform, in_key=parts.task.vector)
        networks, accepted = NetworkBuilder(parts, transform), parts.takes
        actor = networks.actor(self.initial_std)
        settings = {
            "actor_network": lambda: actor,
            **self.loss_parts(networks),
            "num_qvalue_nets": lambda: parts.critic.members,
            "num_cost_critics": lambda: parts.cost_critic.members,
            "lagrange": lambda: make(parts.lagrange.multiplier).expand(len(parts.task.costs)),
        }
        built = {name: part() for name, part in settings.items() if name in accepted}
        loss = make(parts.loss, **built).to(parts.device)
        self.estimate(loss, parts.gamma)
        projector = None
        for node in chain(parts.projector):
            alone = node.copy()
            OmegaConf.set_struct(alone, False)
            alone.pop("first", None)
            given = {"risk": loss.cost_value} if takes(node, "risk") else {}
            projector = make(alone, **given, **({"first": projector} if projector else {}))
        return Agent(actor, tuple(networks.observed), loss, projector, transform)

    def optimizer(self, loss: LossModule) -> torch.optim.Optimizer:
        """Adam with one group each for actor, critics and temperature, and their schedules."""
        groups: dict[str, list[torch.nn.Parameter]] = {"actor": [], "critic": [], "alpha": []}
        for name, parameter in loss.named_parameters():
            kind = {"actor_network_params": "actor", "log_alpha": "alpha"}.get(
                name.split(".")[0], "critic"
            )
            groups[kind].append(parameter)
        rates = {name: self.lr[name] for name, own in groups.items() if own}
        return torch.optim.Adam(
            [
                {"params": groups[name], "name": name, "lr": first, "schedule": (first, last)}
                for name, (first, last) in rates.items()
            ],
            fused=True,
        )

    def architecture(self, parts: Parts) -> dict[str, Any]:
        """What decides whether the networks of two compositions fit, by option."""
        options: dict[str, Any] = {
            f"task.{key}": getattr(parts.task, key, None)
            for key in ("rows", "size", "action_dim", "observation", "costs")
        }
        # Of the critics those of action values: state values have no options.
        critics = {"critic": "qvalue_network", "cost_critic": self.risks}
        present = [name for name, argument in critics.items() if argument in parts.takes]
        options |= {f"encoder.{key}": value for key, value in parts.encoder.items()}
        for name in present:
            critic = getattr(parts, name)
            if critic.members > 0:
                own = {"members": critic.members, **critic_options(critic)}
                options |= {f"{name}.{key}": value for key, value in own.items()}
        return options
