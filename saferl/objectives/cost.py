"""Cost critics beside the reward critics of an off-policy loss (E13)."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives import LossModule, ValueEstimators
from torchrl.objectives.utils import distance_loss

from saferl.modules import BoundCritics, CriticEnsemble, LagrangeMultiplier, Largest
from saferl.modules.critics import REDUCTIONS
from saferl.objectives.checks import (
    check_cost,
    check_gamma,
    check_lagrange,
    check_limit,
    count_members,
)

#: What the cost critics' target may be of its members' values.
COST_TARGETS = ("max", "mean")
#: What the cost critics may learn: the discounted sum of costs, or the largest one ahead.
COST_BACKUPS = ("sum", "reach")


def quantile_loss(predicted: Tensor, target: Tensor) -> Tensor:
    """Quantile regression (Koenker and Bassett, 1978), summed over the quantiles.

    Without the quadratic zone of Huber's loss that distributional critics often have: costs are smaller than
    its usual width of 1, and within it a minimum is an expectile.

    Args:
        predicted: [*B, K], the quantiles at (i + 1/2) / K, in the unit of the cost.
        target: [*B, L], samples of the distribution, equally likely.

    Returns:
        [*B].
    """
    count = predicted.shape[-1]
    fraction = (torch.arange(count, device=predicted.device, dtype=predicted.dtype) + 0.5) / count
    error = target.unsqueeze(-2) - predicted.unsqueeze(-1)  # [*B, K, L]
    fraction = fraction.unsqueeze(-1)
    return torch.maximum(fraction * error, (fraction - 1.0) * error).mean(-1).sum(-1)


class CostCriticLoss(LossModule):
    r"""Base of the losses of an off-policy critic under a cost constraint.

    Comes before a loss of TorchRL among the bases of a class, as in
    ``class SACLagLoss(CostCriticLoss, SACLoss)``, and gives it an ensemble of cost
    critics with targets, a second value estimator, which reads the cost, and

    .. math::

        L_c = E\Big[\sum_i \tfrac12 \big(Q_{c,i}(s, a) - c
              - \gamma (1 - \tau) \max_j Q^-_{c,j}(s', \tilde a')\big)^2\Big] \quad (E13, paper)

    where :math:`\tau` is ``terminated``, and the mean over :math:`j` may take the place of
    the maximum (``cost_target="mean"``): the maximum of members that differ by chance is
    too high, and each target passes that on to the next one. With ``cost_backup="reach"`` the target is
    :math:`(1 - \gamma) c + \gamma \max(c, (1 - \tau) Q_c^-)`, whose fixed point is the discounted largest cost
    ahead (Fisac et al., 2019). A critic with K > 1 outputs learns the quantiles of the sum, by
    :func:`quantile_loss`. What is made of the members' values elsewhere is ``risk``. The subclass calls
    :meth:`_add_cost_critic` once its other networks are there, and defines :meth:`_sample_next`.
    """

    SUPPORTED_VALUE_ESTIMATORS = (ValueEstimators.TD0,)

    cost_critic: TensorDictModule
    cost_critic_params: TensorDictParams
    target_cost_critic_params: TensorDictParams
    lagrange: LagrangeMultiplier
    cost_limit: Tensor
    cost_target: str
    cost_backup: str
    risk: Callable[[Tensor], Tensor]

    # Of the loss beside this base, or made late.
    tensor_keys: Any
    actor_network: TensorDictModule
    qvalue_network: TensorDictModule
    deactivate_vmap: bool
    _value_estimator: Any
    _cost_value_estimator: Any

    def _add_cost_critic(
        self,
        cost_critic: TensorDictModule | list[TensorDictModule],
        num_cost_critics: int | None,
        *,
        lagrange: LagrangeMultiplier,
        cost_limit: float,
        cost_target: str,
        cost_backup: str,
        risk: Callable[[Tensor], Tensor] | None,
        create_target_params: bool,
        compare_against: list[nn.Parameter] | None,
    ) -> None:
        cost_limit = check_limit(cost_limit)
        num_cost_critics = count_members(
            "cost_critic", cost_critic, "num_cost_critics", num_cost_critics
        )
        for name, value, choices in (
            ("cost_target", cost_target, COST_TARGETS),
            ("cost_backup", cost_backup, COST_BACKUPS),
        ):
            if value not in choices:
                raise ValueError(f"{name} must be one of {', '.join(choices)}, got {value!r}.")
        self.num_cost_critics, self.cost_target = num_cost_critics, cost_target
        self.cost_backup, self.risk = cost_backup, risk or Largest()
        self.convert_to_functional(
            cost_critic,  # pyright: ignore[reportArgumentType]
            "cost_critic",
            num_cost_critics,
            create_target_params=create_target_params,
            compare_against=compare_against,
        )
        if not callable(self.risk):
            raise ValueError(
                f"risk must be a function, such as saferl.modules.Largest(), got {risk!r}."
            )
        self.lagrange = check_lagrange(lagrange)
        device = next(self.parameters()).device
        self.register_buffer("cost_limit", torch.tensor(cost_limit, device=device))
        # Made here, not at the first call: a fresh loss then loads a state_dict strictly.
        self._default_value_estimator()

    def make_value_estimator(
        self,
        value_type: Any = None,
        **hyperparams,
    ) -> None:
        """Build the value estimators of the reward and of the cost, alike.

        Args:
            value_type (ValueEstimators, ValueEstimatorBase or type, optional): as in
                TorchRL's losses. Defaults to TD(0).
            **hyperparams: of the estimator, such as ``gamma``.

        Raises:
            ValueError: ``gamma`` lies outside [0, 1].
        """
        check_gamma(hyperparams)
        super().make_value_estimator(value_type, **hyperparams)
        self._cost_value_estimator = deepcopy(self._value_estimator)
        self._forward_value_estimator_keys()

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        # The other base calls this before the cost critic is known, so the input keys
        # are left to be worked out when somebody asks for them.
        self._in_keys = None
        if self._value_estimator is None:
            return
        shared = {"done": self.tensor_keys.done, "terminated": self.tensor_keys.terminated}
        self._value_estimator.set_keys(
            value=self.tensor_keys.value, reward=self.tensor_keys.reward, **shared
        )
        self._cost_value_estimator.set_keys(
            value=self.tensor_keys.state_action_cost_value, reward=self.tensor_keys.cost, **shared
        )

    @property
    def _observation_keys(self) -> list[NestedKey]:
        networks = (self.actor_network, self.qvalue_network, self.cost_critic)
        keys = dict.fromkeys(key for network in networks for key in network.in_keys)
        keys.pop(self.tensor_keys.action, None)
        return list(keys)

    def _set_in_keys(self) -> None:
        following = [
            *self._observation_keys,
            self.tensor_keys.reward,
            self.tensor_keys.cost,
            self.tensor_keys.done,
            self.tensor_keys.terminated,
        ]
        self._in_keys = [
            self.tensor_keys.action,
            *self._observation_keys,
            *(unravel_key(("next", key)) for key in following),
        ]

    @property
    def cost_value(self) -> CriticEnsemble:
        """The risk of the members' cost values, on their live parameters.

        A view that owns no state. It keeps following the parameters as they are
        trained and loaded, but not a ``to(device)`` that replaces them: take it anew.
        """
        return CriticEnsemble(
            self.cost_critic,
            params=self.cost_critic_params,
            reduce=self.risk,
            action_key=self.tensor_keys.action,
        )

    def _bind(
        self, critic: TensorDictModule, params: TensorDictBase, tensordict: TensorDictBase
    ) -> BoundCritics:
        """All members of a critic in the batch's states."""
        vmap = False if self.deactivate_vmap else None
        key = self.tensor_keys.action
        return BoundCritics.of(critic, params, tensordict, action_key=key, vmap=vmap)

    def cost_loss(
        self,
        tensordict: TensorDictBase,
        next_sample: tuple[TensorDictBase, Tensor] | None = None,
        critics: BoundCritics | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """E13: cost critics against the target value or its quantiles, with no entropy.

        Args:
            tensordict (TensorDictBase): the batch.
            next_sample (optional): next state with the policy's action, and its
                log-probability ``[*B]``. Drawn afresh by default.
            critics (optional): the cost critics bound to the batch's states, where
                they are known already.

        Raises:
            KeyError: the batch holds no cost.
        """
        check_cost(tensordict, self.tensor_keys.cost)
        next_state, _ = next_sample or self._sample_next(tensordict)
        with torch.no_grad():
            target_critics = self._bind(
                self.cost_critic, self.target_cost_critic_params, next_state
            )
            next_value = target_critics.values(next_state.get(self.tensor_keys.action))
            next_value = REDUCTIONS[self.cost_target](next_value)
            target = self._cost_backup(tensordict, next_value)
        critics = critics or self._bind(self.cost_critic, self.cost_critic_params, tensordict)
        predicted = critics.values(tensordict.get(self.tensor_keys.action))
        if predicted.shape[-1] == 1:
            return self._bellman_loss(predicted, target, tensordict)
        loss = quantile_loss(predicted, target.expand_as(predicted)).sum(0)
        loss = self._reduce_loss(
            loss, tensordict=tensordict, weights=self._maybe_get_priority_weight(tensordict)
        )
        error = predicted.mean(-1) - target.mean(-1)
        return loss, {"td_error": error.detach().abs().max(0)[0]}

    def _cost_backup(self, tensordict: TensorDictBase, next_value: Tensor) -> Tensor:
        """The cost critics' target [*B, K] from the next state's values [*B, K]."""
        estimator = self._cost_value_estimator
        if self.cost_backup == "sum":
            data, keys = tensordict.copy(), self.tensor_keys
            following = data.get("next").copy()
            for key in (keys.cost, keys.done, keys.terminated):  # estimators want one shape of all
                following.set(key, following.get(key).expand_as(next_value))
            return estimator.value_estimate(data.set("next", following), next_value=next_value)
        if "steps_to_next_obs" in tensordict.keys():  # noqa: SIM118
            raise ValueError('cost_backup="reach" is of single steps, got "steps_to_next_obs".')
        cost = tensordict.get(("next", self.tensor_keys.cost))
        terminated = tensordict.get(("next", self.tensor_keys.terminated))
        gamma, ahead = estimator.gamma.to(cost), torch.where(terminated, 0.0, next_value)
        return (1.0 - gamma) * cost + gamma * torch.maximum(cost, ahead)

    def _bellman_loss(
        self, predicted: Tensor, target: Tensor, tensordict: TensorDictBase
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Half the squared error of ``predicted`` ``[n, *B, 1]``, summed over its members."""
        predicted = predicted.squeeze(-1)
        target = target.squeeze(-1).expand_as(predicted)
        loss = 0.5 * distance_loss(predicted, target, loss_function="l2").sum(0)
        loss = self._reduce_loss(
            loss, tensordict=tensordict, weights=self._maybe_get_priority_weight(tensordict)
        )
        return loss, {"td_error": (predicted - target).detach().abs().max(0)[0]}

    def _sample_next(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, Tensor]:
        """Next state with an action of the policy, and its log-probability ``[*B]``."""
        raise NotImplementedError
