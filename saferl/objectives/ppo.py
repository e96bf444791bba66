"""Proximal policy optimisation under a Lagrangian cost constraint (Ray, Achiam and Amodei, 2019)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives.utils import distance_loss

from saferl.modules import BoundCritics, CriticEnsemble, LagrangeMultiplier, Largest
from saferl.objectives.adapter import PPOTerms
from saferl.objectives.advantages import CostValueKeys, CostValueMixin
from saferl.objectives.checks import check_begun, check_lagrange, check_risk
from saferl.objectives.cost_terms import quantile_loss


class PPOLagLoss(CostValueMixin, PPOTerms):
    r"""Clipped PPO with a cost critic and a Lagrange multiplier (Ray, Achiam and Amodei, 2019).

    .. math::

        A &= (A_r - \sum \lambda A_c) / (1 + \sum \lambda), \quad \hat A = (A - \bar A) / \mathrm{std}(A) \\
        L_\pi &= -E[\min(\rho \hat A, \mathrm{clip}(\rho, 1 - \epsilon, 1 + \epsilon) \hat A)] \\
        L_c &= E[\tfrac12 (V_c(s) - G_c)^2]

    with :math:`\rho` the ratio of the new policy's probability to that of the policy that acted. The advantages are
    weighed first, and their sum is standardised: the multiplier stays in units of reward per cost. Sums are over K
    constraints, of which :math:`A_c`, :math:`V_c` and :math:`\lambda` are vectors.

    The multiplier is not trained here. A loop moves it once for each batch of fresh episodes, with
    ``loss.lagrange.update(loss.lagrange.penalty(episode_cost - limit))``.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the policy.
        critic_network (TensorDictModule): V(s).
        cost_critic (TensorDictModule): V_c(s), with K outputs.

    Keyword Args:
        lagrange (LagrangeMultiplier): the multiplier, saved with the loss. Its number of values is K.
        normalize_advantage (bool, optional): standardise the weighed advantage over each batch that the loss is given.
            Defaults to ``True``.
        clip_epsilon, entropy_bonus, entropy_coeff, critic_coeff, clip_value, loss_critic_type, separate_losses,
            reduction: as in :class:`~torchrl.objectives.ClipPPOLoss`. Defaults here: ``entropy_bonus=False``,
            ``loss_critic_type="l2"``.

    Reads what :meth:`begin` leaves in a batch, in any batch shape ``[*B]``: the networks' inputs; ``"action"``
        ``[*B, A]``, the policy's own, and its ``"action_log_prob"`` ``[*B]``; ``"advantage"`` and ``"value_target"`` in the
        unit of the reward ``[*B, 1]``, ``"cost_advantage"`` and ``"cost_value_target"`` in the units of the costs ``[*B, K]``.
    Writes ``"loss_objective"``, ``"loss_critic"``, ``"loss_cost"``: scalars, or ``[*B]`` without reduction; the reports of
        :class:`~torchrl.objectives.ClipPPOLoss`; ``"lagrange_multiplier"`` (reward per cost), a scalar, or ``[K]``.

    Raises:
        ValueError: ``clip_epsilon`` is not positive; ``lagrange`` is no multiplier; ``gamma`` lies outside [0, 1]; a batch has
            another number of costs than ``lagrange`` has values.
        KeyError: the batch holds no cost; ``begin`` has not seen it.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from saferl.modules import (
        ...     DualAscent, MLPPolicyEncoder, StateValue, tanh_gaussian_actor, value_operator
        ... )
        >>> from saferl.objectives import PPOLagLoss
        >>> def value(key):
        ...     network = StateValue(MLPPolicyEncoder(rows=3, width=16), width=16)
        ...     return value_operator(network, in_keys=("ego", "vehicles"), out_key=key)
        >>> actor = tanh_gaussian_actor(MLPPolicyEncoder(rows=3, width=16), width=16)
        >>> values = value("state_value"), value("state_cost_value")
        >>> loss = PPOLagLoss(actor, *values, lagrange=DualAscent(init=1.0))
        >>> state = {"ego": torch.randn(4, 8, 9), "vehicles": torch.randn(4, 8, 3, 6)}
        >>> end = torch.zeros(4, 8, 1, dtype=torch.bool)
        >>> following = {**state, "reward": torch.randn(4, 8, 1), "cost": torch.rand(4, 8, 1)}
        >>> batch = TensorDict(
        ...     {**state, "next": {**following, "done": end, "terminated": end}}, [4, 8]
        ... )
        >>> batch = actor(batch).detach()
        >>> loss.begin(batch)
        >>> output = loss(batch.reshape(-1)[:16])
        >>> sum(value for key, value in output.items() if key.startswith("loss_")).backward()
    """

    _AcceptedKeys = CostValueKeys
    default_keys = CostValueKeys
    input_networks = ("actor_network", "critic_network", "cost_critic")
    input_entries = (
        *("action", "sample_log_prob", "advantage", "value_target"),
        *("cost_advantage", "cost_value_target"),
    )

    #: The kind of multiplier that it takes.
    multiplier: ClassVar[type[LagrangeMultiplier]] = LagrangeMultiplier
    #: What :meth:`policy_terms` writes beside ``"loss_objective"``.
    terms: ClassVar[tuple[str, ...]] = ()

    lagrange: LagrangeMultiplier

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModule,
        cost_critic: TensorDictModule,
        *,
        lagrange: LagrangeMultiplier,
        clip_epsilon: float = 0.2,
        entropy_bonus: bool = False,
        entropy_coeff: float = 0.01,
        critic_coeff: float = 1.0,
        clip_value: bool | float = False,
        loss_critic_type: Literal["l1", "l2", "smooth_l1"] = "l2",
        normalize_advantage: bool = True,
        separate_losses: bool = False,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        if not clip_epsilon > 0:
            raise ValueError(f"clip_epsilon must be > 0, got {clip_epsilon}.")
        super().__init__(
            actor_network,
            critic_network,
            clip_epsilon=clip_epsilon,
            entropy_bonus=entropy_bonus,
            entropy_coeff=entropy_coeff,
            critic_coeff=critic_coeff,
            clip_value=clip_value,
            loss_critic_type=loss_critic_type,
            normalize_advantage=normalize_advantage,
            separate_losses=separate_losses,
            reduction=reduction,
        )
        self.lagrange = check_lagrange(lagrange, self.multiplier)
        self.add_cost_value(cost_critic, self.lagrange.count)
        self.out_keys = [*self.out_keys, *self.terms, "loss_cost", "lagrange_multiplier"]

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        for key in (self.tensor_keys.advantage, self.tensor_keys.cost_advantage):
            check_begun(tensordict, key)
        reward = tensordict.get(self.tensor_keys.advantage)
        cost = tensordict.get(self.tensor_keys.cost_advantage)
        weighed = tensordict.clone(False)
        weighed.set(self.tensor_keys.advantage, self.weigh(reward, cost))
        out = super().forward(weighed)
        out.update(self.policy_terms(weighed))
        out.set("loss_cost", self.cost_loss(tensordict))
        out.set("lagrange_multiplier", self.lagrange.value.detach().clone())
        self.release(tensordict, out, "cost_critic_params", "target_cost_critic_params")
        return out

    def weigh(self, reward: Tensor, cost: Tensor) -> Tensor:
        """What the policy improves ``[*B, 1]``, of the advantages of the reward ``[*B, 1]`` and of the costs ``[*B, K]``."""
        multiplier = self.lagrange.value.detach().to(reward)
        priced = (multiplier * cost).sum(-1, keepdim=True)
        return (reward - priced) / (1.0 + multiplier.sum())

    def policy_terms(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """Terms of the policy beside, or in place of, the clipped ``"loss_objective"``; here none.

        Args:
            tensordict: ``[*B]``, whose ``"advantage"`` is what :meth:`weigh` made.
        """
        return {}


@dataclass
class RiskKeys(CostValueKeys):
    """Keys that ``set_keys`` accepts beside those of :class:`PPOLagLoss`.

    Attributes:
        action_executed: the action that the environment got; where a batch has none, the policy's own.
        state_action_cost_value: what the risk critics write.
    """

    action_executed: NestedKey = ("next", "action_executed")
    state_action_cost_value: NestedKey = "state_action_cost_value"


class RiskPPOLoss(PPOLagLoss):
    r"""PPO-Lagrangian that also learns :math:`Q_c(s, a)`, the risk that a projector needs.

    .. math::

        L_{risk} = E\Big[\sum_i \tfrac12 (Q_{c,i}(s, \bar a) - G_c)^2\Big]

    beside the terms of :class:`PPOLagLoss`, with :math:`\bar a` the action that was executed and :math:`G_c` the cost's
    value target, the TD(lambda) return that followed it (ours; the critic is that of E13 in
    :class:`~saferl.objectives.SACLagLoss`). The policy's own terms keep the action that it proposed, whose
    log-probability it knows: the correction is a part of what it acts on.

    Args:
        actor_network, critic_network, cost_critic: as in :class:`PPOLagLoss`.
        risk_critic (list of TensorDictModule): the members of Q_c(s, a), at least two.

    Keyword Args:
        risk (callable, optional): what :attr:`cost_value` makes of the members' values of a cost ``[n, *B, N]``. Defaults to
            :class:`~saferl.modules.Largest`.
        **settings: as in :class:`PPOLagLoss`.

    Reads what :class:`PPOLagLoss` does, and ``("next", "action_executed")`` ``[*B, A]`` where a projector wrote it.
    Writes what :class:`PPOLagLoss` does, and ``"loss_risk"``: a scalar, or ``[*B]`` without reduction.

    Raises:
        ValueError: as :class:`PPOLagLoss`; ``risk_critic`` has fewer than two members.
        KeyError: as :class:`PPOLagLoss`.

    Examples:
        >>> from saferl.modules import (
        ...     DualAscent, MLPPolicyEncoder, MLPValue, StateValue, tanh_gaussian_actor, value_operator
        ... )
        >>> from saferl.objectives import RiskPPOLoss
        >>> def value(key):
        ...     network = StateValue(MLPPolicyEncoder(rows=3, width=16), width=16)
        ...     return value_operator(network, in_keys=("ego", "vehicles"), out_key=key)
        >>> members = [
        ...     value_operator(MLPValue(rows=3, width=16), out_key="state_action_cost_value")
        ...     for _ in range(2)
        ... ]
        >>> actor = tanh_gaussian_actor(MLPPolicyEncoder(rows=3, width=16), width=16)
        >>> values = value("state_value"), value("state_cost_value")
        >>> loss = RiskPPOLoss(actor, *values, members, lagrange=DualAscent())
        >>> loss.cost_value.out_keys
        ['state_action_cost_value']
    """

    _AcceptedKeys = RiskKeys
    default_keys = RiskKeys

    risk_critic: TensorDictModule
    risk_critic_params: TensorDictParams
    target_risk_critic_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModule,
        cost_critic: TensorDictModule,
        risk_critic: list[TensorDictModule],
        *,
        lagrange: LagrangeMultiplier,
        risk: Callable[[Tensor], Tensor] | None = None,
        clip_epsilon: float = 0.2,
        entropy_bonus: bool = False,
        entropy_coeff: float = 0.01,
        critic_coeff: float = 1.0,
        clip_value: bool | float = False,
        loss_critic_type: Literal["l1", "l2", "smooth_l1"] = "l2",
        normalize_advantage: bool = True,
        separate_losses: bool = False,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        if not isinstance(risk_critic, list) or len(risk_critic) < 2:
            raise ValueError(
                f"risk_critic must be a list of two critics or more, got {risk_critic!r}."
            )
        super().__init__(
            actor_network,
            critic_network,
            cost_critic,
            lagrange=lagrange,
            clip_epsilon=clip_epsilon,
            entropy_bonus=entropy_bonus,
            entropy_coeff=entropy_coeff,
            critic_coeff=critic_coeff,
            clip_value=clip_value,
            loss_critic_type=loss_critic_type,
            normalize_advantage=normalize_advantage,
            separate_losses=separate_losses,
            reduction=reduction,
        )
        self.risk = check_risk(Largest() if risk is None else risk)
        self.convert_to_functional(risk_critic, "risk_critic", len(risk_critic))  # pyright: ignore
        self.out_keys = [*self.out_keys, "loss_risk"]

    @property
    def cost_value(self) -> CriticEnsemble:
        """The risk of the members' values, on their live parameters, as :attr:`SACLagLoss.cost_value`."""
        return CriticEnsemble(
            self.risk_critic,
            params=self.risk_critic_params,
            reduce=self.risk,
            costs=self.lagrange.count,
            action_key=self.tensor_keys.action,
        )

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        out = super().forward(tensordict)
        out.set("loss_risk", self.risk_loss(tensordict))
        self.release(tensordict, out, "risk_critic_params", "target_risk_critic_params")
        return out

    def risk_loss(self, tensordict: TensorDictBase) -> Tensor:
        """The loss of Q_c(s, a), summed over its members and the costs and reduced.

        Half the squared error against ``"cost_value_target"``, or, of critics with N > 1 outputs for each cost,
        :func:`quantile_loss`.

        Args:
            tensordict: ``[*B]`` as :meth:`begin` leaves it.

        Raises:
            KeyError: ``begin`` has not seen the batch.
        """
        keys = self.tensor_keys
        check_begun(tensordict, keys.cost_value_target)
        action = tensordict.get(keys.action_executed, tensordict.get(keys.action))
        critics = BoundCritics.of(
            self.risk_critic, self.risk_critic_params, tensordict, action_key=keys.action
        )
        predicted = critics.values(action)
        target = tensordict.get(keys.cost_value_target)
        if predicted.shape[-1] > target.shape[-1]:
            predicted = predicted.unflatten(-1, (target.shape[-1], -1))
            loss = quantile_loss(predicted, target.unsqueeze(-1))
        else:
            loss = 0.5 * distance_loss(predicted, target.expand_as(predicted), loss_function="l2")
        return self.reduced(loss.sum(-1).sum(0), tensordict)
