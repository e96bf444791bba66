"""Soft actor-critic under a Lagrangian cost constraint (E11 to E14)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from tensordict.utils import NestedKey, expand_as_right
from torch import Tensor
from torchrl.data.tensor_specs import TensorSpec
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SACLoss
from torchrl.objectives.sac import compute_rsample_log_prob

from saferl.modules import BoundCritics, LagrangeMultiplier
from saferl.objectives.checks import count_members
from saferl.objectives.cost import CostCriticLoss

_LOSSES = ("loss_actor", "loss_qvalue", "loss_cost", "loss_alpha")
_SCALARS = ("alpha", "entropy", "lagrange_multiplier")
_CRITICS = ("qvalue_network_params", "cost_critic_params")
_PARAMS = ("actor_network_params", *_CRITICS, *(f"target_{name}" for name in _CRITICS))


class SACLagLoss(CostCriticLoss, SACLoss):
    r"""SAC with cost critics and a Lagrange multiplier (E11 to E14 of the paper).

    With :math:`Q = \min_i Q_i`, :math:`Q_c = \max_i Q_{c,i}` and one action
    :math:`\tilde a` drawn from the policy at each state:

    .. math::

        L_\pi &= E[\alpha \log\pi(\tilde a|s) - Q(s, \tilde a)
                 + \lambda\, \rho(Q_c(s, \tilde a) - d)]                    & (E11) \\
        L_Q &= E[\sum_i \tfrac12 (Q_i(s, a) - r - \gamma (1 - \tau)
               (Q^-(s', \tilde a') - \alpha \log\pi(\tilde a'|s')))^2]      & (E12) \\
        L_c &= E[\sum_i \tfrac12 (Q_{c,i}(s, a) - c - \gamma (1 - \tau)
               Q_c^-(s', \tilde a'))^2]                                     & (E13) \\
        L_\alpha &= E[\alpha (-\log\pi(\tilde a|s) - H_0)]                  & (E14)

    :math:`\tau` is ``terminated``: both targets bootstrap through ``truncated``.
    :math:`d` is ``cost_limit`` and :math:`\rho` is ``lagrange.penalty``, a ReLU
    for the paper's state-wise constraint. E12 and E13 share the one action
    :math:`\tilde a'`, as the policy proposes it, and use target critics.

    The gradient of a term reaches its own parameters only, so the four may be
    summed and stepped together. The multiplier is never trained here; a loop
    ascends it with ``loss.lagrange.update(output["constraint_violation"])``.
    That entry is :math:`\partial L_\pi / \partial\lambda`, the batch mean of
    :math:`\rho`: the ReLU is taken for each sample before the mean.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the policy.
        qvalue_network (TensorDictModule or list of TensorDictModule): reward
            critic. One module is copied and re-initialised for each member; a
            list supplies the members and keeps their initial parameters.
        cost_critic (TensorDictModule or list of TensorDictModule): likewise for
            the cost; writes ``"state_action_cost_value"``.

    Keyword Args:
        lagrange (LagrangeMultiplier): the multiplier, saved with the loss.
        cost_limit (float, optional): bound on the discounted cost value, in the
            unit of ``cost``. Defaults to ``0.05``.
        cost_target ("max" or "mean", optional): what :math:`Q_c^-` is of the members of
            the target. Defaults to ``"max"`` (paper), whose overestimate feeds itself.
        cost_backup ("sum" or "reach", optional): what the cost critics learn, the discounted sum of costs
            (paper) or the largest one ahead. Defaults to ``"sum"``.
        risk (callable, optional): what :math:`Q_c(s, \tilde a)` is of the members' values ``[n, *B, K]``.
            Defaults to :class:`~saferl.modules.Largest` (paper).
        rescale (bool, optional): divide the actor's loss by :math:`1 + \lambda`. Defaults to ``False`` (paper).
        num_qvalue_nets (int, optional): reward critics. Defaults to ``2``, or the length of a list.
        num_cost_critics (int, optional): cost critics. Defaults to ``2``, or the length of a list.
        delay_qvalue (bool, optional): keep target copies of both kinds of
            critic. Defaults to ``True``.
        alpha_init, min_alpha, max_alpha, action_spec, fixed_alpha,
            target_entropy, separate_losses, reduction, deactivate_vmap,
            use_prioritized_weights, scalar_output_mode: as in
            :class:`~torchrl.objectives.SACLoss`.

    Reads (any batch shape ``[*B]``):
        the networks' inputs at the root and under ``"next"``; ``"action"``
        ``[*B, A]``; under ``"next"``: ``"reward"``, ``"cost"``, ``"done"``,
        ``"terminated"`` ``[*B, 1]``. Where terminated, the next observation is
        never used and may be NaN.

    Writes:
        ``"loss_actor"``, ``"loss_qvalue"``, ``"loss_cost"``, ``"loss_alpha"``,
        ``"constraint_violation"`` (``[*B]`` without reduction, else scalars);
        scalars ``"alpha"``, ``"entropy"``, ``"lagrange_multiplier"``. Into its
        input: ``"td_error"`` ``[*B]``, the reward critics' priority.

    Raises:
        ValueError: ``cost_limit`` is negative or not finite, a number of critics is
            below one, critics come as a list of one, ``cost_target`` or ``cost_backup`` is
            unknown, ``risk`` is no function, ``lagrange`` no multiplier, or ``gamma`` lies
            outside [0, 1]; in a batch, ``cost_backup="reach"`` with multi-step transitions.
        KeyError: the batch holds no cost.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from saferl.modules import (
        ...     DualAscent, MLPPolicyEncoder, MLPValue, tanh_gaussian_actor, value_operator
        ... )
        >>> from saferl.objectives import SACLagLoss
        >>> loss = SACLagLoss(
        ...     tanh_gaussian_actor(MLPPolicyEncoder(rows=3, width=16), width=16),
        ...     value_operator(MLPValue(rows=3, width=16)),
        ...     value_operator(MLPValue(rows=3, width=16), out_key="state_action_cost_value"),
        ...     cost_limit=0.05,
        ...     lagrange=DualAscent(init=1.0, lr=1e-4),
        ... )
        >>> loss.make_value_estimator(gamma=0.99)
        >>> target_updater = SoftUpdate(loss, tau=0.005)
        >>> state = {"ego": torch.randn(4, 9), "vehicles": torch.randn(4, 3, 6)}
        >>> following = {
        ...     **state,
        ...     "reward": torch.randn(4, 1),
        ...     "cost": torch.rand(4, 1),
        ...     "done": torch.zeros(4, 1, dtype=torch.bool),
        ...     "terminated": torch.zeros(4, 1, dtype=torch.bool),
        ... }
        >>> batch = TensorDict({**state, "action": torch.zeros(4, 2), "next": following}, [4])
        >>> output = loss(batch)
        >>> sum(value for key, value in output.items() if key.startswith("loss_")).backward()
        >>> loss.lagrange.update(output["constraint_violation"])
        >>> target_updater.step()
        >>> loss.cost_value(batch)["state_action_cost_value"].shape
        torch.Size([4, 1])
    """

    @dataclass
    class _AcceptedKeys(SACLoss._AcceptedKeys):
        """Keys that ``set_keys`` accepts beside those of SACLoss.

        Attributes:
            cost (NestedKey): the cost under ``"next"``. Defaults to ``"cost"``.
            state_action_cost_value (NestedKey): the entry that the cost critic
                writes. Defaults to ``"state_action_cost_value"``.
        """

        cost: NestedKey = "cost"
        state_action_cost_value: NestedKey = "state_action_cost_value"

    default_keys = _AcceptedKeys

    log_alpha: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        cost_critic: TensorDictModule | list[TensorDictModule],
        *,
        lagrange: LagrangeMultiplier,
        cost_limit: float = 0.05,
        cost_target: Literal["max", "mean"] = "max",
        cost_backup: Literal["sum", "reach"] = "sum",
        risk: Callable[[Tensor], Tensor] | None = None,
        rescale: bool = False,
        num_qvalue_nets: int | None = None,
        num_cost_critics: int | None = None,
        alpha_init: float = 1.0,
        min_alpha: float | None = None,
        max_alpha: float | None = None,
        action_spec: TensorSpec | None = None,
        fixed_alpha: bool = False,
        target_entropy: Literal["auto"] | float = "auto",
        delay_qvalue: bool = True,
        separate_losses: bool = False,
        reduction: Literal["none", "mean", "sum"] | None = None,
        deactivate_vmap: bool = False,
        use_prioritized_weights: Literal["auto"] | bool = "auto",
        scalar_output_mode: Literal["exclude", "non_tensor"] | None = None,
    ) -> None:
        num_qvalue_nets = count_members(
            "qvalue_network", qvalue_network, "num_qvalue_nets", num_qvalue_nets
        )
        super().__init__(
            actor_network,
            qvalue_network,
            num_qvalue_nets=num_qvalue_nets,
            alpha_init=alpha_init,
            min_alpha=min_alpha,
            max_alpha=max_alpha,
            action_spec=action_spec,
            fixed_alpha=fixed_alpha,
            target_entropy=target_entropy,
            delay_qvalue=delay_qvalue,
            separate_losses=separate_losses,
            reduction=reduction,
            deactivate_vmap=deactivate_vmap,
            use_prioritized_weights=use_prioritized_weights,
            scalar_output_mode=scalar_output_mode,
        )
        self._add_cost_critic(
            cost_critic,
            num_cost_critics,
            lagrange=lagrange,
            cost_limit=cost_limit,
            cost_target=cost_target,
            cost_backup=cost_backup,
            risk=risk,
            create_target_params=delay_qvalue,
            compare_against=list(actor_network.parameters()) if separate_losses else None,
        )
        self.rescale = rescale
        _ = self.target_entropy  # now, as its first look-up would break a compiled graph
        self.out_keys = [*_LOSSES, "constraint_violation"]
        if self.reduction != "none" or self.scalar_output_mode == "non_tensor":
            self.out_keys += _SCALARS

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        next_sample = self._sample_next(tensordict)
        # One look at the states serves the values of the stored action and of the policy's.
        reward = self._bind(self.qvalue_network, self.qvalue_network_params, tensordict)
        cost = self._bind(self.cost_critic, self.cost_critic_params, tensordict)
        loss_qvalue, metadata = self.qvalue_v2_loss(tensordict, next_sample, reward)
        loss_cost, _ = self.cost_loss(tensordict, next_sample, cost)
        loss_actor, actor_metadata = self.actor_loss(tensordict, reward, cost)
        log_prob = actor_metadata["log_prob"]
        loss_alpha = self._reduce_loss(
            self._alpha_loss(log_prob),
            tensordict=tensordict,
            weights=self._maybe_get_priority_weight(tensordict),
        )
        tensordict.set(self.tensor_keys.priority, metadata["td_error"])
        out = {
            "loss_actor": loss_actor,
            "loss_qvalue": loss_qvalue,
            "loss_cost": loss_cost,
            "loss_alpha": loss_alpha,
            "constraint_violation": actor_metadata["constraint_violation"],
        }
        scalars = {
            "alpha": self._alpha,
            "entropy": -log_prob.mean(),
            # A copy: the loop moves the buffer in place after this.
            "lagrange_multiplier": self.lagrange.value.detach().clone(),
        }
        if self.reduction == "none":
            td_out = TensorDict(out, batch_size=tensordict.batch_size)
            if self.scalar_output_mode == "non_tensor":
                for key, value in scalars.items():
                    td_out.set_non_tensor(key, value)
        else:
            td_out = TensorDict({**out, **scalars}, batch_size=[])
        self._clear_weakrefs(tensordict, td_out, *_PARAMS)
        return td_out

    def actor_loss(
        self,
        tensordict: TensorDictBase,
        reward_critics: BoundCritics | None = None,
        cost_critics: BoundCritics | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """E11: entropy, smallest reward value and penalised largest cost value.

        Args:
            tensordict (TensorDictBase): the batch.
            reward_critics, cost_critics (optional): the critics bound to the batch's
                states, where they are known already; their parameters get no gradient.
        """
        reward = reward_critics or self._bind(
            self.qvalue_network, self.qvalue_network_params, tensordict
        )
        cost = cost_critics or self._bind(self.cost_critic, self.cost_critic_params, tensordict)
        weights = self._maybe_get_priority_weight(tensordict)
        sample, log_prob = self._sample_action(tensordict)
        action = sample.get(self.tensor_keys.action)
        qvalue = reward.detach().values(action).min(0)[0]
        cost_value = replace(cost.detach(), reduce=self.risk)(action)
        penalty = self.lagrange.penalty(cost_value.squeeze(-1) - self.cost_limit)
        multiplier = self.lagrange.value.detach().to(penalty)
        loss_actor = self._alpha * log_prob - qvalue.squeeze(-1) + multiplier * penalty
        if self.rescale:
            loss_actor = loss_actor / (1.0 + multiplier)
        metadata = {
            "log_prob": log_prob.detach(),
            "constraint_violation": self._reduce_loss(
                penalty.detach(),
                tensordict=tensordict,
                # The multiplier's step must not grow with the batch, even under "sum".
                reduction="none" if self.reduction == "none" else "mean",
                weights=weights,
            ),
        }
        loss_actor = self._reduce_loss(loss_actor, tensordict=tensordict, weights=weights)
        return loss_actor, metadata

    def qvalue_v2_loss(
        self,
        tensordict: TensorDictBase,
        next_sample: tuple[TensorDictBase, Tensor] | None = None,
        critics: BoundCritics | None = None,
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """E12: reward critics against the smallest soft target value.

        Args:
            tensordict (TensorDictBase): the batch.
            next_sample (optional): next state with the policy's action, and its
                log-probability ``[*B]``. Drawn afresh by default.
            critics (optional): the reward critics bound to the batch's states, where
                they are known already.
        """
        next_state, log_prob = next_sample or self._sample_next(tensordict)
        with torch.no_grad():
            targets = self._bind(self.qvalue_network, self.target_qvalue_network_params, next_state)
            next_value = targets.values(next_state.get(self.tensor_keys.action)).min(0)[0]
            next_value = next_value - self._alpha * log_prob.unsqueeze(-1)
            target = self.value_estimator.value_estimate(tensordict.copy(), next_value=next_value)
        critics = critics or self._bind(self.qvalue_network, self.qvalue_network_params, tensordict)
        predicted = critics.values(tensordict.get(self.tensor_keys.action))
        return self._bellman_loss(predicted, target, tensordict)

    def _alpha_loss(self, log_prob: Tensor) -> Tensor:
        """E14, unreduced ``[*B]``; the parent class weighs with ``log_alpha`` instead."""
        target = self.target_entropy  # a tensor, since the constructor asked for it
        return -self.log_alpha.exp() * (log_prob + target)  # pyright: ignore[reportOperatorIssue]

    def _sample_action(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, Tensor]:
        """Copy of ``tensordict`` with an action of the policy, and its log-probability."""
        tensordict = tensordict.copy()
        with (
            set_exploration_type(ExplorationType.RANDOM),
            self.actor_network_params.to_module(self.actor_network, preserve_module_state=False),
        ):
            # On the inputs alone: the distribution's parameters stay out of the caller's batch.
            dist = self.actor_network.get_dist(tensordict.select(*self.actor_network.in_keys))
            action, log_prob = compute_rsample_log_prob(dist)
        return tensordict.set(self.tensor_keys.action, action), log_prob

    def _sample_next(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, Tensor]:
        """Next state with one action of the policy, for the targets of reward and cost."""
        terminated = tensordict.get(("next", self.tensor_keys.terminated))
        next_state = tensordict.get("next").copy()
        for key in self._observation_keys:
            # Multiplying by (1 - terminated) keeps a NaN, so a state that is never
            # valued gives way to a finite one before it meets a network.
            mask = expand_as_right(terminated.squeeze(-1), next_state[key])
            next_state.set(key, torch.where(mask, tensordict[key], next_state[key]))
        with torch.no_grad():
            return self._sample_action(next_state)
