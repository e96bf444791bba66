"""State values of reward and cost beside an on-policy loss, and their advantages."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import LossModule, ValueEstimators
from torchrl.objectives.utils import distance_loss

from saferl.objectives.checks import check_begun, check_cost, check_gamma


class CostValueLoss(LossModule):
    r"""Base of the on-policy losses with a cost: V_c(s), a second GAE, and the cost of a policy.

    Comes before a loss of TorchRL among the bases of a class, as in
    ``class PPOLagLoss(CostValueLoss, ClipPPOLoss)``. The subclass calls :meth:`_add_cost_value` once its
    other networks are there.

    :meth:`begin` is for a whole batch of fresh transitions ``[*B, T]``: it writes the advantages and value
    targets of reward and cost, which the mini-batches then carry. A limit on an episode's cost is about the
    episode, so that the cost's estimator stops where one is ``done``; the reward's goes on through a
    truncation, as everywhere. Both go on where a batch cuts an episode off.
    """

    cost_critic: TensorDictModule
    cost_critic_params: TensorDictParams
    target_cost_critic_params: TensorDictParams

    #: What a subclass's forward reads: the observations of these networks, and these entries, by
    #: their names in ``tensor_keys``.
    _networks: tuple[str, ...]
    _entries: tuple[str, ...]

    # Of the loss beside this base, or made late.
    tensor_keys: Any
    critic_network_params: TensorDictParams
    target_critic_network_params: TensorDictParams
    _value_estimator: Any
    _cost_value_estimator: Any

    def _add_cost_value(self, cost_critic: TensorDictModule) -> None:
        self.convert_to_functional(cost_critic, "cost_critic")
        self._cost_value_estimator = None
        # Made here, not at the first call: a fresh loss then loads a state_dict strictly.
        self.make_value_estimator(ValueEstimators.GAE)

    def make_value_estimator(self, value_type: Any = None, **hyperparams) -> None:
        """Build the advantage estimators of the reward and of the cost, alike.

        Args:
            value_type (optional): as in TorchRL's losses. Defaults to GAE.
            **hyperparams: of the estimator, such as ``gamma`` and ``lmbda``.

        Raises:
            ValueError: ``gamma`` lies outside [0, 1].
        """
        check_gamma(hyperparams)
        super().make_value_estimator(value_type, **hyperparams)
        self._cost_value_estimator = deepcopy(self._value_estimator)
        # The copy shares the functional network's structure only; whose values it takes is said here.
        self._cost_value_estimator.value_network = self.cost_critic
        self._forward_value_estimator_keys()

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        super()._forward_value_estimator_keys(**kwargs)  # pyright: ignore
        if getattr(self, "_cost_value_estimator", None) is not None:
            keys = self.tensor_keys
            self._cost_value_estimator.set_keys(
                advantage=keys.cost_advantage,
                value_target=keys.cost_value_target,
                value=keys.state_cost_value,
                reward=keys.cost,
                done=keys.done,
                terminated=keys.done,
            )

    def _set_in_keys(self) -> None:
        # The other base asks before the cost critic is there.
        networks = [getattr(self, name) for name in self._networks if hasattr(self, name)]
        keys = [key for network in networks for key in network.in_keys]
        keys += [getattr(self.tensor_keys, name) for name in self._entries]
        self._in_keys = list(dict.fromkeys(keys))

    @torch.no_grad()
    def begin(self, tensordict: TensorDictBase) -> None:
        """Write the advantages of a batch of fresh transitions.

        Args:
            tensordict: ``[*B, T]`` with ``("next", "reward")`` and ``("next", "cost")``; gets
                ``"advantage"``, ``"value_target"``, ``"cost_advantage"``, ``"cost_value_target"``
                and the values themselves, ``[*B, T, 1]``.

        Raises:
            KeyError: the batch holds no cost.
        """
        check_cost(tensordict, self.tensor_keys.cost)
        for estimator, params, target_params in (
            (
                self._value_estimator,
                self.critic_network_params,
                self.target_critic_network_params,
            ),
            (
                self._cost_value_estimator,
                self.cost_critic_params,
                self.target_cost_critic_params,
            ),
        ):
            estimator(tensordict, params=params.detach(), target_params=target_params)

    def cost_loss(self, tensordict: TensorDictBase) -> Tensor:
        """Half the squared error of V_c against ``"cost_value_target"``, reduced.

        Args:
            tensordict: ``[*B]`` as :meth:`begin` leaves it.
        """
        check_begun(tensordict, self.tensor_keys.cost_value_target)
        with self.cost_critic_params.to_module(self.cost_critic, preserve_module_state=False):
            inputs = tensordict.select(*self.cost_critic.in_keys)
            predicted = self.cost_critic(inputs).get(self.tensor_keys.state_cost_value)
        target = tensordict.get(self.tensor_keys.cost_value_target)
        loss = 0.5 * distance_loss(predicted, target, loss_function="l2").squeeze(-1)
        return self._reduce_loss(loss, tensordict)
