"""Correction of a risky action by normalised gradient steps on a cost critic."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from saferl.modules.compiled import Compiled
from saferl.modules.ensemble import BoundCritics

#: Steps between two looks at whether any sample still moves, in compiled code.
_TOGETHER = 5


@dataclass(frozen=True)
class ProjectionResult:
    """What :func:`project` did, with one entry for each sample.

    Attributes:
        action: the action to execute [*B, A].
        risk_before: risk of the given action [*B]; of several costs their risks [*B, K].
        risk_after: risk of the returned action, likewise.
        steps: number of gradient steps taken [*B], int64.
        intervened: whether the returned action differs from the given one [*B].
        feasible: whether ``risk_after <= limit``, of every cost [*B].
    """

    action: Tensor
    risk_before: Tensor
    risk_after: Tensor
    steps: Tensor
    intervened: Tensor
    feasible: Tensor


class Descent(NamedTuple):
    """Where each sample stands; all but the actions [*B, A] and the risks [*B, K] are [*B]."""

    action: Tensor
    slope: Tensor  # of the worst risk there
    risk: Tensor
    active: Tensor
    steps: Tensor
    safest: Tensor
    least: Tensor  # the risk of the safest action

    @classmethod
    def begin(
        cls, action: Tensor, slope: Tensor, risk: Tensor, limit: Tensor, shift: Tensor
    ) -> Descent:
        """Before the first step, from the risks of the given action and the gradient of the worst."""
        risky = worst(risk, shift) > limit
        none = torch.zeros_like(risky, dtype=torch.int64)
        return cls(action, slope, risk, risky, none, action, risk)

    def end(self, limit: Tensor, shift: Tensor, keep: str) -> tuple[Tensor, Tensor, Tensor]:
        """The action to execute, its risks, and whether they are within their limits."""
        action, risk = self.action, self.risk
        if keep == "safest":
            stuck = ~(worst(risk, shift) <= limit).unsqueeze(-1)  # NaN, too
            action = torch.where(stuck, self.safest, action)
            risk = torch.where(stuck, self.least, risk)
        return action, risk, worst(risk, shift) <= limit


def thresholds(limit: float | Sequence[float] | Tensor, like: Tensor) -> tuple[Tensor, Tensor]:
    """The least of K limits, and ``shift`` [K], how much that is below each: added to the risks, one limit serves all."""
    limits = torch.as_tensor(limit, dtype=torch.float64).to(like).reshape(-1)
    least = limits.amin()
    return least, torch.where(
        limits == least, 0.0, least - limits
    )  # an infinite one limits nothing


def worst(risk: Tensor, shift: Tensor) -> Tensor:
    """The risk [*B] that exceeds its limit most, as if all had the least one."""
    return (risk + shift).amax(-1)


def evaluate(
    risk_fn: Callable[[Tensor], Tensor], action: Tensor, shift: Tensor
) -> tuple[Tensor, Tensor]:
    """Risks [*B, K] of each action, and the gradient [*B, A] of the worst."""
    count = len(shift)
    with torch.enable_grad():
        action = action.detach().requires_grad_()
        risk = risk_fn(action)
        if risk.shape == action.shape[:-1]:
            risk = risk.unsqueeze(-1)
        if risk.shape != (*action.shape[:-1], count):
            raise ValueError(
                f"risk_fn must return a risk of shape {tuple(action.shape[:-1])} or "
                f"{(*action.shape[:-1], count)} for actions of shape {tuple(action.shape)}, got "
                f"{tuple(risk.shape)}."
            )
        if not risk.requires_grad:  # no action changes it
            return risk, torch.zeros_like(action)
        most = worst(risk, shift).sum()
        (slope,) = torch.autograd.grad(most, action, materialize_grads=True)
    return risk.detach(), slope


def descend(
    risk_fn: Callable[[Tensor], Tensor],
    at: Descent,
    start: Tensor,
    limit: Tensor,
    shift: Tensor,
    steps: int,
    step_size: float,
    penalty: float,
    low: float | Tensor,
    high: float | Tensor,
) -> Descent:
    """Up to ``steps`` steps of the samples that are still active."""
    for _ in range(steps):
        # The gradient of the soft loss (E9), without components that point out of the box.
        gradient = at.action - start + penalty * at.slope
        outward = ((at.action >= high) & (gradient < 0)) | ((at.action <= low) & (gradient > 0))
        gradient = torch.where(outward, 0.0, gradient)
        norm = gradient.abs().amax(-1)
        # A gradient that is not finite cannot say where to go: the sample stops like at g = 0.
        active = at.active & (norm > 0) & (norm < torch.inf)
        scale = torch.where(active, step_size / norm, 0.0).unsqueeze(-1)
        moved = (at.action - scale * gradient).clamp(low, high)  # pyright: ignore
        action = torch.where(active.unsqueeze(-1), moved, at.action)
        risk, slope = evaluate(risk_fn, action, shift)
        most = worst(risk, shift)
        better = active & (most < worst(at.least, shift))
        at = Descent(
            action=action,
            slope=slope,
            risk=risk,
            active=active & (most > limit),
            steps=at.steps + active,
            safest=torch.where(better.unsqueeze(-1), action, at.safest),
            least=torch.where(better.unsqueeze(-1), risk, at.least),
        )
    return at


_compiled_evaluate = Compiled(evaluate, "the risk and its gradient", replay=False)
_compiled_descend = Compiled(descend, "the projection", replay=False)


def project(
    risk_fn: Callable[[Tensor], Tensor],
    action: Tensor,
    limit: float | Tensor,
    *,
    steps: int = 50,
    step_size: float = 0.02,
    penalty: float = 1.0,
    keep: str = "last",
    low: float | Tensor = -1.0,
    high: float | Tensor = 1.0,
    compile: bool = False,
) -> ProjectionResult:
    """Moves risky actions until their risk is at most ``limit`` (paper, E8 to E10).

    Of several costs the risk is that which exceeds its limit most: at each step another one may be.

    Each sample whose risk exceeds ``limit`` takes up to ``steps`` steps

        a <- clip(a - step_size / ||g||_inf * g, low, high),
        g = a - a_init + penalty * dQ_c/da, the gradient of E8's soft loss,

    and stops as soon as it is feasible, or where g = 0. Components of g that would push a
    coordinate out of the box are dropped before the normalisation, so that a coordinate on the edge
    does not hold back the others (clip, units and this rule are ours). Samples whose risk is within
    the limit, or NaN, are returned bit for bit.

    **Which penalty reaches the limit.** For a risk that is linear or an isotropic quadratic the
    path is the straight line to the closest feasible action a*, and the result is within
    ``step_size`` of a* (inf-norm) if a* is in the box, at most ``steps * step_size`` from a_init,
    and

        penalty > mu* = ||a* - a_init||_2 / ||dQ_c/da(a*)||_2,

    the Lagrange multiplier of the projection (with a linear risk, violation / ||dQ_c/da||^2). With
    a smaller penalty the distance term balances the risk before a* is reached, and the action
    swings about that infeasible point until ``steps`` is used up. Under an anisotropic risk the
    path bends towards the steepest descent: feasible, but farther from a_init than a*.

    Args:
        risk_fn: maps actions [*B, A] to risks [*B] or [*B, 1] ([*B, K] of several costs), each sample for itself. It must
            be differentiable by autograd; its parameters receive no gradient.
        action: a_init [*B, A], in the units of ``low`` and ``high``.
        limit: d_thres, the largest allowed risk; of several costs a tensor [K].
        steps: N_iter, the largest number of steps.
        step_size: eta, the largest move of a coordinate in a step.
        penalty: lambda_a, the weight of the excess risk against the distance to a_init.
        keep: what a sample that stays infeasible gets: ``"last"`` iterate (paper) or the
            ``"safest"``, the one of least risk, a_init included.
        low: lower end of the box, of all coordinates or of each [A].
        high: upper end of the box, likewise.
        compile: whether to compile the steps, several of them into one function, anew for each shape of
            ``action`` and each setting. The risk is then :class:`BoundCritics`, whose tensors the compiled code
            is given. The result is the same up to rounding.

    Returns:
        A :class:`ProjectionResult`, detached.

    Raises:
        ValueError: if ``steps < 0``, ``step_size <= 0``, ``penalty < 0``, ``low >= high``, ``keep``
            is unknown, ``limit`` is a number and NaN (a tensor is not looked at), ``compile`` is set for another risk, or the risk's shape does not
            fit the action's.
        RuntimeError: in inference mode, where nothing can be differentiated.

    Examples:
        >>> import torch
        >>> from saferl.modules import project
        >>> result = project(lambda a: a[..., 0], torch.tensor([[0.5, 0.3], [0.1, 0.3]]), 0.21)
        >>> result.action, result.steps
        (tensor([[0.2000, 0.3000],
                [0.1000, 0.3000]]), tensor([15,  0]))
    """
    _check_arguments(limit, steps, step_size, penalty, keep, low, high)
    start = action.detach()
    least, shift = thresholds(limit, start)
    look, step, together = evaluate, descend, 1
    if compile:
        if not isinstance(risk_fn, BoundCritics):
            raise ValueError(f"compile=True needs BoundCritics as risk_fn, got {risk_fn!r}.")
        look, step, together = _compiled_evaluate, _compiled_descend, _TOGETHER
    risk_before, slope = look(risk_fn, start, shift)
    at = Descent.begin(start, slope, risk_before, least, shift)
    for done in range(0, steps, together):
        # To ask a GPU would be to wait for it.
        if start.device.type == "cpu" and not at.active.any():
            break
        count = min(together, steps - done)
        at = step(risk_fn, at, start, least, shift, count, step_size, penalty, low, high)

    current, risk_after, feasible = at.end(least, shift, keep)
    intervened = (current != start).any(-1)
    risks = risk_before.squeeze(-1), risk_after.squeeze(-1)
    return ProjectionResult(current, *risks, at.steps, intervened, feasible)


def _check_arguments(
    limit: float | Tensor,
    steps: int,
    step_size: float,
    penalty: float,
    keep: str,
    low: float | Tensor,
    high: float | Tensor,
) -> None:
    if torch.is_inference_mode_enabled():
        raise RuntimeError("project needs gradients: use torch.no_grad, not inference_mode.")
    if not isinstance(limit, Tensor) and math.isnan(limit):  # to ask a GPU would be to wait for it
        raise ValueError("limit must be a number, got nan.")
    if steps < 0:
        raise ValueError(f"steps must be >= 0, got {steps}.")
    if not (math.isfinite(step_size) and step_size > 0):
        raise ValueError(f"step_size must be finite and > 0, got {step_size}.")
    if not (math.isfinite(penalty) and penalty >= 0):
        raise ValueError(f"penalty must be finite and >= 0, got {penalty}.")
    if keep not in ("last", "safest"):
        raise ValueError(f"keep must be 'last' or 'safest', got {keep!r}.")
    if not torch.as_tensor(low < high).all():
        raise ValueError(f"low must be below high, got low={low} and high={high}.")
