"""First-order constrained optimisation in policy space (Zhang, Vuong and Ross, 2020)."""

from __future__ import annotations

import math
from typing import Literal

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import kl_divergence

from saferl.modules import LagrangeMultiplier
from saferl.objectives.ppo import PPOLagLoss


class FOCOPSLoss(PPOLagLoss):
    r"""The projection of the best policy in a trust region on the policies that a network can be (FOCOPS).

    .. math::

        L_\pi = E\Big[\Big(\mathrm{KL}(\pi \| \pi_{old}) - \frac{1}{\lambda}\, \rho\, \hat A\Big)
            [\mathrm{KL}(\pi \| \pi_{old}) \le \delta]\Big], \quad A \propto A_r - \sum \nu A_c

    Zhang, Vuong and Ross, `arXiv 2002.06506 <https://arxiv.org/abs/2002.06506>`_, Algorithm 1, with :math:`\rho` the ratio of
    both policies' probabilities. The best policy in the region is :math:`\pi_{old} \exp(A / \lambda)`, normalised. States in
    which the policy has gone further than :math:`\delta` pull it no more; nothing is clipped. The advantages are weighed and
    standardised as in :class:`PPOLagLoss`.

    :math:`\nu` is the multiplier. The paper ascends it, :math:`\nu \leftarrow \mathrm{clip}(\nu + \alpha (J_c - d), 0,
    \nu_{max})`: a :class:`~saferl.modules.DualAscent` with ``signed=True`` and a ``maximum``, moved as in
    :class:`PPOLagLoss`.

    Args:
        actor_network, critic_network, cost_critic: as in :class:`PPOLagLoss`.

    Keyword Args:
        lagrange (LagrangeMultiplier): nu.
        temperature (float, optional): lambda. Defaults to ``1.5``.
        trust (float, optional): delta, on the KL in a state, in nats. Defaults to ``0.02``.
        entropy_bonus, entropy_coeff, critic_coeff, clip_value, loss_critic_type, normalize_advantage, separate_losses,
            reduction: as in :class:`PPOLagLoss`.

    Reads what :class:`PPOLagLoss` does, and the parameters of the distribution that acted, as the actor wrote them
        (``"loc"`` and ``"scale"`` ``[*B, A]``).
    Writes what :class:`PPOLagLoss` does, and reports: ``"kl"``, the mean (nats), and ``"trusted"``, the share of states in
        which it is at most :math:`\delta`.

    Raises:
        ValueError: as :class:`PPOLagLoss`; ``temperature`` or ``trust`` is not positive.
        KeyError: as :class:`PPOLagLoss`; the batch does not hold the distribution that acted.

    Examples:
        >>> from saferl.modules import (
        ...     DualAscent, MLPPolicyEncoder, StateValue, tanh_gaussian_actor, value_operator
        ... )
        >>> from saferl.objectives import FOCOPSLoss
        >>> encoder = MLPPolicyEncoder(size=3, width=16)
        >>> actor = tanh_gaussian_actor(encoder, 16, 2, in_keys=["observation"])
        >>> values = [
        ...     value_operator(StateValue(encoder, 16), ["observation"], key)
        ...     for key in ("state_value", "state_cost_value")
        ... ]
        >>> ascent = DualAscent(init=0.0, lr=0.01, signed=True, maximum=2.0)
        >>> FOCOPSLoss(actor, *values, lagrange=ascent).in_keys[-2:]
        ['loc', 'scale']
    """

    terms = ("kl", "trusted")

    actor_network: ProbabilisticTensorDictSequential

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModule,
        cost_critic: TensorDictModule,
        *,
        lagrange: LagrangeMultiplier,
        temperature: float = 1.5,
        trust: float = 0.02,
        entropy_bonus: bool = False,
        entropy_coeff: float = 0.01,
        critic_coeff: float = 1.0,
        clip_value: bool | float = False,
        loss_critic_type: Literal["l1", "l2", "smooth_l1"] = "l2",
        normalize_advantage: bool = True,
        separate_losses: bool = False,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        for name, value in (("temperature", temperature), ("trust", trust)):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be > 0, got {value}.")
        super().__init__(
            actor_network,
            critic_network,
            cost_critic,
            lagrange=lagrange,
            entropy_bonus=entropy_bonus,
            entropy_coeff=entropy_coeff,
            critic_coeff=critic_coeff,
            clip_value=clip_value,
            loss_critic_type=loss_critic_type,
            normalize_advantage=normalize_advantage,
            separate_losses=separate_losses,
            reduction=reduction,
        )
        self.temperature, self.trust = temperature, trust

    def read_keys(self) -> list[NestedKey]:
        return [*super().read_keys(), *self.actor_network[-1].in_keys]

    def policy_terms(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        for key in self.actor_network[-1].in_keys:
            if tensordict.get(key, None) is None:
                raise KeyError(
                    f"The batch has no entry {key!r}: FOCOPS compares with the distribution that acted."
                )
        old = self.actor_network.build_dist_from_params(tensordict)
        log_ratio, new = self.log_ratio(tensordict)
        kl = kl_divergence(new, old).unsqueeze(-1)
        near = kl.detach() <= self.trust
        gain = log_ratio.exp() * self.standardised(tensordict)
        loss = near * (kl - gain / self.temperature)
        return {
            "loss_objective": self.reduced(loss, tensordict).squeeze(-1),
            "kl": kl.detach().mean(),
            "trusted": near.to(kl.dtype).mean(),
        }
