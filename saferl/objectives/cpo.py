"""Constrained policy optimisation (Achiam et al., 2017)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Distribution, kl_divergence
from torchrl.objectives import PPOLoss

from saferl.objectives.advantages import CostValueKeys, CostValueMixin
from saferl.objectives.checks import check_begun, check_limit
from saferl.objectives.episodes import EpisodeCost
from saferl.objectives.policy_step import TrustRegionStep
from saferl.objectives.trust_region import CASES


@dataclass
class CPOKeys(CostValueKeys):
    """Keys that ``set_keys`` accepts beside those of :class:`~saferl.objectives.PPOLagLoss`.

    Attributes:
        is_init: whether a transition is an episode's first.
    """

    is_init: NestedKey = "is_init"


class CPOLoss(CostValueMixin, PPOLoss):
    r"""The value losses of CPO, and the terms of the step that moves its policy (Achiam et al., 2017).

    .. math::

        L_V &= E[(V(s) - G)^2], \quad L_c = E[\tfrac12 (V_c(s) - G_c)^2] \\
        \max_x\; & g^T x \quad \text{such that} \quad (J_c - d + m) / L + b^T x \le 0, \quad
        \tfrac12 x^T H x \le \delta

    with :math:`G` and :math:`G_c` the value targets, TD(lambda). The first line is :meth:`forward`, for mini-batches. The
    second is :class:`~saferl.objectives.TrustRegionStep`, once for each whole batch, after :meth:`begin`:
    ``loss.policy_step().step(data)``. The loss has what it needs: :meth:`policy`, :meth:`surrogates` (whose gradients
    are g and b), :meth:`cost_of_policy` (:math:`J_c` and :math:`L`), the margin m and the settings.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the policy.
        critic_network (TensorDictModule): V(s).
        cost_critic (TensorDictModule): V_c(s).

    Keyword Args:
        cost_limit (float, optional): d, a bound on the mean cost of an episode, undiscounted; of one cost, as the step has
            one constraint. Defaults to ``0.05``.
        trust (float, optional): delta, on the mean KL. Defaults to ``0.01``.
        cg_steps (int, optional): conjugate-gradient iterations. Defaults to ``15``.
        damping (float, optional): added to H's diagonal. Defaults to ``0.1``.
        search_steps (int, optional): how often a step is shortened at most. Defaults to ``15``.
        backtrack (float, optional): factor of each shortening. Defaults to ``0.8``.
        margin_rate (float, optional): the share of an excess :math:`J_c - d` by which every step lowers the limit that
            the following ones keep (ours); a shortage raises it again, up to d. Where b is noisy, steps along the
            boundary that it seems to have end outside, all of them. Defaults to ``0.0``, as published.
        critic_coeff, loss_critic_type, separate_losses, reduction: as in
            :class:`~torchrl.objectives.PPOLoss`. Default here: ``loss_critic_type="l2"``.

    Reads what :meth:`begin` leaves in a batch, in any batch shape ``[*B]``: the value networks' inputs;
        ``"value_target"`` in the unit of the reward and ``"cost_value_target"`` in the unit of the cost, ``[*B, 1]``.
        :meth:`begin` reads besides ``"is_init"`` ``[*B, T, 1]`` (of ``torchrl.envs.InitTracker``).
    Writes ``"loss_critic"``, ``"loss_cost"``: scalars, or ``[*B]`` without reduction; ``"explained_variance"``. Reports of
        the last step, scalars: ``"kl"`` (nats), ``"cost_estimate"`` (:math:`J_c`, in the unit of the cost),
        ``"step_fraction"`` (0: the policy stayed), and 1 for its case of ``"cpo_unconstrained"``, ``"cpo_feasible"``,
        ``"cpo_recoverable"``, ``"cpo_infeasible"``.

    Raises:
        ValueError: a setting is out of range; ``cost_limit`` is of several costs, or a batch's cost is; ``gamma`` lies outside
            [0, 1].
        KeyError: the batch holds no cost or no ``is_init``; ``begin`` has not seen it.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from saferl.modules import (
        ...     MLPPolicyEncoder, StateValue, tanh_gaussian_actor, value_operator
        ... )
        >>> from saferl.objectives import CPOLoss
        >>> def value(key):
        ...     network = StateValue(MLPPolicyEncoder(rows=3, width=16), width=16)
        ...     return value_operator(network, in_keys=("ego", "vehicles"), out_key=key)
        >>> actor = tanh_gaussian_actor(MLPPolicyEncoder(rows=3, width=16), width=16)
        >>> loss = CPOLoss(actor, value("state_value"), value("state_cost_value"), cost_limit=1.0)
        >>> state = {"ego": torch.randn(4, 8, 9), "vehicles": torch.randn(4, 8, 3, 6)}
        >>> end = torch.zeros(4, 8, 1, dtype=torch.bool)
        >>> first = end.clone()
        >>> first[:, 0] = True
        >>> following = {**state, "reward": torch.randn(4, 8, 1), "cost": torch.rand(4, 8, 1)}
        >>> batch = TensorDict(
        ...     {**state, "is_init": first, "next": {**following, "done": end, "terminated": end}},
        ...     [4, 8],
        ... )
        >>> batch = actor(batch).detach()
        >>> loss.begin(batch)
        >>> loss.policy_step().step(batch)
        >>> output = loss(batch.reshape(-1))
        >>> bool(output["kl"] <= loss.trust)
        True
    """

    _AcceptedKeys = CPOKeys
    default_keys = CPOKeys
    input_networks = ("critic_network", "cost_critic")
    input_entries = ("value_target", "cost_value_target")

    cost_limit: Tensor
    margin: Tensor
    report: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModule,
        cost_critic: TensorDictModule,
        *,
        cost_limit: float | Sequence[float] = 0.05,
        trust: float = 0.01,
        cg_steps: int = 15,
        damping: float = 0.1,
        search_steps: int = 15,
        backtrack: float = 0.8,
        margin_rate: float = 0.0,
        critic_coeff: float = 1.0,
        loss_critic_type: Literal["l1", "l2", "smooth_l1"] = "l2",
        separate_losses: bool = False,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        for name, value in (("trust", trust), ("damping", damping)):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be > 0, got {value}.")
        for name, value in (("cg_steps", cg_steps), ("search_steps", search_steps)):
            if value < 1:
                raise ValueError(f"{name} must be >= 1, got {value}.")
        if not 0 <= margin_rate <= 1:
            raise ValueError(f"margin_rate must be in [0, 1], got {margin_rate}.")
        if torch.as_tensor(cost_limit).numel() != 1:
            raise ValueError(
                f"cost_limit must be one number, as CPO's step has one constraint, got {cost_limit}: take PPOLagLoss "
                "(algo=ppo_lag) for several."
            )
        limit = check_limit("cost_limit", cost_limit, 1)
        if not 0 < backtrack < 1:
            raise ValueError(f"backtrack must be in (0, 1), got {backtrack}.")
        super().__init__(
            actor_network,
            critic_network,
            entropy_bonus=False,
            critic_coeff=critic_coeff,
            loss_critic_type=loss_critic_type,
            separate_losses=separate_losses,
            reduction=reduction,
        )
        self.add_cost_value(cost_critic)
        device = self.buffer_device
        self.register_buffer("cost_limit", limit.float().to(device))
        self.out_keys = ["loss_critic", "loss_cost", "explained_variance", "kl", "cost_estimate"]
        self.out_keys += ["step_fraction", *(f"cpo_{name}" for name in CASES)]
        self.trust, self.cg_steps, self.damping = trust, cg_steps, damping
        self.search_steps, self.backtrack = search_steps, backtrack
        self.margin_rate = margin_rate
        self.register_buffer("margin", torch.zeros_like(self.cost_limit))
        # Of the last step, which writes it: KL, J_c, fraction of the step, number of the case.
        self.register_buffer("report", torch.full((4,), torch.nan, device=device))
        self.episodes = EpisodeCost().to(device)

    def begin(self, tensordict: TensorDictBase) -> None:
        """As :meth:`CostValueMixin.begin`; says besides what the step will miss.

        Args:
            tensordict: ``[*B, T]``.

        Raises:
            KeyError: the batch holds no cost, or no ``is_init``.
        """
        super().begin(tensordict)
        if tensordict.get(self.tensor_keys.is_init, None) is None:
            raise KeyError(
                f"The batch has no entry {self.tensor_keys.is_init!r}, which tells where episodes begin. "
                "Append torchrl.envs.InitTracker() to the environment."
            )

    def policy_step(self) -> TrustRegionStep:
        """What moves the policy: an object whose ``step`` takes a whole batch, after :meth:`begin`."""
        return TrustRegionStep(self)

    @torch.no_grad()
    def cost_of_policy(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """The cost of an episode of the policy that collected a batch, and its decisions.

        Means over the episodes that ended lately (:class:`~saferl.objectives.episodes.EpisodeCost`); before
        the first end, what the running episodes have cost so far and V_c of the rest, as if they went on for ever.

        Args:
            tensordict: ``[*B, T]`` as :meth:`CostValueMixin.begin` leaves it; ``"is_init"`` (of TorchRL's
                ``InitTracker``) tells where episodes begin.

        Returns:
            Two scalars, J_c in the unit of the cost and a number of decisions.
        """
        following, keys = tensordict.get("next"), self.tensor_keys
        cost, done = (following.get(key).squeeze(-1) for key in (keys.cost, keys.done))
        self.episodes.update(cost, tensordict.get(keys.is_init).squeeze(-1), done)
        if self.episodes.count > 0:
            of_one, decisions = self.episodes.mean
            return of_one.to(cost), decisions.to(cost)
        with self.cost_critic_params.to_module(self.cost_critic, preserve_module_state=False):
            last = following[..., -1].select(*self.cost_critic.in_keys)
            ahead = self.cost_critic(last).get(keys.state_cost_value).squeeze(-1)
        so_far, decisions, _ = self.episodes.running.unbind(-1)
        # V_c is of as many decisions as a discount lets count; without one nobody knows how many.
        gamma = float(self._cost_value_estimator.gamma)
        left = torch.where(done[..., -1], 0.0, 1.0)
        total = so_far + left * ahead
        decisions = decisions + (left / (1 - gamma) if gamma < 1 else 0.0)
        return total.mean().to(cost), decisions.mean().to(cost)

    def policy(self, batch: TensorDictBase) -> Distribution:
        """The distribution of actions ``[*B, A]`` in the states of a batch ``[*B]``."""
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            return self.actor_network.get_dist(batch.select(*self.actor_network.in_keys))

    def surrogates(self, batch: TensorDictBase, old: Distribution) -> tuple[Tensor, Tensor, Tensor]:
        r"""Means over a batch, with the policy as it is now.

        .. math::

            E[\rho (A_r - \bar A_r)], \quad E[\rho (A_c - \bar A_c)], \quad E[\mathrm{KL}(\pi_{old} \| \pi)]

        with :math:`\rho` the ratio of its probability to that of ``old``.

        Args:
            batch: ``[*B]``.
            old: the policy in its states, a constant.

        Returns:
            Three scalars, in the units of reward and cost, and in nats.
        """
        new, action = self.policy(batch), batch.get(self.tensor_keys.action)
        ratio = (new.log_prob(action) - old.log_prob(action)).exp()
        reward, cost = (
            batch.get(key).squeeze(-1)
            for key in (self.tensor_keys.advantage, self.tensor_keys.cost_advantage)
        )
        # Centred, which changes no gradient but their variance; never divided by one another's spread.
        reward, cost = reward - reward.mean(), cost - cost.mean()
        return (ratio * reward).mean(), (ratio * cost).mean(), kl_divergence(old, new).mean()

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        check_begun(tensordict, self.tensor_keys.value_target)
        tensordict = tensordict.clone(False)
        loss_critic, _, explained = self.loss_critic(tensordict)
        kl, cost, fraction, case = self.report.clone().unbind()
        out = TensorDict(
            {
                "loss_critic": self.reduced(loss_critic, tensordict).squeeze(-1),
                "loss_cost": self.cost_loss(tensordict),
                "explained_variance": explained,
                "kl": kl,
                "cost_estimate": cost,
                "step_fraction": fraction,
                **{f"cpo_{name}": (case == i).float() for i, name in enumerate(CASES)},
            }
        )
        self.release(
            tensordict,
            out,
            "actor_network_params",
            "critic_network_params",
            "target_actor_network_params",
            "target_critic_network_params",
            "cost_critic_params",
            "target_cost_critic_params",
        )
        return out
