"""The trust-region solver against a general one, and against dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from saferl.objectives.trust_region import CASES, conjugate_gradient, constrained_direction, flat

SIZE = 6


def problem(seed: int):
    """H positive definite, g and b."""
    torch.manual_seed(seed)
    root = torch.randn(SIZE, SIZE, dtype=torch.float64)
    H = root @ root.T + 0.5 * torch.eye(SIZE, dtype=torch.float64)
    return H, torch.randn(SIZE, dtype=torch.float64), torch.randn(SIZE, dtype=torch.float64)


def by_slsqp(H, g, b, c, trust):
    """Maximise g x over the trust region and, where it can be met, the constraint."""
    H, g, b = (tensor.numpy() for tensor in (H, g, b))
    inside = {
        "type": "ineq",
        "fun": lambda x: trust - 0.5 * x @ H @ x,
        "jac": lambda x: -(H @ x),
    }
    safe = {"type": "ineq", "fun": lambda x: -c - b @ x, "jac": lambda x: -b}
    options = {"maxiter": 1000, "ftol": 1e-16}
    # From the point of the region with the lowest cost, which satisfies all that can be satisfied.
    lowest = -np.sqrt(2 * trust / (b @ np.linalg.solve(H, b))) * np.linalg.solve(H, b)
    if c + b @ lowest > 0:
        return lowest
    scale = np.linalg.norm(g)
    result = minimize(
        lambda x: -g @ x / scale,
        0.9 * lowest if c + 0.9 * b @ lowest <= 0 else lowest,
        jac=lambda x: -g / scale,
        constraints=[inside, safe],
        method="SLSQP",
        options=options,
    )
    return result.x


def edges(H, b, trust):
    """The violation beyond which the region and the constraint's boundary do not meet."""
    return float((2 * trust * (b @ torch.linalg.solve(H, b))).sqrt())


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(
    "share, case",
    [
        (-1.5, "unconstrained"), (-0.7, "feasible"), (-0.05, "feasible"), (0.0, "feasible"),
        (0.05, "recoverable"), (0.6, "recoverable"), (0.95, "recoverable"), (1.2, "infeasible"),
    ],
)  # fmt: skip
def test_direction_is_the_optimum(seed: int, share: float, case: str):
    H, g, b = problem(seed)
    for trust in (0.01, 0.5):
        c = share * edges(H, b, trust)
        ours = constrained_direction(g, b, c, lambda v: torch.linalg.solve(H, v), trust)
        assert ours.case == case
        theirs = by_slsqp(H, g, b, c, trust)
        np.testing.assert_allclose(ours.step.numpy(), theirs, atol=2e-5 * np.abs(theirs).max())


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("share", [-1.5, -0.7, -0.05, 0.0, 0.05, 0.6, 0.95])
def test_direction_satisfies_the_optimality_conditions(seed: int, share: float):
    """Stationarity, feasibility and complementarity, which are sufficient: the problem is convex."""
    H, g, b = problem(100 + seed)
    trust = 0.02
    c = share * edges(H, b, trust)
    found = constrained_direction(g, b, c, lambda v: torch.linalg.solve(H, v), trust)
    x, strength, nu = found.step, found.reward_multiplier, found.cost_multiplier
    torch.testing.assert_close(strength * (H @ x), g - nu * b, rtol=1e-8, atol=1e-8)
    assert 0.5 * x @ H @ x <= trust * (1 + 1e-9) and c + b @ x <= 1e-9
    assert strength >= 0 and nu >= 0
    assert abs(strength * (0.5 * x @ H @ x - trust)) < 1e-8 and abs(nu * (c + b @ x)) < 1e-8


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("c", [-0.05, 0.0, 0.05])
def test_parallel_gradients(sign: float, c: float):
    """Where the reward can only grow with the cost, the step ends on the constraint; else on the region."""
    b = torch.tensor([2.0, 0.0], dtype=torch.float64)
    found = constrained_direction(sign * b, b, c, lambda v: v, trust=0.5)
    expected = -c / 2.0 if sign > 0 else -1.0
    torch.testing.assert_close(found.step, torch.tensor([expected, 0.0], dtype=torch.float64))


def test_no_gradient_of_the_cost_is_a_plain_trust_region_step():
    H, g, _ = problem(0)
    for c in (-0.1, 0.0, 0.1):
        found = constrained_direction(
            g, torch.zeros_like(g), c, lambda v: torch.linalg.solve(H, v), 0.02
        )
        x = torch.linalg.solve(H, g)
        torch.testing.assert_close(found.step, (0.04 / (g @ x)).sqrt() * x)
        assert found.case == "unconstrained"


def test_no_gradient_at_all_is_no_step():
    zero = torch.zeros(3, dtype=torch.float64)
    assert (constrained_direction(zero, zero, -0.1, lambda v: v, 0.01).step == 0).all()


def test_every_case_is_named():
    assert CASES == ("unconstrained", "feasible", "recoverable", "infeasible")
    with pytest.raises(ValueError, match=r"trust must be > 0, got 0"):
        constrained_direction(torch.ones(1), torch.ones(1), 0.0, lambda v: v, 0.0)


@pytest.mark.parametrize("seed", range(4))
def test_conjugate_gradient_solves(seed: int):
    H, g, _ = problem(seed)
    solution = conjugate_gradient(lambda v: H @ v, g, steps=3 * SIZE, tolerance=1e-24)
    torch.testing.assert_close(solution, torch.linalg.solve(H, g), rtol=1e-8, atol=1e-8)
    assert (conjugate_gradient(lambda v: H @ v, torch.zeros_like(g)) == 0).all()


def test_flat_keeps_the_order():
    assert flat([torch.tensor([[1, 2]]), torch.tensor(3)]).tolist() == [1, 2, 3]
