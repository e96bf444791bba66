"""Correction of a risky action by normalised gradient steps on a cost critic."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class ProjectionResult:
    """What :func:`project` did, with one entry for each sample.

    Attributes:
        action: the action to execute [*B, A].
        risk_before: risk of the given action [*B].
        risk_after: risk of the returned action [*B].
        steps: number of gradient steps taken [*B], int64.
        intervened: whether the returned action differs from the given one [*B].
        feasible: whether ``risk_after <= limit`` [*B].
    """

    action: Tensor
    risk_before: Tensor
    risk_after: Tensor
    steps: Tensor
    intervened: Tensor
    feasible: Tensor


def _descent_gradient(
    action: Tensor, start: Tensor, risk: Tensor, penalty: float, low: float, high: float
) -> Tensor:
    """Gradient of the soft loss (E9), without components that point out of the box."""
    slope = None
    if risk.requires_grad:
        (slope,) = torch.autograd.grad(
            risk, action, grad_outputs=torch.ones_like(risk), allow_unused=True
        )
    gradient = action.detach() - start
    if slope is not None:
        gradient = gradient + penalty * slope
    at_high, at_low = action.detach() >= high, action.detach() <= low
    outward = (at_high & (gradient < 0)) | (at_low & (gradient > 0))
    return torch.where(outward, 0.0, gradient)


def project(
    risk_fn: Callable[[Tensor], Tensor],
    action: Tensor,
    limit: float,
    *,
    steps: int = 50,
    step_size: float = 0.02,
    penalty: float = 1.0,
    keep: str = "last",
    low: float = -1.0,
    high: float = 1.0,
) -> ProjectionResult:
    """Moves risky actions until their risk is at most ``limit`` (paper, E8 to E10).

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
        risk_fn: maps actions [*B, A] to risks [*B] or [*B, 1], each sample for itself. It must be
            differentiable in the action; its parameters receive no gradient.
        action: a_init [*B, A], in the units of ``low`` and ``high``.
        limit: d_thres, the largest allowed risk.
        steps: N_iter, the largest number of steps.
        step_size: eta, the largest move of a coordinate in a step.
        penalty: lambda_a, the weight of the excess risk against the distance to a_init.
        keep: what a sample that stays infeasible gets: ``"last"`` iterate (paper) or the
            ``"safest"``, the one of least risk, a_init included.
        low: lower end of the box, for every coordinate.
        high: upper end of the box.

    Returns:
        A :class:`ProjectionResult`, detached.

    Raises:
        ValueError: if ``steps < 0``, ``step_size <= 0``, ``penalty < 0``, ``low >= high``, ``keep``
            is unknown, ``limit`` is NaN, or the risk's shape does not fit the action's.
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
    action = action.detach()

    def evaluate(point: Tensor) -> tuple[Tensor, Tensor]:
        with torch.enable_grad():
            point = point.detach().requires_grad_()
            risk = risk_fn(point)
            if risk.shape == (*action.shape[:-1], 1):
                risk = risk.squeeze(-1)
        if risk.shape != action.shape[:-1]:
            raise ValueError(
                f"risk_fn must return a risk of shape {tuple(action.shape[:-1])} or "
                f"{(*action.shape[:-1], 1)} for actions of shape {tuple(action.shape)}, got "
                f"{tuple(risk.shape)}."
            )
        return point, risk

    point, risk = evaluate(action)
    risk_before = risk.detach()
    active = risk_before > limit
    current, count = action, torch.zeros_like(risk_before, dtype=torch.int64)
    safest, least = action, risk_before
    for _ in range(steps):
        if not active.any():
            break
        gradient = _descent_gradient(point, action, risk, penalty, low, high)
        norm = gradient.abs().amax(-1)
        # A gradient that is not finite cannot say where to go: the sample stops like at g = 0.
        active = active & (norm > 0) & norm.isfinite()
        scale = torch.where(active, step_size / norm, 0.0).unsqueeze(-1)
        moved = (current - scale * gradient).clamp(low, high)
        current = torch.where(active.unsqueeze(-1), moved, current)
        count = count + active
        point, risk = evaluate(current)
        better = active & (risk.detach() < least)
        least = torch.where(better, risk.detach(), least)
        safest = torch.where(better.unsqueeze(-1), current, safest)
        active = active & (risk.detach() > limit)

    risk_after = risk.detach()
    if keep == "safest":
        stuck = (risk_after > limit) | risk_after.isnan()
        current = torch.where(stuck.unsqueeze(-1), safest, current)
        risk_after = torch.where(stuck, least, risk_after)
    intervened = (current != action).any(-1)
    return ProjectionResult(
        current, risk_before, risk_after, count, intervened, risk_after <= limit
    )


def _check_arguments(
    limit: float, steps: int, step_size: float, penalty: float, keep: str, low: float, high: float
) -> None:
    if torch.is_inference_mode_enabled():
        raise RuntimeError("project needs gradients: use torch.no_grad, not inference_mode.")
    if math.isnan(limit):
        raise ValueError("limit must be a number, got nan.")
    if steps < 0:
        raise ValueError(f"steps must be >= 0, got {steps}.")
    if not (math.isfinite(step_size) and step_size > 0):
        raise ValueError(f"step_size must be finite and > 0, got {step_size}.")
    if not (math.isfinite(penalty) and penalty >= 0):
        raise ValueError(f"penalty must be finite and >= 0, got {penalty}.")
    if keep not in ("last", "safest"):
        raise ValueError(f"keep must be 'last' or 'safest', got {keep!r}.")
    if not low < high:
        raise ValueError(f"low must be below high, got low={low} and high={high}.")
