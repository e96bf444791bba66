"""Constraints as terminations (Chane-Sane et al., 2024)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import ClipPPOLoss, PPOLoss, ValueEstimators
from torchrl.objectives.value.functional import generalized_advantage_estimate

from saferl.objectives.advantages import score_actions
from saferl.objectives.checks import check_begun, check_cost, check_gamma, check_limit
from saferl.objectives.values import critic_values


@dataclass
class CaTKeys(PPOLoss._AcceptedKeys):
    """Keys that ``set_keys`` accepts beside those of :class:`~torchrl.objectives.PPOLoss`.

    Attributes:
        cost: the cost under ``"next"``.
    """

    cost: NestedKey = "cost"


class CaTLoss(ClipPPOLoss):
    r"""Clipped PPO to which a violated constraint is the end of an episode, with a probability (CaT).

    .. math::

        \delta_t = p \max_i \mathrm{clip}\Big(\frac{(c_{i,t} - d_i)^+}{c_i^{max}}, 0, 1\Big), \quad
        \max_\pi E\Big[\sum_t \Big(\prod_{k \le t} \gamma (1 - \delta_k)\Big) (r_t + b)\Big]

    Chane-Sane et al., `arXiv 2403.18765 <https://arxiv.org/abs/2403.18765>`_, (3) and (4). Nothing ends: the environment goes on, and
    advantages and value targets are those of the expectation over the terminations. :math:`c_i^{max}` follows the largest
    violation of each batch. The limits are on the cost of each step. A step that costs more costs the policy a share of what
    it would earn from there on, which is no promise of a mean.

    An end takes away what was to come, so that it deters only where that is positive: rewards that are not want a bonus
    :math:`b` that makes them so (the paper clips them at 0).

    Args:
        actor_network (ProbabilisticTensorDictSequential): the policy.
        critic_network (TensorDictModule): V(s), of rewards and bonuses until a termination.

    Keyword Args:
        step_limit (float or list, optional): d, on the cost of a step, one for each of K costs. Defaults to ``0.0``.
        probability (float, optional): p, of the largest violation; 1 for limits that are to be kept by all means.
            Defaults to ``0.25``.
        memory (float, optional): the weight of :math:`c^{max}` against the largest violation of a new batch. Defaults to
            ``0.95``.
        bonus (float, optional): b, in the unit of the (scaled) reward. Defaults to ``0.0``.
        clip_epsilon, entropy_bonus, entropy_coeff, critic_coeff, clip_value, loss_critic_type, normalize_advantage,
            separate_losses, reduction: as in :class:`~torchrl.objectives.ClipPPOLoss`. Defaults here:
            ``entropy_bonus=False``, ``loss_critic_type="l2"``, ``normalize_advantage=True``.

    Reads what :class:`~torchrl.objectives.ClipPPOLoss` does, once :meth:`begin` has seen the batch.
    Writes what :class:`~torchrl.objectives.ClipPPOLoss` does, and ``"termination"``, the mean :math:`\delta` of the last batch.

    Raises:
        ValueError: a setting is out of range; a batch has another number of costs than there are limits.
        KeyError: the batch holds no cost; ``begin`` has not seen it.

    Examples:
        >>> import torch
        >>> from saferl.modules import (
        ...     MLPPolicyEncoder, StateValue, tanh_gaussian_actor, value_operator
        ... )
        >>> from saferl.objectives import CaTLoss
        >>> encoder = MLPPolicyEncoder(size=3, width=16)
        >>> actor = tanh_gaussian_actor(encoder, 16, 2, in_keys=["observation"])
        >>> critic = value_operator(StateValue(encoder, 16), ["observation"], "state_value")
        >>> loss = CaTLoss(actor, critic, step_limit=1.0, probability=0.5)
        >>> loss.terminations(torch.tensor([[0.5], [2.0], [3.0]]))
        tensor([[0.0000],
                [0.2500],
                [0.5000]])
    """

    _AcceptedKeys = CaTKeys
    default_keys = CaTKeys
    SUPPORTED_VALUE_ESTIMATORS = (ValueEstimators.GAE,)  # the recursion is written out here

    step_limit: Tensor
    largest: Tensor
    termination: Tensor
    actor_network: ProbabilisticTensorDictSequential

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModule,
        *,
        step_limit: float | Sequence[float] = 0.0,
        probability: float = 0.25,
        memory: float = 0.95,
        bonus: float = 0.0,
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
        for name, value in (("probability", probability), ("memory", memory)):
            if not 0 <= value <= 1:
                raise ValueError(f"{name} must be in [0, 1], got {value}.")
        if not clip_epsilon > 0:
            raise ValueError(f"clip_epsilon must be > 0, got {clip_epsilon}.")
        if not math.isfinite(bonus):
            raise ValueError(f"bonus must be a number, got {bonus}.")
        limit = check_limit("step_limit", step_limit, torch.as_tensor(step_limit).numel())
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
        self.probability, self.memory, self.bonus = probability, memory, bonus
        self.register_buffer("step_limit", limit)
        self.register_buffer("largest", torch.zeros_like(limit))
        self.register_buffer("termination", torch.zeros(()))
        self.out_keys = [*self.out_keys, "termination"]
        _ = self.value_estimator  # asked for now, so that a fresh loss loads a state_dict strictly

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> None:
        """As in TorchRL's losses; ValueError if ``gamma`` lies outside [0, 1]."""
        check_gamma(hyperparams)
        super().make_value_estimator(value_type, **hyperparams)

    @torch.no_grad()
    def terminations(self, cost: Tensor) -> Tensor:
        """The probability ``[*B, 1]`` that each step ends its episode; moves :math:`c^{max}` first.

        Args:
            cost: ``[*B, K]``, of a batch.
        """
        violation = F.relu(cost - self.step_limit.to(cost))
        most = violation.flatten(0, -2).amax(0).reshape(self.largest.shape).to(self.largest)
        kept = torch.where(self.largest > 0, self.memory, 0.0)
        self.largest.copy_(kept * self.largest + (1.0 - kept) * most)
        share = (violation / self.largest.to(cost).clamp(min=1e-12)).clamp(max=1.0)
        return self.probability * share.amax(-1, keepdim=True)

    @torch.no_grad()
    def begin(self, tensordict: TensorDictBase) -> None:
        """Write the advantages and value targets of a batch of fresh transitions, before it is cut into mini-batches.

        Args:
            tensordict: ``[*B, T]``.

        Reads the critic's inputs at the root and under ``"next"``; under ``"next"``: ``"reward"`` ``[*B, T, 1]``, ``"cost"``
            ``[*B, T, K]``, ``"done"``, ``"terminated"`` ``[*B, T, 1]``.
        Writes ``"action_log_prob"`` anew, see :func:`~saferl.objectives.advantages.score_actions`; ``"advantage"`` and
            ``"value_target"`` in the unit of the reward ``[*B, T, 1]``.

        Raises:
            KeyError: the batch holds no cost.
            ValueError: it holds another number of costs than there are limits.
        """
        keys, following = self.tensor_keys, tensordict.get("next")
        check_cost(tensordict, keys.cost, self.step_limit.numel())  # pyright: ignore
        score_actions(self, tensordict)
        value, ahead = (critic_values(self, "critic_network", td) for td in (tensordict, following))
        ends = self.terminations(following.get(keys.cost)).to(value)  # pyright: ignore
        self.termination.copy_(ends.mean())
        estimator: Any = self.value_estimator
        advantage, target = generalized_advantage_estimate(
            estimator.gamma.to(value) * (1.0 - ends),
            estimator.lmbda.to(value),
            value,
            ahead,
            (following.get(keys.reward) + self.bonus) * (1.0 - ends),
            following.get(keys.done),
            following.get(keys.terminated),
        )
        tensordict.set(keys.advantage, advantage)
        tensordict.set(keys.value_target, target)

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        check_begun(tensordict, self.tensor_keys.advantage)
        out = super().forward(tensordict)
        out.set("termination", self.termination.clone())
        return out
