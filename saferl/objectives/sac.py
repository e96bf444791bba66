"""Soft actor-critic under a Lagrangian cost constraint.

E11 to E14 are equations (8) and (10) to (12) of the paper, `arXiv 2503.19690 <https://arxiv.org/abs/2503.19690>`_, by
their labels there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from tensordict.utils import NestedKey, expand_as_right
from torch import Tensor
from torchrl.data.tensor_specs import TensorSpec
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SACLoss
from torchrl.objectives.sac import compute_rsample_log_prob

from saferl.modules import LagrangeMultiplier
from saferl.objectives.adapter import SACTerms
from saferl.objectives.checks import check_choice, count_members
from saferl.objectives.cost_terms import CostBackup, CostCriticMixin, CostTarget, SharedTerms

#: What weighs the entropy's distance from its target in the temperature's term.
AlphaWeight = Literal["alpha", "log_alpha"]


class SACLagLoss(CostCriticMixin, SACTerms):
    r"""SAC with cost critics and a Lagrange multiplier.

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

    - :math:`\tau` is ``terminated``: both targets go on through ``truncated``.
    - :math:`d` is ``risk_limit``.
    - :math:`\rho` is ``lagrange.penalty``: a ReLU for the paper's state-wise constraint, taken for each sample before
      the mean.
    - E12 and E13 share the action :math:`\tilde a'`, which the policy proposes. They use target critics.

    Of K constraints :math:`c`, :math:`Q_c`, :math:`d` and :math:`\lambda` are vectors, and the terms with them sums.

    The gradient of a term reaches its own parameters only. The four may be summed and stepped together.

    The multiplier is not trained here. A loop ascends it with ``loss.lagrange.update(output["constraint_violation"])``:
    that entry is :math:`\partial L_\pi / \partial\lambda`, the batch mean of :math:`\rho`.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the policy.
        qvalue_network (TensorDictModule or list of TensorDictModule): the reward critic. One module is copied for each
            member and drawn anew. A list gives the members, with the parameters that they have.
        cost_critic (TensorDictModule or list of TensorDictModule): likewise for the cost, with K outputs.

    Keyword Args:
        lagrange (LagrangeMultiplier): the multiplier, saved with the loss. Its number of values is K.
        risk_limit (float or list of float, optional): d, a bound on the risk in each state, the discounted cost ahead; of
            several costs one for each, or one for all. Defaults to ``0.05``.
        cost_target ("max" or "mean", optional): what :math:`Q_c^-` is of the members of the target. Defaults to
            ``"max"`` (paper), whose overestimate feeds itself.
        cost_backup ("sum" or "reach", optional): what the cost critics learn, the discounted sum of costs (paper) or
            the largest one ahead. Defaults to ``"sum"``.
        risk (callable, optional): what :math:`Q_c(s, \tilde a)` is of the members' values of a cost ``[n, *B, N]``. Defaults to
            :class:`~saferl.modules.Largest` (paper).
        rescale (bool, optional): divide the actor's term by :math:`1 + \sum \lambda`. Defaults to ``False`` (paper).
        alpha_weight ("alpha" or "log_alpha", optional): what weighs the temperature's term. ``"alpha"`` is E14.
            ``"log_alpha"`` is :class:`~torchrl.objectives.SACLoss`, whose slope in :math:`\log\alpha` lacks the factor
            :math:`\alpha`. Defaults to ``"alpha"`` (paper).
        num_qvalue_nets (int, optional): reward critics. Defaults to ``2``, or the length of a list.
        num_cost_critics (int, optional): cost critics. Defaults to ``2``, or the length of a list.
        delay_qvalue (bool, optional): keep target copies of both kinds of critic. Defaults to ``True``.
        alpha_init, min_alpha, max_alpha, action_spec, fixed_alpha, target_entropy, separate_losses, reduction,
            deactivate_vmap, use_prioritized_weights, scalar_output_mode: as in :class:`~torchrl.objectives.SACLoss`.

    Reads the networks' inputs at the root and under ``"next"``; ``"action"`` ``[*B, A]``; under ``"next"`` ``"reward"``
        ``[*B, 1]`` and ``"cost"`` ``[*B, K]`` in their units, ``"done"`` and ``"terminated"`` ``[*B, 1]``. Where terminated, the
        next observation is not used and may be NaN.
    Writes ``"loss_actor"``, ``"loss_qvalue"``, ``"loss_cost"``, ``"loss_alpha"`` and ``"constraint_violation"``, in the
        unit of the cost: scalars, or ``[*B]`` without reduction; the scalars ``"alpha"``, ``"entropy"`` (nats),
        ``"lagrange_multiplier"`` (reward per cost). With K > 1 ``"constraint_violation"`` and ``"lagrange_multiplier"`` have
        one more dimension ``[K]``. Into the batch: ``"td_error"`` ``[*B]`` of the reward critics.

    Raises:
        ValueError: ``risk_limit`` is negative or not finite, or of another K than ``lagrange``, or a batch's cost is; a number of critics is below one; critics come as a list
            of one; ``cost_target``, ``cost_backup`` or ``alpha_weight`` is unknown; ``risk`` is no function;
            ``lagrange`` is no multiplier; ``gamma`` lies outside [0, 1]; a batch has multi-step transitions with
            ``cost_backup="reach"``.
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
        ...     risk_limit=0.05,
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
        """Keys that ``set_keys`` accepts beside those of :class:`~torchrl.objectives.SACLoss`.

        Attributes:
            cost: the cost under ``"next"``.
            state_action_cost_value: what the cost critics write.
        """

        cost: NestedKey = "cost"
        state_action_cost_value: NestedKey = "state_action_cost_value"

    default_keys = _AcceptedKeys

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        cost_critic: TensorDictModule | list[TensorDictModule],
        *,
        lagrange: LagrangeMultiplier,
        risk_limit: float | Sequence[float] = 0.05,
        cost_target: CostTarget = "max",
        cost_backup: CostBackup = "sum",
        risk: Callable[[Tensor], Tensor] | None = None,
        rescale: bool = False,
        alpha_weight: AlphaWeight = "alpha",
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
        self.add_cost_critic(
            cost_critic,
            num_cost_critics,
            lagrange=lagrange,
            risk_limit=risk_limit,
            cost_target=cost_target,
            cost_backup=cost_backup,
            risk=risk,
            create_target_params=delay_qvalue,
            compare_against=list(actor_network.parameters()) if separate_losses else None,
        )
        self.rescale = rescale
        self.alpha_weight = check_choice("alpha_weight", alpha_weight, AlphaWeight)
        _ = self.target_entropy  # now, as its first look-up would break a compiled graph
        self.out_keys = ["loss_actor", "loss_qvalue", "loss_cost", "loss_alpha"]
        self.out_keys += ["constraint_violation"]
        if self.reduction != "none" or self.scalar_output_mode == "non_tensor":
            self.out_keys += ["alpha", "entropy", "lagrange_multiplier"]

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        # One action at the next states serves both targets, and one look at the states all values in them.
        shared = self._shared = SharedTerms(
            tensordict,
            self.sample_next(tensordict),
            {name: self.critics(name, tensordict) for name in ("qvalue_network", "cost_critic")},
        )
        try:
            out = super().forward(tensordict)
            out.set("loss_cost", self.cost_loss(tensordict)[0])
            out.set("constraint_violation", shared.violation)
        finally:
            self._shared = None
        # A copy: the loop moves the buffer in place after this.
        multiplier = self.lagrange.value.detach().clone()
        if self.reduction != "none":
            out.set("lagrange_multiplier", multiplier)
        elif self.scalar_output_mode == "non_tensor":
            out.set_non_tensor("lagrange_multiplier", multiplier)
        self.release(tensordict, out, "cost_critic_params", "target_cost_critic_params")
        return out

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """E11: the entropy's term, the smallest reward value and the penalised risk; critics get no gradient.

        Args:
            tensordict: the batch ``[*B]``.

        Returns:
            The loss, reduced; ``"log_prob"`` ``[*B]`` and ``"constraint_violation"``, reduced, but never by a sum; of several
            constraints each by itself.
        """
        reward = self.critics("qvalue_network", tensordict).detach()
        cost = self.critics("cost_critic", tensordict).detach()
        cost = replace(cost, reduce=self.risk, costs=self.lagrange.count)
        sample, log_prob = self.sample_action(tensordict)
        action = sample.get(self.tensor_keys.action)
        qvalue = reward.values(action).min(0)[0]
        penalty = self.lagrange.penalty(cost(action) - self.risk_limit)
        multiplier = self.lagrange.value.detach().to(penalty)
        loss = self.temperature * log_prob - qvalue.squeeze(-1) + (multiplier * penalty).sum(-1)
        if self.rescale:
            loss = loss / (1.0 + multiplier.sum())
        # The multiplier's step must not grow with the batch, even under "sum".
        kept = "none" if self.reduction == "none" else "mean"
        each = [self.reduced(one, tensordict, kept) for one in penalty.detach().unbind(-1)]
        violation = torch.stack(each, -1).squeeze(-1)
        if (shared := self.shared(tensordict)) is not None:
            shared.violation = violation
        metadata = {"log_prob": log_prob.detach(), "constraint_violation": violation}
        return self.reduced(loss, tensordict), metadata

    def qvalue_v2_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """E12: reward critics against the smallest soft target value.

        Args:
            tensordict: the batch ``[*B]``.

        Returns:
            The loss, reduced, and ``"td_error"`` ``[*B]``, the largest over the members.
        """
        next_state, log_prob = self.next_sample(tensordict)
        with torch.no_grad():
            targets = self.bind(self.qvalue_network, self.target_qvalue_network_params, next_state)
            next_value = targets.values(next_state.get(self.tensor_keys.action)).min(0)[0]
            next_value = next_value - self.temperature * log_prob.unsqueeze(-1)
            target = self.value_estimator.value_estimate(tensordict.copy(), next_value=next_value)
        critics = self.critics("qvalue_network", tensordict)
        predicted = critics.values(tensordict.get(self.tensor_keys.action))
        return self.bellman_loss(predicted, target, tensordict)

    def temperature_term(self, log_prob: Tensor) -> Tensor:
        """E14, ``[*B]``, from log-probabilities ``[*B]``; with ``alpha_weight="log_alpha"`` SACLoss's."""
        if self.alpha_weight == "log_alpha":
            return super().temperature_term(log_prob)
        target = self.target_entropy  # a tensor, since the constructor asked for it
        return -self.log_alpha.exp() * (log_prob + target)  # pyright: ignore[reportOperatorIssue]

    def sample_action(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, Tensor]:
        """Copy of a batch with an action of the policy ``[*B, A]``, and its log-probability ``[*B]``."""
        tensordict = tensordict.copy()
        with (
            set_exploration_type(ExplorationType.RANDOM),
            self.actor_network_params.to_module(self.actor_network, preserve_module_state=False),
        ):
            # On the inputs alone: the distribution's parameters stay out of the caller's batch.
            dist = self.actor_network.get_dist(tensordict.select(*self.actor_network.in_keys))
            action, log_prob = compute_rsample_log_prob(dist)
        return tensordict.set(self.tensor_keys.action, action), log_prob

    def sample_next(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, Tensor]:
        """Next state with one action of the policy, for the targets of reward and cost."""
        terminated = tensordict.get(("next", self.tensor_keys.terminated))
        next_state = tensordict.get("next").copy()
        for key in self.observation_keys:
            # Multiplying by (1 - terminated) keeps a NaN, so a state that is never
            # valued gives way to a finite one before it meets a network.
            mask = expand_as_right(terminated.squeeze(-1), next_state[key])
            next_state.set(key, torch.where(mask, tensordict[key], next_state[key]))
        with torch.no_grad():
            return self.sample_action(next_state)
