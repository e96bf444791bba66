"""The solver of a trust-region step under a linearised cost constraint (Achiam et al., 2017)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

#: What a step did, in the order of their numbers in the records.
Case = Literal["unconstrained", "feasible", "recoverable", "infeasible"]
CASES: tuple[Case, ...] = get_args(Case)


def flat(tensors: Iterable[Tensor]) -> Tensor:
    """Tensors one after the other as one vector."""
    return torch.cat([tensor.reshape(-1) for tensor in tensors])


def conjugate_gradient(
    product: Callable[[Tensor], Tensor], target: Tensor, steps: int = 15, tolerance: float = 1e-14
) -> Tensor:
    """Solve H x = target for a symmetric positive definite H that is known by its products.

    Args:
        product: v [n] -> H v [n].
        target: [n].
        steps: at most so many; n of them are exact but for rounding.
        tolerance: on the squared residual, relative to that of x = 0.

    >>> H = torch.tensor([[2.0, 0.5], [0.5, 1.0]], dtype=torch.float64)
    >>> x = conjugate_gradient(lambda v: H @ v, torch.tensor([1.0, 2.0], dtype=torch.float64))
    >>> [round(value, 6) for value in (H @ x).tolist()]
    [1.0, 2.0]
    """
    solution = torch.zeros_like(target)
    residual, direction = target.clone(), target.clone()
    squared = start = residual @ residual
    for _ in range(steps):
        if squared <= tolerance * start:
            break
        image = product(direction)
        step = squared / (direction @ image)
        solution = solution + step * direction
        residual = residual - step * image
        squared, before = residual @ residual, squared
        direction = residual + squared / before * direction
    return solution


@dataclass(frozen=True)
class Direction:
    """What :func:`constrained_direction` found.

    Attributes:
        step: x [n].
        case: one of :data:`CASES`.
        reward_multiplier, cost_multiplier: the dual variables, 0 where a constraint plays no part.
    """

    step: Tensor
    case: Case
    reward_multiplier: float
    cost_multiplier: float


def constrained_direction(
    gradient: Tensor,
    cost_gradient: Tensor,
    violation: float,
    solve: Callable[[Tensor], Tensor],
    trust: float,
) -> Direction:
    r"""The step of CPO: maximise g x such that c + b x <= 0 and x H x / 2 <= delta.

    Its cases, with q = g H^-1 g, r = g H^-1 b, s = b H^-1 b (Achiam et al., 2017, theorem 2):

    - ``unconstrained``: the whole trust region satisfies the constraint (c < 0, c^2 / s > 2 delta), or no
      direction changes the cost; the step is TRPO's, sqrt(2 delta / q) H^-1 g.
    - ``feasible``, ``recoverable``: the constraint's boundary meets the trust region, and the policy is on its
      right (c <= 0) or wrong side; x = (H^-1 g - nu H^-1 b) / lambda with the multipliers that solve the dual.
    - ``infeasible``: no step in the trust region satisfies the constraint; x = -sqrt(2 delta / s) H^-1 b
      lowers the cost as far as the region allows.

    Args:
        gradient: g [n], of the objective that is maximised.
        cost_gradient: b [n], of the cost.
        violation: c, cost minus its limit, in the unit of b x.
        solve: v -> H^-1 v.
        trust: delta > 0.

    Raises:
        ValueError: ``trust`` is not positive.

    >>> g, b = torch.tensor([1.0, 0.0]), torch.tensor([1.0, 0.0])
    >>> constrained_direction(g, b, -0.1, lambda v: v, trust=0.5).step  # the boundary, not the region's
    tensor([0.1000, 0.0000])
    """
    if not trust > 0:
        raise ValueError(f"trust must be > 0, got {trust}.")
    c, on_reward, on_cost = float(violation), solve(gradient), solve(cost_gradient)
    q, r, s = (
        float(left @ right)
        for left, right in (
            (gradient, on_reward),
            (cost_gradient, on_reward),
            (cost_gradient, on_cost),
        )
    )
    tiny = torch.finfo(gradient.dtype).tiny
    whole = max(2 * trust - c * c / s, 0.0) if s > tiny else 0.0  # B of the paper
    if s <= tiny or (c < 0 and whole == 0.0):
        scale = (2 * trust / q) ** 0.5 if q > tiny else 0.0
        return Direction(scale * on_reward, "unconstrained", 1 / scale if scale else 0.0, 0.0)
    if c > 0 and whole == 0.0:
        return Direction(-((2 * trust / s) ** 0.5) * on_cost, "infeasible", 0.0, 0.0)

    across = max(q - r * r / s, 0.0)  # A: what of g lies along the boundary

    def on_boundary(x: float) -> float:
        return -0.5 * (across / x + whole * x) + r * c / s

    def inside(x: float) -> float:
        return -0.5 * (q / x + 2 * trust * x)

    # The dual is on_boundary where nu = (x c + r) / s > 0, and inside elsewhere; each is concave.
    edge = max(-r / c, 0.0) if c else 0.0
    if c > 0:
        ranges = {on_boundary: (edge, torch.inf), inside: (0.0, edge)}
    elif c < 0:
        ranges = {on_boundary: (0.0, edge), inside: (edge, torch.inf)}
    else:
        ranges = {on_boundary if r > 0 else inside: (0.0, torch.inf)}
    peaks = {
        on_boundary: (across / whole) ** 0.5 if whole > 0 else torch.inf,
        inside: (q / (2 * trust)) ** 0.5,
    }
    best = {
        dual: min(max(peaks[dual], low, tiny), high)
        for dual, (low, high) in ranges.items()
        if low < high
    }
    dual, x = max(best.items(), key=lambda item: item[0](item[1]))
    case = "feasible" if c <= 0 else "recoverable"
    if dual is inside:
        return Direction(on_reward / x, case, x, 0.0)
    # To the boundary, and along it: (H^-1 g - nu H^-1 b) / x without a difference of large numbers.
    along = on_reward - (r / s) * on_cost if across > 1e-12 * q else torch.zeros_like(on_reward)
    return Direction(along / x - (c / s) * on_cost, case, x, (x * c + r) / s)
