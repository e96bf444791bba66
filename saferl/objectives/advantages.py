"""State values of reward and cost beside an on-policy loss, and their advantages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import PPOLoss
from torchrl.objectives.utils import distance_loss

from saferl.objectives.adapter import LossMixin
from saferl.objectives.checks import check_begun, check_cost


@dataclass
class CostValueKeys(PPOLoss._AcceptedKeys):
    """Keys that ``set_keys`` accepts beside those of :class:`~torchrl.objectives.PPOLoss`.

    Attributes:
        cost: the cost under ``"next"``.
        state_cost_value: what the cost critic writes.
        cost_advantage, cost_value_target: written by ``begin``, read by the loss.
    """

    cost: NestedKey = "cost"
    state_cost_value: NestedKey = "state_cost_value"
    cost_advantage: NestedKey = "cost_advantage"
    cost_value_target: NestedKey = "cost_value_target"


def written(network: TensorDictModule, key: NestedKey) -> NestedKey:
    """What a network calls its value: ``key``, or else the first of its entries."""
    return key if key in network.out_keys else network.out_keys[0]


@torch.no_grad()
def score_actions(loss: Any, tensordict: TensorDictBase) -> None:
    """Write the log-probability of each action as it is kept, by the very distribution that drew it.

    TorchRL scores a fresh action by the number before its tanh. Near the end of the box float32 rounds the action, and no
    loss finds that number again: the ratio of an unchanged policy would not be 1.

    Args:
        loss: an on-policy loss, whose actor drew the actions.
        tensordict: ``[*B]``, fresh from the actor.

    Reads ``"action"`` ``[*B, A]`` and the parameters of its distribution, as the actor wrote them (``"loc"`` and
        ``"scale"`` ``[*B, A]``). A batch without them stays as it is.
    Writes ``"action_log_prob"`` ``[*B]``.
    """
    actor, keys = loss.actor_network, loss.tensor_keys
    parameters = actor[-1].in_keys
    if all(tensordict.get(key, None) is not None for key in parameters):
        action = tensordict.get(keys.action)
        log_prob = actor.build_dist_from_params(tensordict).log_prob(action)
        tensordict.set(keys.sample_log_prob, log_prob)


class CostValueMixin(LossMixin):
    r"""A cost critic V_c(s), a second GAE and their loss, for an on-policy loss of TorchRL.

    .. math::

        L_c = E[\tfrac12 (V_c(s) - G_c)^2]

    with :math:`G_c` the cost's value target, TD(lambda). Comes first among the bases, as in
    ``class PPOLagLoss(CostValueMixin, ClipPPOLoss)``. The subclass calls :meth:`add_cost_value` once its other networks
    are there, and names in ``input_networks`` and ``input_entries`` what its ``forward`` reads.

    A limit on an episode's cost is about the episode, so the cost's estimator stops where one is ``done``. The
    reward's goes on through a truncation, as everywhere. Both go on where a batch cuts an episode off.
    """

    #: Networks whose inputs the subclass's ``forward`` reads.
    input_networks: ClassVar[tuple[str, ...]]
    #: Entries that it reads, by their names in ``tensor_keys``.
    input_entries: ClassVar[tuple[str, ...]]

    costs: int
    cost_critic: TensorDictModule
    cost_critic_params: TensorDictParams
    target_cost_critic_params: TensorDictParams

    # Of the loss beside this one, or made late.
    critic_network: TensorDictModule
    critic_network_params: TensorDictParams
    target_critic_network_params: TensorDictParams

    def add_cost_value(self, cost_critic: TensorDictModule, costs: int = 1) -> None:
        """Take the cost critic of so many costs in, and make the estimators, by the names that the two values have."""
        self.costs = costs
        actor: Any = self.actor_network
        policy = list(actor.parameters()) if self.separate_losses else None
        self.convert_to_functional(cost_critic, "cost_critic", compare_against=policy)
        self.set_keys(
            value=written(self.critic_network, self.tensor_keys.value),
            state_cost_value=written(cost_critic, self.tensor_keys.state_cost_value),
        )
        # Asked for now, so that a fresh loss loads a state_dict strictly.
        _ = self.value_estimator

    def cost_estimator_keys(self) -> dict[str, NestedKey]:
        keys = self.tensor_keys
        return {
            "advantage": keys.cost_advantage,
            "value_target": keys.cost_value_target,
            "value": keys.state_cost_value,
            "reward": keys.cost,
            "done": keys.done,
            "terminated": keys.done,
        }

    def read_keys(self) -> list[NestedKey]:
        # The other base asks before the cost critic is there.
        networks = [getattr(self, name) for name in self.input_networks if hasattr(self, name)]
        keys = [key for network in networks for key in network.in_keys]
        keys += [getattr(self.tensor_keys, name) for name in self.input_entries]
        return list(dict.fromkeys(keys))

    @torch.no_grad()
    def begin(self, tensordict: TensorDictBase) -> None:
        """Write the advantages and value targets of a batch of fresh transitions, before it is cut into mini-batches.

        The actions' log-probabilities are written anew, see :func:`score_actions`.

        Args:
            tensordict: ``[*B, T]``.

        Reads the value networks' inputs at the root and under ``"next"``; under ``"next"``: ``"reward"`` ``[*B, T, 1]`` and
            ``"cost"`` ``[*B, T, K]`` in their units, ``"done"``, ``"terminated"`` ``[*B, T, 1]``.
        Writes ``"state_value"`` (under ``"next"``, too), ``"advantage"``, ``"value_target"`` in the unit of the reward
            ``[*B, T, 1]``; ``"state_cost_value"``, ``"cost_advantage"``, ``"cost_value_target"`` in the units of the costs ``[*B, T, K]``.

        Raises:
            KeyError: the batch holds no cost.
            ValueError: it holds another number of costs than the loss has constraints.
        """
        keys = self.tensor_keys
        check_cost(tensordict, keys.cost, self.costs)
        score_actions(self, tensordict)
        self.value_estimator(
            tensordict,
            params=self.critic_network_params.detach(),
            target_params=self.target_critic_network_params,
        )
        # Estimators want one shape of all.
        costs = tensordict.exclude(
            keys.state_cost_value
        )  # of an earlier time, which "next" has not
        following = costs.get("next").clone(False)
        done = following.get(keys.done)
        following.set(keys.done, done.expand(*done.shape[:-1], self.costs))
        self._cost_value_estimator(
            costs.set("next", following),
            params=self.cost_critic_params.detach(),
            target_params=self.target_cost_critic_params,
        )
        names = (keys.state_cost_value, keys.cost_advantage, keys.cost_value_target)
        tensordict.update(costs.select(*names))

    def cost_loss(self, tensordict: TensorDictBase) -> Tensor:
        """Half the squared error of V_c(s) against ``"cost_value_target"``, summed over the costs and reduced.

        Args:
            tensordict: ``[*B]`` as :meth:`begin` leaves it.

        Raises:
            KeyError: ``begin`` has not seen the batch.
        """
        check_begun(tensordict, self.tensor_keys.cost_value_target)
        with self.cost_critic_params.to_module(self.cost_critic, preserve_module_state=False):
            inputs = tensordict.select(*self.cost_critic.in_keys)
            predicted = self.cost_critic(inputs).get(self.tensor_keys.state_cost_value)
        target = tensordict.get(self.tensor_keys.cost_value_target)
        loss = 0.5 * distance_loss(predicted, target, loss_function="l2").sum(-1)
        return self.reduced(loss, tensordict)
