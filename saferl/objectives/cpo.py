"""Constrained policy optimisation (Achiam et al., 2017)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Distribution, Independent, TransformedDistribution, kl_divergence
from torchrl.objectives import PPOLoss

from saferl.objectives.advantages import CostValueKeys, CostValueMixin
from saferl.objectives.checks import check_begun, check_limit
from saferl.objectives.episodes import EpisodeCost
from saferl.objectives.trust_region import (
    CASES,
    conjugate_gradient,
    constrained_direction,
    flat,
)


def policy_kl(old: Distribution, new: Distribution) -> Tensor:
    """KL(old || new) of two policies [*B], summed over the dimensions of an action.

    A squashed Gaussian's is that of the Gaussians, as the same invertible map squashes both.
    """
    if isinstance(old, TransformedDistribution) and isinstance(new, TransformedDistribution):
        return policy_kl(old.base_dist, new.base_dist)
    if isinstance(old, Independent) and isinstance(new, Independent):
        inner = kl_divergence(old.base_dist, new.base_dist)
        return inner.flatten(inner.ndim - old.reinterpreted_batch_ndims).sum(-1)
    return kl_divergence(old, new)


@dataclass
class CPOKeys(CostValueKeys):
    """Keys that ``set_keys`` accepts beside those of :class:`~saferl.objectives.PPOLagLoss`.

    Attributes:
        is_init: whether a transition is an episode's first.
    """

    is_init: NestedKey = "is_init"


class CPOLoss(CostValueMixin, PPOLoss):
    r"""A policy's trust-region step under a cost constraint, and the losses of its two value networks.

    For a batch of fresh transitions :meth:`begin` estimates the advantages and then moves the policy:

    .. math::

        \max_x\; g^T x \quad \text{such that} \quad c + b^T x \le 0, \quad
        \tfrac12 x^T H x \le \delta

    with g and b the gradients of the mean of ratio times advantage, of reward and cost, H the Fisher matrix of
    the policy, and :math:`c = (J_c - d) / w` the violation *per decision*: g and b are means over decisions,
    and :math:`J_c(\pi') - J_c(\pi)` is to first order :math:`w = E[\sum_{t<L} \gamma^t]` times such a mean, L the
    length of an episode. :math:`J_c = E[\sum_{t<L} \gamma^t c_t]` is the discounted cost of an episode from its
    start to its end, by termination or truncation; both are means over the episodes that ended lately
    (:meth:`cost_of_policy`).

    The step is shortened by ``backtrack`` until the KL is within delta, the surrogate does not get worse (not
    asked where the step must first regain feasibility), and the cost's surrogate does not rise above its limit
    (above where it was, from an infeasible start); if none of ``search_steps`` will do, the policy stays where it was.

    :meth:`forward` gives the losses of the value networks, for mini-batches, and reports the last step.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the policy.
        critic_network (TensorDictModule): V(s); writes ``"state_value"``.
        cost_critic (TensorDictModule): V_c(s); writes ``"state_cost_value"``.

    Keyword Args:
        cost_limit (float, optional): d, bound on the discounted cost of an episode. Defaults to ``0.05``.
        trust (float, optional): delta, on the mean KL. Defaults to ``0.01``.
        cg_steps (int, optional): conjugate-gradient iterations. Defaults to ``15``.
        damping (float, optional): added to H's diagonal. Defaults to ``0.1``.
        search_steps (int, optional): how often a step is shortened at most. Defaults to ``15``.
        backtrack (float, optional): factor of each shortening. Defaults to ``0.8``.
        critic_coeff, loss_critic_type, separate_losses, reduction: as in
            :class:`~torchrl.objectives.PPOLoss`. Default here: ``loss_critic_type="l2"``.

    Reads: :meth:`begin` a whole batch ``[*B, T]`` with the policy's ``"action"`` and its log-probability, under
        ``"next"`` ``"reward"``, ``"cost"``, ``"done"``, ``"terminated"``, and ``"is_init"``
        (``torchrl.envs.InitTracker``); :meth:`forward` any part of it.
    Writes ``"loss_critic"``, ``"loss_cost"``; reports ``"kl"``, ``"cost_estimate"`` (J_c),
        ``"step_fraction"`` (0: the policy stayed), and the share of each case, ``"cpo_feasible"`` and so on.

    Raises:
        ValueError: a setting is out of range, or ``gamma`` lies outside [0, 1].
        KeyError: the batch holds no cost or no ``is_init``.

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
        >>> output = loss(batch.reshape(-1))
        >>> bool(output["kl"] <= loss.trust)
        True
    """

    _AcceptedKeys = CPOKeys
    default_keys = CPOKeys
    input_networks = ("critic_network", "cost_critic")
    input_entries = ("value_target", "cost_value_target")

    cost_limit: Tensor
    report: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModule,
        cost_critic: TensorDictModule,
        *,
        cost_limit: float = 0.05,
        trust: float = 0.01,
        cg_steps: int = 15,
        damping: float = 0.1,
        search_steps: int = 15,
        backtrack: float = 0.8,
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
        self.register_coeff_buffer("cost_limit", check_limit(cost_limit), device=device)
        self.out_keys = ["loss_critic", "loss_cost", "explained_variance", "kl", "cost_estimate"]
        self.out_keys += ["step_fraction", *(f"cpo_{name}" for name in CASES)]
        self.trust, self.cg_steps, self.damping = trust, cg_steps, damping
        self.search_steps, self.backtrack = search_steps, backtrack
        # Of the last step: KL, J_c, fraction of the step, number of the case.
        self.register_buffer("report", torch.full((4,), torch.nan, device=device))
        self.episodes = EpisodeCost().to(device)

    @torch.no_grad()
    def begin(self, tensordict: TensorDictBase) -> None:
        """Write the advantages of a batch of fresh transitions, and move the policy by one step.

        Args:
            tensordict: ``[*B, T]``; gets what :meth:`CostValueMixin.begin` writes.

        Raises:
            KeyError: no cost, or no ``is_init``.
        """
        super().begin(tensordict)
        if tensordict.get(self.tensor_keys.is_init, None) is None:
            raise KeyError(
                f"The batch has no entry {self.tensor_keys.is_init!r}, which tells where episodes begin. "
                "Append torchrl.envs.InitTracker() to the environment."
            )
        cost, weight = self.cost_of_policy(tensordict)
        self._step(tensordict.reshape(-1), (cost - self.cost_limit) / weight)
        self.report[1] = cost

    @torch.no_grad()
    def cost_of_policy(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """The discounted cost of an episode of the policy that collected a batch, and its decisions.

        Means over the episodes that ended lately (:class:`~saferl.objectives.episodes.EpisodeCost`); before
        the first end, what the running episodes have cost so far and V_c of the rest, as if they went on for ever.

        Args:
            tensordict: ``[*B, T]`` as :meth:`CostValueMixin.begin` leaves it; ``"is_init"`` (of TorchRL's
                ``InitTracker``) tells where episodes begin.

        Returns:
            Two scalars, J_c in the unit of the cost and a discounted number of decisions.
        """
        following, keys = tensordict.get("next"), self.tensor_keys
        cost, done = (following.get(key).squeeze(-1) for key in (keys.cost, keys.done))
        first = tensordict.get(keys.is_init).squeeze(-1)
        self.episodes.update(cost, first, done, self._cost_value_estimator.gamma)
        if self.episodes.count > 0:
            of_one, weight = self.episodes.mean
            return of_one.to(cost), weight.to(cost)
        with self.cost_critic_params.to_module(self.cost_critic, preserve_module_state=False):
            last = following[..., -1].select(*self.cost_critic.in_keys)
            ahead = self.cost_critic(last).get(keys.state_cost_value).squeeze(-1)
        so_far, weight, discount, _ = self.episodes.running.unbind(-1)
        discount = torch.where(done[..., -1], 0.0, discount)
        # V_c is of as many decisions as a discount lets count; without one nobody knows how many.
        gamma = float(self._cost_value_estimator.gamma)
        left = 1 / (1 - gamma) if gamma < 1 else 0.0
        total, weight = so_far + discount * ahead, weight + discount * left
        return total.mean().to(cost), weight.mean().to(cost)

    def _surrogates(
        self, batch: TensorDictBase, old: Distribution
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Means over a batch: ratio times the reward's advantage, times the cost's, and the KL from ``old``."""
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            new = self.actor_network.get_dist(batch.select(*self.actor_network.in_keys))
        action = batch.get(self.tensor_keys.action)
        ratio = (new.log_prob(action) - old.log_prob(action)).exp()
        reward, cost = (
            batch.get(key).squeeze(-1)
            for key in (self.tensor_keys.advantage, self.tensor_keys.cost_advantage)
        )
        # Centred, which changes no gradient but their variance; never divided by one another's spread.
        reward, cost = reward - reward.mean(), cost - cost.mean()
        return (ratio * reward).mean(), (ratio * cost).mean(), policy_kl(old, new).mean()

    @torch.no_grad()
    def _step(self, batch: TensorDictBase, violation: Tensor) -> None:
        parameters = [p for p in self.actor_network_params.values(True, True) if p.requires_grad]
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            old = self.actor_network.get_dist(batch.select(*self.actor_network.in_keys))

        def gradient_of(term: Tensor, create_graph: bool = False) -> Tensor:
            # A parameter that the policy does not use has none.
            return flat(
                torch.autograd.grad(
                    term,
                    parameters,
                    retain_graph=True,
                    create_graph=create_graph,
                    allow_unused=True,
                    materialize_grads=True,
                )
            )

        with torch.enable_grad():
            reward, cost, kl = self._surrogates(batch, old)
            gradient, cost_gradient = gradient_of(reward), gradient_of(cost)
            kl_gradient = gradient_of(kl, create_graph=True)

        def fisher(vector: Tensor) -> Tensor:
            with torch.enable_grad():
                return gradient_of(kl_gradient @ vector) + self.damping * vector

        direction = constrained_direction(
            gradient,
            cost_gradient,
            float(violation),
            lambda vector: conjugate_gradient(fisher, vector, self.cg_steps),
            self.trust,
        )
        self._search(batch, old, parameters, direction.step, direction.case, float(violation))

    def _search(
        self,
        batch: TensorDictBase,
        old: Distribution,
        parameters: list[Tensor],
        step: Tensor,
        case: str,
        violation: float,
    ) -> None:
        """Take the longest part of a step that keeps what it promises; none restores the policy."""
        before = [parameter.detach().clone() for parameter in parameters]
        sizes = [parameter.numel() for parameter in parameters]
        parts = [
            part.view_as(parameter)
            for part, parameter in zip(step.split(sizes), parameters, strict=True)
        ]
        reward, cost, _ = self._surrogates(batch, old)
        slack = max(-violation, 0.0)
        fraction, kl = 1.0, torch.zeros(())
        for _ in range(self.search_steps):
            for parameter, start, part in zip(parameters, before, parts, strict=True):
                parameter.data.copy_(start + fraction * part)
            new_reward, new_cost, kl = self._surrogates(batch, old)
            # Comparisons with a NaN are false, so that a step which is not finite is shortened too.
            if (
                kl <= self.trust
                and (new_reward >= reward or case in ("recoverable", "infeasible"))
                and new_cost - cost <= slack
            ):
                break
            fraction *= self.backtrack
        else:
            fraction, kl = 0.0, torch.zeros(())
            for parameter, start in zip(parameters, before, strict=True):
                parameter.data.copy_(start)
        self.report.copy_(torch.tensor([float(kl), torch.nan, fraction, float(CASES.index(case))]))

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
