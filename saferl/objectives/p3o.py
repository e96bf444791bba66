"""Penalised proximal policy optimisation (Zhang et al., 2022)."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import Tensor

from saferl.modules import ExactPenalty
from saferl.objectives.ppo import PPOLagLoss


class P3OLoss(PPOLagLoss):
    r"""Clipped PPO with an exact penalty on a clipped surrogate of the cost (P3O).

    .. math::

        L = L_{PPO} + \sum \kappa \max\big(0,\; E[\max(\rho A_c, \mathrm{clip}(\rho, 1 - \epsilon, 1 + \epsilon) A_c)]
            + (1 - \gamma)(J_c - d)\big) / \mathrm{std}(A_r)

    Zhang et al., `arXiv 2205.11814 <https://arxiv.org/abs/2205.11814>`_, (14) to (16), with :math:`\rho` the ratio of the
    new policy's probability to that of the policy that acted, and :math:`J_c` the mean cost of its episodes. The sum is over
    K constraints. Where none is within reach of its limit the gradient is PPO's.

    Ours: PPO's advantages are divided by their deviation, and so is the penalty, so that :math:`\kappa` is in units of
    reward per cost; :math:`A_c` is centred, so that an unchanged policy's surrogate is 0.

    :math:`\kappa` and :math:`J_c - d` are the multiplier's. A loop tells it once for each batch of fresh episodes, with
    ``loss.lagrange.update(episode_cost - limit)``, before the batch is learned from.

    Args:
        actor_network, critic_network, cost_critic: as in :class:`PPOLagLoss`.

    Keyword Args:
        lagrange (ExactPenalty): kappa, and the last excess.
        **settings: as in :class:`PPOLagLoss`.

    Reads what :class:`PPOLagLoss` does. Writes besides ``"loss_penalty"``, a scalar whatever the reduction.

    Raises:
        ValueError, KeyError: as :class:`PPOLagLoss`; ``lagrange`` is no :class:`~saferl.modules.ExactPenalty`; ``gamma`` is
            1, with which the excess would not count.

    Examples:
        >>> from saferl.modules import (
        ...     ExactPenalty, MLPPolicyEncoder, StateValue, tanh_gaussian_actor, value_operator
        ... )
        >>> from saferl.objectives import P3OLoss
        >>> encoder = MLPPolicyEncoder(size=3, width=16)
        >>> actor = tanh_gaussian_actor(encoder, 16, 2, in_keys=["observation"])
        >>> values = [
        ...     value_operator(StateValue(encoder, 16), ["observation"], key)
        ...     for key in ("state_value", "state_cost_value")
        ... ]
        >>> loss = P3OLoss(actor, *values, lagrange=ExactPenalty(init=20.0))
        >>> "loss_penalty" in loss.out_keys
        True
    """

    multiplier = ExactPenalty
    terms = ("loss_penalty",)

    lagrange: ExactPenalty

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> None:
        """As in :class:`PPOLagLoss`.

        Raises:
            ValueError: ``gamma`` is 1, or lies outside [0, 1].
        """
        if hyperparams.get("gamma") == 1:
            raise ValueError("gamma must be < 1, as (1 - gamma) weighs the excess, got 1.")
        super().make_value_estimator(value_type, **hyperparams)

    def weigh(self, reward: Tensor, cost: Tensor) -> Tensor:
        return reward

    def policy_terms(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        reward = tensordict.get(self.tensor_keys.advantage)
        ahead = self.surrogate(tensordict)
        gamma = self._cost_value_estimator.gamma.to(reward)
        excess = ahead + (1.0 - gamma) * self.lagrange.excess.to(reward)
        penalty = (self.lagrange.value.to(reward) * F.relu(excess)).sum()
        scale = reward.std().clamp(min=1e-6) if self.normalize_advantage else 1.0
        return {"loss_penalty": penalty / scale}

    def surrogate(self, tensordict: TensorDictBase) -> Tensor:
        """What the policy's change adds to the costs ``[K]``, for each decision, clipped on the cautious side."""
        cost = tensordict.get(self.tensor_keys.cost_advantage)
        cost = cost - cost.flatten(0, -2).mean(0)
        log_ratio, _ = self.log_ratio(tensordict)
        worse = torch.maximum(log_ratio.exp() * cost, self.clip(log_ratio).exp() * cost)
        return torch.stack([self.reduced(each, tensordict, "mean") for each in worse.unbind(-1)])
