"""The networks of an agent: policy, state values and action values."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase

from saferl.algorithms.parts import Parts, make, offered
from saferl.envs.transforms import Saute
from saferl.modules import Encoder, tanh_gaussian_actor, value_operator, zero_output

#: Options of a critic of action values, and what they are where nothing is said.
USUAL = {"outputs": 1, "layer_norm": False}


class NetworkBuilder:
    """Makes the networks of one agent, and remembers what they read.

    Args:
        parts: of the agent.
        transform: what widens the task's observation, if anything does.
    """

    def __init__(self, parts: Parts, transform: Saute | None = None):
        self.parts = parts
        node, network = parts.encoder, parts.task.network
        self.widened: dict[str, str] = {}
        if transform is not None:
            network = parts.task.widened(transform.count)
            self.widened = {parts.task.vector: str(transform.out_key)}
        self.encoder: Encoder = make(node, offered(node, network))
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
        keys = tuple(self.widened.get(key) or key for key in keys)
        self.observed += [key for key in keys if key not in self.observed]
        return keys

    def actor(self, initial_std: float) -> TensorDictModuleBase:
        """The policy."""
        features = self.encoder.policy()
        width, action_dim = self.encoder.width, self.parts.task.network["action_dim"]
        keys = self.reads(features)
        actor = tanh_gaussian_actor(features, width, action_dim, keys, scale_init=initial_std)
        return actor.to(self.parts.device)

    def action_values(
        self,
        critics: DictConfig,
        out_key: str,
        prepare: Callable[[Any], Any] = lambda network: network,
        costs: int = 1,
    ) -> Any:
        """As many values of an action as a group of critics has members: one, or a list.

        Args:
            critics: the group.
            out_key: where each writes.
            prepare: what is done with each first.
            costs: of how many costs each is a value.
        """
        # Only what differs, so that an encoder need not know of options that it is not asked for.
        options = critic_options(critics)
        options["outputs"] *= costs
        options = {k: v for k, v in options.items() if v != USUAL[k]}
        networks = [
            self.encoder.value(**options).to(self.parts.device) for _ in range(critics.members)
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
        critics, costs = self.parts.cost_critic, len(self.parts.task.costs)
        return self.action_values(critics, "state_action_cost_value", zero_output, costs)


def critic_options(critics: DictConfig) -> dict[str, Any]:
    """The options of a group of critics."""
    given = {key: critics.get(key) for key in USUAL}
    return {key: USUAL[key] if value is None else value for key, value in given.items()}


def refuse_options(name: str, critics: DictConfig, reason: str) -> None:
    """Refuse options of critics that there are not, and say why.

    Raises:
        ValueError: one of them is not the usual one.
    """
    for key, value in critic_options(critics).items():
        if value != USUAL[key]:
            raise ValueError(f"{name}.{key} {reason}, got {value}.")
