"""Constraint-rectified policy optimisation on PPO (Xu, Liang and Lan, 2021)."""

from __future__ import annotations

from torch import Tensor

from saferl.modules import Switch
from saferl.objectives.ppo import PPOLagLoss


class CRPOLoss(PPOLagLoss):
    r"""PPO that improves the reward, or, where the limit is exceeded, lowers the cost alone (CRPO).

    .. math::

        A = \begin{cases} -A_{c,i} & \text{if } J_{c,i} > d_i + \eta \text{ for a constraint } i \\
            A_r & \text{else} \end{cases}

    Xu, Liang and Lan, `arXiv 2011.05869 <https://arxiv.org/abs/2011.05869>`_, Algorithm 1, with a step of PPO in the place of
    the natural gradient's. No multiplier is learned. The policy goes to and fro across :math:`d + \eta`: what is proven is
    of the steps that improved the reward, of which each kept :math:`d + \eta`.

    The switch is the multiplier of the loss. A loop moves it once for each batch of fresh episodes, with
    ``loss.lagrange.update(episode_cost / limit - 1)``, before the batch is learned from.

    Args:
        actor_network, critic_network, cost_critic: as in :class:`PPOLagLoss`.

    Keyword Args:
        lagrange (Switch): which of the constraints is violated, if any.
        **settings: as in :class:`PPOLagLoss`.

    Reads and writes what :class:`PPOLagLoss` does; ``"lagrange_multiplier"`` is 1 where the cost was lowered.

    Raises:
        ValueError, KeyError: as :class:`PPOLagLoss`; ``lagrange`` is no :class:`~saferl.modules.Switch`.

    Examples:
        >>> import torch
        >>> from saferl.modules import (
        ...     MLPPolicyEncoder, StateValue, Switch, tanh_gaussian_actor, value_operator
        ... )
        >>> from saferl.objectives import CRPOLoss
        >>> encoder = MLPPolicyEncoder(size=3, width=16)
        >>> actor = tanh_gaussian_actor(encoder, 16, 2, in_keys=["observation"])
        >>> values = [
        ...     value_operator(StateValue(encoder, 16), ["observation"], key)
        ...     for key in ("state_value", "state_cost_value")
        ... ]
        >>> loss = CRPOLoss(actor, *values, lagrange=Switch())
        >>> advantages = torch.tensor([[2.0]]), torch.tensor([[0.5]])
        >>> loss.weigh(*advantages)
        tensor([[2.]])
        >>> loss.lagrange.update(torch.tensor(0.1))
        >>> loss.weigh(*advantages)
        tensor([[-0.5000]])
    """

    multiplier = Switch

    def weigh(self, reward: Tensor, cost: Tensor) -> Tensor:
        violated = self.lagrange.value.detach().to(reward)
        return (1.0 - violated.sum()) * reward - (violated * cost).sum(-1, keepdim=True)
