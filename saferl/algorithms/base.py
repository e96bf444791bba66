"""From settings to an agent: the networks, loss and projector of one composition."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import hydra
import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, Transform
from torchrl.objectives import LossModule

from saferl.config.check import arguments
from saferl.envs.task import Task
from saferl.envs.transforms import SafetyProjector
from saferl.modules import CVaR, MeanStd, tanh_gaussian_actor, value_operator, zero_output
from saferl.training.learner import Learner
from saferl.training.trainer import Experience

#: What is kept of a transition besides the observation.
STORED = (
    "action",
    *(("next", key) for key in ("reward", "cost", "done", "terminated")),
    ("next", "action_executed"),
)
#: Options of a critic of action values, and what they are where nothing is said.
USUAL = {"outputs": 1, "layer_norm": False}


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
        ValueError: the node sets what the composition gives.
    """
    for key in set(node) & set(objects):
        raise ValueError(
            f"{node._get_full_key(key)} cannot be set: it follows from the rest of the configuration."
        )
    return hydra.utils.instantiate(node, _partial_=True, **(settings or {}))(**objects)


def offered(node: DictConfig, task: Task) -> dict[str, Any]:
    """What a task offers to a network and its configuration leaves open, as far as the network takes it."""
    accepted = arguments(node._target_)
    return {
        key: value
        for key, value in task.network.items()
        if key not in node and (accepted is None or key in accepted)
    }


@dataclass(frozen=True)
class Parts:
    """What an algorithm is composed of: the nodes of a configuration, and the task.

    Attributes:
        task: what is learned.
        encoder, critic, cost_critic, risk, loss, lagrange, projector: nodes of these groups.
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
    gamma: float
    device: torch.device

    @classmethod
    def of(cls, cfg: DictConfig) -> Parts:
        """The parts of a run's configuration."""
        groups = ("encoder", "critic", "cost_critic", "risk", "loss", "lagrange", "projector")
        return cls(
            task=hydra.utils.instantiate(cfg.task),
            gamma=cfg.gamma,
            device=device_of(cfg.device),
            **{group: cfg[group] for group in groups},
        )

    @property
    def takes(self) -> set[str]:
        """Names of what the loss is built from."""
        return set(inspect.signature(hydra.utils.get_object(self.loss._target_)).parameters)


@dataclass
class Agent:
    """NetworkBuilder and loss of one composition.

    Attributes:
        actor: the policy.
        observed: keys of the observation that the networks read.
        loss: owns the live parameters of all networks, targets, temperature and multiplier.
        projector: a :class:`SafetyProjector` on the loss's live cost critics, or None.
    """

    actor: TensorDictModuleBase
    observed: tuple[str, ...]
    loss: LossModule
    projector: SafetyProjector | None


class NetworkBuilder:
    """Makes the networks of one agent, and remembers what they read.

    Args:
        parts: of the agent.
    """

    def __init__(self, parts: Parts):
        self.parts = parts
        self.observed: list[str] = []

    def reads(self, network: Any) -> tuple[str, ...]:
        """The keys that a network reads.

        Raises:
            ValueError: the task does not offer them.
        """
        keys, task = tuple(network.in_keys), self.parts.task
        if not set(keys) <= set(task.observed):
            raise ValueError(
                f"{type(network).__name__} reads {', '.join(keys)}, but task={task.task} observes "
                f"{', '.join(task.observed)}: set encoder=mlp, or an algorithm with one (rsac, sac, ...)."
            )
        self.observed += [key for key in keys if key not in self.observed]
        return keys

    def policy_encoder(self) -> Any:
        """Features of what is observed."""
        node = self.parts.encoder.policy
        return hydra.utils.instantiate(node, **offered(node, self.parts.task))

    @property
    def width(self) -> int:
        """The size of these features."""
        return self.parts.encoder.policy.width

    def actor(self, initial_std: float) -> TensorDictModuleBase:
        """The policy."""
        encoder, action_dim = self.policy_encoder(), self.parts.task.network["action_dim"]
        keys = self.reads(encoder)
        actor = tanh_gaussian_actor(encoder, self.width, action_dim, keys, scale_init=initial_std)
        return actor.to(self.parts.device)

    def action_values(
        self,
        critics: DictConfig,
        out_key: str,
        prepare: Callable[[Any], Any] = lambda network: network,
    ) -> Any:
        """As many values of an action as a group of critics has members: one, or a list.

        Args:
            critics: the group.
            out_key: where each writes.
            prepare: what is done with each first.
        """
        node = self.parts.encoder.value
        # Only what differs, so that an encoder need not know of options that it is not asked for.
        options = {k: v for k, v in critic_options(critics).items() if v != USUAL[k]}
        networks = [
            hydra.utils.instantiate(node, **offered(node, self.parts.task), **options).to(
                self.parts.device
            )
            for _ in range(critics.members)
        ]
        members = [
            value_operator(
                prepare(network), in_keys=(*self.reads(network), "action"), out_key=out_key
            )
            for network in networks
        ]
        # Of a list of one TorchRL makes parameters that no optimizer sees.
        return members[0] if len(members) == 1 else members

    def risk_critics(self) -> Any:
        """Q_c(s, a), at 0, or a projector would correct every action before the first cost was seen."""
        return self.action_values(self.parts.cost_critic, "state_action_cost_value", zero_output)


def critic_options(critics: DictConfig) -> dict[str, Any]:
    """The options of a group of critics."""
    given = {key: critics.get(key) for key in USUAL}
    return {key: USUAL[key] if value is None else value for key, value in given.items()}


class Algorithm(ABC):
    """A family of algorithms: what it builds from its own settings and a composition's parts.

    A subclass is a dataclass of the settings in conf/learning.

    Attributes:
        values: the argument by which a loss of this family takes the values of rewards.
        risks: the argument by which it takes Q_c(s, a), if it does.
    """

    values: ClassVar[str]
    risks: ClassVar[str]
    batch_size: int
    reward_scale: float
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
        learner: Learner,
        task: Task,
        build_env: Callable[[int, int], EnvBase],
        num_envs: int,
        seed: int,
    ) -> Experience:
        """What the learner updates from.

        Args:
            agent, learner, task: what learns what.
            build_env: makes more environments from their number and a seed.
            num_envs: environments at once.
            seed: of the mini-batches.

        Raises:
            ValueError: what is configured cannot be learned from.
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

    def check(self, parts: Parts) -> None:
        """Refuse parts that do not go together.

        Raises:
            ValueError: names them, and what to set.
        """
        takes, loss = parts.takes, parts.loss._target_
        if self.values not in takes:
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
            if present and name not in takes:
                raise ValueError(f"{loss} takes no {name}: set {name}=none, or another loss.")
            if name in takes and not present:
                raise ValueError(f"{loss} needs {name}, got {name}=none.")
        if parts.projector._target_ is not None and self.risks not in takes:
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
        """NetworkBuilder, loss and projector.

        Raises:
            ValueError: parts that do not go together.
        """
        self.check(parts)
        networks, takes = NetworkBuilder(parts), parts.takes
        actor = networks.actor(self.initial_std)
        settings = {
            "actor_network": lambda: actor,
            **self.loss_parts(networks),
            "num_qvalue_nets": lambda: parts.critic.members,
            "num_cost_critics": lambda: parts.cost_critic.members,
            "lagrange": lambda: hydra.utils.instantiate(parts.lagrange.multiplier),
        }
        built = {name: part() for name, part in settings.items() if name in takes}
        loss = make(parts.loss, **built).to(parts.device)
        self.estimate(loss, parts.gamma)
        projector = None
        if parts.projector._target_ is not None:
            projector = make(parts.projector, risk=loss.cost_value)
        return Agent(actor, tuple(networks.observed), loss, projector)

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
            for key in ("rows", "size", "action_dim", "observation")
        }
        # Of the critics those of action values: state values have no options.
        critics = {"critic": "qvalue_network", "cost_critic": self.risks}
        present = [name for name, argument in critics.items() if argument in parts.takes]
        for network in ("policy", "value") if present else ("policy",):
            for key, value in parts.encoder[network].items():
                options[f"encoder.{network}.{key}"] = value
        for name in present:
            critic = getattr(parts, name)
            if critic.members > 0:
                own = {"members": critic.members, **critic_options(critic)}
                options |= {f"{name}.{key}": value for key, value in own.items()}
        return options


def keys_of(agent: Agent) -> Sequence[Any]:
    """What is stored of an observation and the next."""
    return (*agent.observed, *(("next", key) for key in agent.observed))
