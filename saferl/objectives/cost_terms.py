"""Cost critics beside the reward critics of an off-policy loss.

E13 is equation (11) of the paper, `arXiv 2503.19690 <https://arxiv.org/abs/2503.19690>`_, by its label there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives import ValueEstimators
from torchrl.objectives.utils import distance_loss

from saferl.modules import BoundCritics, CriticEnsemble, LagrangeMultiplier, Largest
from saferl.modules.ensemble import REDUCTIONS
from saferl.objectives.adapter import LossMixin
from saferl.objectives.checks import (
    check_choice,
    check_cost,
    check_lagrange,
    check_limit,
    check_risk,
    count_members,
)

#: What the cost critics' target may be of its members' values.
CostTarget = Literal["max", "mean"]
#: What the cost critics may learn: the discounted sum of costs, or the largest one ahead.
CostBackup = Literal["sum", "reach"]


def quantile_loss(predicted: Tensor, target: Tensor) -> Tensor:
    """Quantile regression (Koenker and Bassett, 1978), summed over the quantiles.

    Without the quadratic zone of Huber's loss that distributional critics often have: costs are smaller than
    its usual width of 1, and within it a minimum is an expectile.

    Args:
        predicted: [*B, N], the quantiles at (i + 1/2) / N, in the unit of the cost.
        target: [*B, L], samples of the distribution, equally likely.

    Returns:
        [*B].
    """
    count = predicted.shape[-1]
    fraction = (torch.arange(count, device=predicted.device, dtype=predicted.dtype) + 0.5) / count
    error = target.unsqueeze(-2) - predicted.unsqueeze(-1)  # [*B, N, L]
    fraction = fraction.unsqueeze(-1)
    return torch.maximum(fraction * error, (fraction - 1.0) * error).mean(-1).sum(-1)


@dataclass
class SharedTerms:
    """What the terms of one forward pass have in common.

    Attributes:
        tensordict: the batch that the pass is of.
        next_sample: of :meth:`CostCriticMixin.sample_next`.
        critics: bound to the batch's states, by the names of their networks.
        violation: what the actor's term leaves here: ``"constraint_violation"``.
    """

    tensordict: TensorDictBase
    next_sample: tuple[TensorDictBase, Tensor]
    critics: dict[str, BoundCritics]
    violation: Tensor | None = None


class CostCriticMixin(LossMixin):
    r"""An ensemble of cost critics with targets, a second value estimator and their loss, for an off-policy loss.

    .. math::

        L_c = E\Big[\sum_i \tfrac12 \big(Q_{c,i}(s, a) - c
              - \gamma (1 - \tau) \max_j Q^-_{c,j}(s', \tilde a')\big)^2\Big] \quad (E13)

    with :math:`\tau` the entry ``"terminated"`` and :math:`\tilde a'` drawn from the policy. Comes first among the bases,
    as in ``class SACLagLoss(CostCriticMixin, SACLoss)``. The subclass calls :meth:`add_cost_critic` once its other
    networks are there, and defines :meth:`sample_next`.

    - ``cost_target="mean"`` takes the mean over :math:`j` in place of the maximum. The maximum of members that differ
      by chance is too high, and each target passes that on to the next one.
    - ``cost_backup="reach"`` has the target :math:`(1 - \gamma) c + \gamma \max(c, (1 - \tau) Q_c^-)`. Its fixed point
      is the discounted largest cost ahead (Fisac et al., 2019).
    - With a multiplier of K constraints there are K costs, and a critic has an output for each. :math:`L_c` is summed over
      them.
    - A critic with N > 1 outputs for each cost learns the quantiles of the sum, by :func:`quantile_loss`.
    - ``risk`` is what is made of the members' values everywhere else.
    """

    SUPPORTED_VALUE_ESTIMATORS = (ValueEstimators.TD0,)

    cost_critic: TensorDictModule
    cost_critic_params: TensorDictParams
    target_cost_critic_params: TensorDictParams
    lagrange: LagrangeMultiplier
    risk_limit: Tensor
    cost_target: CostTarget
    cost_backup: CostBackup
    risk: Callable[[Tensor], Tensor]

    # Of the loss beside this one, or made late.
    actor_network: TensorDictModule
    qvalue_network: TensorDictModule
    deactivate_vmap: bool
    _shared: SharedTerms | None = None

    def add_cost_critic(
        self,
        cost_critic: TensorDictModule | list[TensorDictModule],
        num_cost_critics: int | None,
        *,
        lagrange: LagrangeMultiplier,
        risk_limit: float | Sequence[float],
        cost_target: CostTarget,
        cost_backup: CostBackup,
        risk: Callable[[Tensor], Tensor] | None,
        create_target_params: bool,
        compare_against: list[nn.Parameter] | None,
    ) -> None:
        """Take the cost critics in, with what their loss and the actor's need, and make the estimators."""
        self.lagrange = check_lagrange(lagrange)
        limit = check_limit("risk_limit", risk_limit, self.lagrange.count)
        self.num_cost_critics = count_members(
            "cost_critic", cost_critic, "num_cost_critics", num_cost_critics
        )
        self.cost_target = check_choice("cost_target", cost_target, CostTarget)
        self.cost_backup = check_choice("cost_backup", cost_backup, CostBackup)
        self.risk = check_risk(Largest() if risk is None else risk)
        self.convert_to_functional(
            cost_critic,  # pyright: ignore[reportArgumentType]
            "cost_critic",
            self.num_cost_critics,
            create_target_params=create_target_params,
            compare_against=compare_against,
        )
        self.register_buffer("risk_limit", limit.float().to(self.buffer_device))
        # Asked for now, so that a fresh loss loads a state_dict strictly.
        _ = self.value_estimator

    def cost_estimator_keys(self) -> dict[str, NestedKey]:
        keys = self.tensor_keys
        return {
            "value": keys.state_action_cost_value,
            "reward": keys.cost,
            "done": keys.done,
            "terminated": keys.terminated,
        }

    @property
    def observation_keys(self) -> list[NestedKey]:
        """What the networks read of a state."""
        # The other base asks before the cost critic is there.
        names = ("actor_network", "qvalue_network", "cost_critic")
        networks = [getattr(self, name) for name in names if hasattr(self, name)]
        keys = dict.fromkeys(key for network in networks for key in network.in_keys)
        keys.pop(self.tensor_keys.action, None)
        return list(keys)

    def read_keys(self) -> list[NestedKey]:
        keys, observation = self.tensor_keys, self.observation_keys
        following = [*observation, keys.reward, keys.cost, keys.done, keys.terminated]
        return [keys.action, *observation, *(unravel_key(("next", key)) for key in following)]

    @property
    def cost_value(self) -> CriticEnsemble:
        """The risk of the members' cost values, on their live parameters.

        A view that owns no state. It follows the parameters as they are trained and loaded. It does not follow a
        ``to(device)`` that replaces them: take it anew.
        """
        return CriticEnsemble(
            self.cost_critic,
            params=self.cost_critic_params,
            reduce=self.risk,
            costs=self.lagrange.count,
            action_key=self.tensor_keys.action,
        )

    def sample_next(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, Tensor]:
        """Next state with an action of the policy, and its log-probability ``[*B]``."""
        raise NotImplementedError

    def bind(
        self, critic: TensorDictModule, params: TensorDictBase, tensordict: TensorDictBase
    ) -> BoundCritics:
        """All members of a critic in the batch's states."""
        vmap = False if self.deactivate_vmap else None
        key = self.tensor_keys.action
        return BoundCritics.of(critic, params, tensordict, action_key=key, vmap=vmap)

    def shared(self, tensordict: TensorDictBase) -> SharedTerms | None:
        """What a forward pass of this very batch has made already; None where a term is asked for alone."""
        shared = self._shared
        return shared if shared is not None and shared.tensordict is tensordict else None

    def next_sample(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, Tensor]:
        """:meth:`sample_next`, once for all terms of a forward pass."""
        shared = self.shared(tensordict)
        return self.sample_next(tensordict) if shared is None else shared.next_sample

    def critics(
        self, name: Literal["qvalue_network", "cost_critic"], tensordict: TensorDictBase
    ) -> BoundCritics:
        """All members of a critic in the batch's states, bound once for all terms of a forward pass."""
        shared = self.shared(tensordict)
        if shared is not None:
            return shared.critics[name]
        return self.bind(getattr(self, name), getattr(self, f"{name}_params"), tensordict)

    def cost_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """E13 with its options: cost critics against the target value or its quantiles, with no entropy.

        Args:
            tensordict: the batch ``[*B]``.

        Returns:
            The loss, reduced, and ``"td_error"`` ``[*B]``, the largest over the members.

        Raises:
            KeyError: the batch holds no cost.
            ValueError: it holds another number of costs than the loss has constraints.
        """
        count = self.lagrange.count
        check_cost(tensordict, self.tensor_keys.cost, count)
        next_state, _ = self.next_sample(tensordict)
        with torch.no_grad():
            target_critics = self.bind(self.cost_critic, self.target_cost_critic_params, next_state)
            next_value = target_critics.values(next_state.get(self.tensor_keys.action))
            next_value = REDUCTIONS[self.cost_target](next_value)
            target = self.backup(tensordict, next_value)
        critics = self.critics("cost_critic", tensordict)
        predicted = critics.values(tensordict.get(self.tensor_keys.action))
        if predicted.shape[-1] == count:
            return self.bellman_loss(predicted, target, tensordict)
        predicted, target = (each.unflatten(-1, (count, -1)) for each in (predicted, target))
        loss = quantile_loss(predicted, target.expand_as(predicted)).sum(-1).sum(0)
        error = (predicted.mean(-1) - target.mean(-1)).detach().abs()
        return self.reduced(loss, tensordict), {"td_error": error.amax(-1).max(0)[0]}

    def backup(self, tensordict: TensorDictBase, next_value: Tensor) -> Tensor:
        """The cost critics' target [*B, K N] from the next state's values [*B, K N]."""
        tensordict = self.spread(tensordict, next_value.shape[-1])
        estimator = self._cost_value_estimator
        if self.cost_backup == "sum":
            return estimator.value_estimate(tensordict, next_value=next_value)
        if "steps_to_next_obs" in tensordict.keys():  # noqa: SIM118
            raise ValueError('cost_backup="reach" is of single steps, got "steps_to_next_obs".')
        cost = tensordict.get(("next", self.tensor_keys.cost))
        terminated = tensordict.get(("next", self.tensor_keys.terminated))
        gamma, ahead = estimator.gamma.to(cost), torch.where(terminated, 0.0, next_value)
        return (1.0 - gamma) * cost + gamma * torch.maximum(cost, ahead)

    def spread(self, tensordict: TensorDictBase, size: int) -> TensorDictBase:
        """A copy of a batch in which cost and ends ``[*B, size]`` meet values: estimators want one shape of all."""
        data, keys = tensordict.copy(), self.tensor_keys
        following = data.get("next").copy()
        cost = following.get(keys.cost)
        each = cost.unsqueeze(-1).expand(*cost.shape, size // cost.shape[-1])
        following.set(keys.cost, each.flatten(-2))
        for key in (keys.done, keys.terminated):
            following.set(key, following.get(key).expand(*cost.shape[:-1], size))
        return data.set("next", following)

    def bellman_loss(
        self, predicted: Tensor, target: Tensor, tensordict: TensorDictBase
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Half the squared error of ``predicted`` ``[n, *B, K]``, summed over its members and numbers."""
        target = target.expand_as(predicted)
        loss = 0.5 * distance_loss(predicted, target, loss_function="l2").sum(-1).sum(0)
        error = (predicted - target).detach().abs().amax(-1)
        return self.reduced(loss, tensordict), {"td_error": error.max(0)[0]}
