"""State values of reward and cost beside an on-policy loss, and their advantages."""

from __future__ import annotations

import math
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import LossModule, ValueEstimators
from torchrl.objectives.utils import distance_loss


class CostValueLoss(LossModule):
    r"""Base of the on-policy losses with a cost: V_c(s), a second GAE, and the cost of a policy.

    Comes before a loss of TorchRL among the bases of a class, as in
    ``class PPOLagLoss(CostValueLoss, ClipPPOLoss)``. The subclass calls :meth:`_add_cost_value` once its
    other networks are there.

    :meth:`begin` is for a whole batch of fresh transitions ``[*B, T]``: it writes the advantages and value
    targets of reward and cost, which the mini-batches then carry.
    """

    cost_critic: TensorDictModule
    cost_critic_params: TensorDictParams
    target_cost_critic_params: TensorDictParams
    cost_limit: Tensor

    # Of the loss beside this base, or made late.
    tensor_keys: Any
    critic_network_params: TensorDictParams
    target_critic_network_params: TensorDictParams
    _value_estimator: Any
    _cost_value_estimator: Any

    def _add_cost_value(self, cost_critic: TensorDictModule, cost_limit: float) -> None:
        if not (math.isfinite(cost_limit) and cost_limit >= 0):
            raise ValueError(f"cost_limit must be >= 0, got {cost_limit}.")
        self.convert_to_functional(cost_critic, "cost_critic")
        device = next(self.parameters()).device
        self.register_buffer("cost_limit", torch.tensor(float(cost_limit), device=device))
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
        gamma = hyperparams.get("gamma", 0.0)
        if not 0 <= gamma <= 1:
            raise ValueError(f"gamma must be in [0, 1], got {gamma}.")
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
                terminated=keys.terminated,
            )

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
        if tensordict.get(("next", self.tensor_keys.cost), None) is None:
            raise KeyError(
                f"The batch has no entry {('next', self.tensor_keys.cost)}; under 'next' it has "
                f"{sorted(map(str, tensordict.get('next').keys()))}. "
                "Name your cost with loss.set_keys(cost=...)."
            )
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
        """Half the squared error of V_c against ``"cost_value_target"``, reduced."""
        with self.cost_critic_params.to_module(self.cost_critic, preserve_module_state=False):
            inputs = tensordict.select(*self.cost_critic.in_keys)
            predicted = self.cost_critic(inputs).get(self.tensor_keys.state_cost_value)
        target = tensordict.get(self.tensor_keys.cost_value_target)
        loss = 0.5 * distance_loss(predicted, target, loss_function="l2").squeeze(-1)
        return self._reduce_loss(loss, tensordict)

    def cost_of_policy(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        r"""The discounted cost of the policy that collected a batch, and decisions per episode.

        :math:`J_c = E_{s_0}[\sum_t \gamma^t c_t]` is the mean of the cost's value targets at the episodes'
        first steps (``"is_init"``, of TorchRL's ``InitTracker``), or over all states where no episode
        begins in the batch. The second is :math:`\sum_{t<L} \gamma^t` for the mean length :math:`L`: to
        first order :math:`J_c(\pi') - J_c(\pi)` is that many times the mean of ratio times advantage.

        Args:
            tensordict: ``[*B, T]`` as :meth:`begin` leaves it.
        """
        target = tensordict.get(self.tensor_keys.cost_value_target).squeeze(-1)
        first = tensordict.get(self.tensor_keys.is_init).squeeze(-1).to(target)
        count = first.sum()
        some = count > 0
        mean = torch.where(some, (first * target).sum() / count.clamp_min(1), target.mean())
        length = target.numel() / count.clamp_min(1)
        gamma = self._cost_value_estimator.gamma.to(length)
        weight = torch.where(gamma < 1, (1 - gamma**length) / (1 - gamma).clamp_min(1e-12), length)
        return mean, weight
