"""The step by which CPO moves its policy, beside the optimizer that trains the values."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

import torch
from tensordict import TensorDictBase, TensorDictParams
from torch import Tensor
from torch.distributions import Distribution

from saferl.objectives.trust_region import (
    CASES,
    Case,
    Direction,
    conjugate_gradient,
    constrained_direction,
    flat,
)


class Constrained(Protocol):
    """What the step needs of a loss; :class:`~saferl.objectives.CPOLoss` says what each is."""

    actor_network_params: TensorDictParams
    cost_limit: Tensor
    margin: Tensor
    margin_rate: float
    report: Tensor
    trust: float
    damping: float
    cg_steps: int
    search_steps: int
    backtrack: float

    def policy(self, batch: TensorDictBase) -> Distribution: ...

    def surrogates(
        self, batch: TensorDictBase, old: Distribution
    ) -> tuple[Tensor, Tensor, Tensor]: ...

    def cost_of_policy(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]: ...


class TrustRegionStep:
    r"""Moves a policy by one constrained step in its trust region (Achiam et al., 2017).

    .. math::

        \max_x\; g^T x \quad \text{such that} \quad c + b^T x \le 0, \quad
        \tfrac12 x^T H x \le \delta

    - :math:`g` and :math:`b` are the gradients of :meth:`CPOLoss.surrogates <saferl.objectives.CPOLoss.surrogates>`,
      of reward and cost.
    - :math:`H` is the Fisher matrix of the policy, damped.
    - :math:`c = (J_c - d + m) / L` is the violation *per decision*, from the cost of an episode and its decisions,
      :meth:`CPOLoss.cost_of_policy <saferl.objectives.CPOLoss.cost_of_policy>`. g and b are means over decisions, and
      :math:`J_c(\pi') - J_c(\pi)` is to first order :math:`L` times such a mean.

    The step is shortened until it keeps three promises: the KL is within :math:`\delta`; the surrogate does not get
    worse, unless the step must first regain feasibility; the cost's surrogate stays below its limit, or does not rise
    from an infeasible start. If no length keeps them the policy stays where it was.

    Args:
        loss (CPOLoss): has the policy, the surrogates and the settings; its ``report`` is written.

    Reads what the loss's ``begin`` leaves in a whole batch ``[*B, T]``: the policy's inputs and its ``"action"``
        ``[*B, T, A]``; ``"advantage"`` in the unit of the reward, ``"cost_advantage"`` in the unit of the cost,
        ``[*B, T, 1]``; what ``cost_of_policy`` reads.
    Writes the policy's parameters, in place, and ``loss.report``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from saferl.modules import (
        ...     MLPPolicyEncoder, StateValue, tanh_gaussian_actor, value_operator
        ... )
        >>> from saferl.objectives import CPOLoss, TrustRegionStep
        >>> def encoder():
        ...     return MLPPolicyEncoder(size=3, width=16)
        >>> def value(key):
        ...     return value_operator(StateValue(encoder(), 16), ["observation"], key)
        >>> actor = tanh_gaussian_actor(encoder(), 16, in_keys=["observation"])
        >>> loss = CPOLoss(actor, value("state_value"), value("state_cost_value"), cost_limit=1.0)
        >>> end = torch.zeros(4, 8, 1, dtype=torch.bool)
        >>> first = torch.arange(8).expand(4, 8)[..., None] == 0
        >>> following = {"observation": torch.randn(4, 8, 3), "done": end, "terminated": end}
        >>> following |= {"reward": torch.randn(4, 8, 1), "cost": torch.rand(4, 8, 1)}
        >>> state = {"observation": torch.randn(4, 8, 3), "is_init": first, "next": following}
        >>> data = actor(TensorDict(state, [4, 8])).detach()
        >>> loss.begin(data)
        >>> TrustRegionStep(loss).step(data)
        >>> kl, cost, fraction, case = loss.report
        >>> bool(kl <= loss.trust)
        True
    """

    def __init__(self, loss: Constrained) -> None:
        self.loss = loss

    @torch.no_grad()
    def step(self, tensordict: TensorDictBase) -> None:
        """Move the policy by a whole batch of its transitions.

        Args:
            tensordict: ``[*B, T]`` as the loss's ``begin`` leaves it.
        """
        cost, decisions = self.loss.cost_of_policy(tensordict)
        loss, excess = self.loss, cost - self.loss.cost_limit
        violation = float((excess + loss.margin) / decisions)
        loss.margin.add_(loss.margin_rate * excess).clamp_(min=0.0).clamp_(max=loss.cost_limit)
        kl, fraction, case = self.move(tensordict.reshape(-1), violation)
        self.loss.report.copy_(torch.tensor([kl, float(cost), fraction, CASES.index(case)]))

    def move(self, batch: TensorDictBase, violation: float) -> tuple[float, float, Case]:
        """Find the step, and take what the search leaves of it.

        Args:
            batch: ``[N]``.
            violation: c, in the unit of the cost per decision.

        Returns:
            The KL, the fraction of the step (both 0 where the policy stays) and the case.
        """
        with torch.no_grad():
            old = self.loss.policy(batch)
        direction = self.direction(batch, old, violation)
        return *self.search(batch, old, direction, violation), direction.case

    @property
    def policy_parameters(self) -> list[Tensor]:
        """Those that are trained."""
        return [p for p in self.loss.actor_network_params.values(True, True) if p.requires_grad]

    def direction(self, batch: TensorDictBase, old: Distribution, violation: float) -> Direction:
        """The solution of the quadratic problem.

        Args:
            batch, violation: as in :meth:`move`.
            old: the policy in the batch's states, a constant.
        """
        loss, parameters = self.loss, self.policy_parameters

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
            reward, cost, kl = loss.surrogates(batch, old)
            gradient, cost_gradient = gradient_of(reward), gradient_of(cost)
            kl_gradient = gradient_of(kl, create_graph=True)

        def fisher(vector: Tensor) -> Tensor:
            with torch.enable_grad():
                return gradient_of(kl_gradient @ vector) + loss.damping * vector

        return constrained_direction(
            gradient,
            cost_gradient,
            violation,
            lambda vector: conjugate_gradient(fisher, vector, loss.cg_steps),
            loss.trust,
        )

    @torch.no_grad()
    def search(
        self, batch: TensorDictBase, old: Distribution, direction: Direction, violation: float
    ) -> tuple[float, float]:
        """Take the longest part of a step that keeps what it promises.

        Args:
            batch, violation: as in :meth:`move`.
            old: the policy in the batch's states, a constant.
            direction: what :meth:`direction` found.

        Returns:
            The KL and the fraction of the step, both 0 where the policy stays.
        """
        loss, parameters = self.loss, self.policy_parameters
        before = flat(parameter.detach() for parameter in parameters)
        reward, cost, _ = loss.surrogates(batch, old)
        slack, fraction = max(-violation, 0.0), 1.0
        for _ in range(loss.search_steps):
            assign(parameters, before + fraction * direction.step)
            new_reward, new_cost, kl = loss.surrogates(batch, old)
            # Comparisons with a NaN are false, so that a step which is not finite is shortened too.
            if (
                kl <= loss.trust
                and (new_reward >= reward or direction.case in ("recoverable", "infeasible"))
                and new_cost - cost <= slack
            ):
                return float(kl), fraction
            fraction *= loss.backtrack
        assign(parameters, before)
        return 0.0, 0.0


@torch.no_grad()
def assign(parameters: Iterable[Tensor], vector: Tensor) -> None:
    """Write one vector into parameters, one after the other, where they lie.

    >>> weight, bias = torch.zeros(1, 2), torch.zeros(1)
    >>> assign([weight, bias], torch.tensor([1.0, 2.0, 3.0]))
    >>> weight, bias
    (tensor([[1., 2.]]), tensor([3.]))
    """
    parameters = list(parameters)
    parts = vector.split([parameter.numel() for parameter in parameters])
    for parameter, part in zip(parameters, parts, strict=True):
        parameter.copy_(part.view_as(parameter))
