"""The projection against optima in closed form."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from saferl.modules import MLPValue, project, value_operator

ETA, STEPS = 0.02, 50
REACH = ETA * STEPS
random_cases = settings(deadline=None, max_examples=60, database=None)

penalties = st.sampled_from([0.3, 1.0, 10.0, 100.0])
# mu* / penalty: the multiplier of the projection as a share of the penalty, below 1.
shares = st.floats(0.05, 0.95)


def vector(size, low=-1.0, high=1.0):
    return st.lists(st.floats(low, high), min_size=size, max_size=size).map(
        lambda x: torch.tensor(x, dtype=torch.float64)
    )


@st.composite
def problems(draw):
    """A start, the closest feasible action a* in the box and in reach, and the unit way there."""
    size = draw(st.integers(1, 4))
    start, way = draw(vector(size)), draw(vector(size))
    assume(way.abs().max() > 0.05)
    edge = torch.where(way > 0, 1.0, -1.0)
    room = torch.where(way.abs() > 1e-6, (edge - start) / way, math.inf).min()
    longest = min(room.item(), 0.999 * REACH / way.abs().max().item())
    assume(longest * way.norm() > 2e-3)
    length = draw(st.floats(1e-3 / way.norm().item(), 0.999 * longest))
    unit = way / way.norm()
    return start, start + length * way, unit, draw(penalties), draw(shares)


def linear(best, unit, slope):
    return lambda a: 0.3 - slope * ((a - best) * unit).sum(-1)


def bowl(best, unit, slope, radius):
    """Safe within `radius` of a centre behind a*; slope of `slope` at a*."""
    centre = best + radius * unit
    return lambda a: 0.3 + slope / (2 * radius) * (((a - centre) ** 2).sum(-1) - radius**2)


def hill(best, unit, slope, radius):
    """Safe beyond `radius` of a centre before a*; slope of `slope` at a*."""
    centre = best - radius * unit
    return lambda a: 0.3 - slope / (2 * radius) * (((a - centre) ** 2).sum(-1) - radius**2)


@random_cases
@given(problems(), st.sampled_from([linear, bowl, hill]), st.floats(0.05, 3.0))
def test_straight_paths_end_within_eta_of_the_optimum(problem, kind, radius):
    """Linear and isotropic quadratic risks, any penalty above the multiplier of the projection."""
    start, best, unit, penalty, share = problem
    distance = (best - start).norm().item()
    slope = distance / (share * penalty)  # mu* = ||a* - a_init|| / ||dQ_c/da(a*)||
    if kind is linear:
        risk = linear(best, unit, slope)
    else:
        # A step must not jump over the bowl, and no hill may peak on the way.
        radius += ETA * math.sqrt(start.numel()) + (distance if kind is hill else 0.0)
        risk = kind(best, unit, slope, radius)
    result = project(risk, start, 0.3, steps=STEPS, step_size=ETA, penalty=penalty)

    assert result.feasible and result.intervened and result.risk_after <= 0.3 < result.risk_before
    assert (result.action - best).abs().max() <= ETA + 1e-9
    assert result.action.abs().max() <= 1.0
    count = (best - start).abs().max().item() / ETA  # rounding decides where this is an integer
    assert math.ceil(count - 1e-9) <= result.steps <= math.ceil(count + 1e-9)


@random_cases
@given(problems(), st.floats(1.1, 5.0))
def test_a_small_penalty_stalls_before_the_limit(problem, excess):
    """Below mu* the iterates swing about the point where distance and risk balance."""
    start, best, unit, penalty, _ = problem
    distance = (best - start).norm().item()
    balance = distance / excess
    assume((distance - balance) * unit.abs().max() > 2 * ETA)
    result = project(linear(best, unit, balance / penalty), start, 0.3, penalty=penalty)
    assert not result.feasible and result.steps == STEPS
    assert (result.action - (start + balance * unit)).abs().max() <= ETA + 1e-9


@random_cases
@given(
    vector(2, -0.4, 0.4),
    vector(2, -0.5, 0.5),
    st.floats(0.0, math.pi),
    st.floats(1.0, 8.0),
    st.sampled_from([10.0, 100.0]),
)
def test_anisotropic_risk_is_feasible_at_an_excess_distance(centre, offset, angle, ratio, penalty):
    """Feasible, never closer to the start than the optimum, and not much farther."""
    assume(offset.norm() > 0.2)
    turn = torch.tensor(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]],
        dtype=torch.float64,
    )
    curvature = turn @ torch.diag(torch.tensor([1.0, ratio], dtype=torch.float64)) @ turn.T
    start = centre + offset

    def risk(a):
        return ((a - centre) @ curvature * (a - centre)).sum(-1) / 2

    limit = 0.3 * risk(start).item()

    def stationary(multiplier):  # argmin of 1/2 |a - start|^2 + multiplier * risk(a)
        weighted = multiplier * curvature
        return torch.linalg.solve(torch.eye(2) + weighted, start + weighted @ centre)

    low, high = 0.0, 1e6
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (low, middle) if risk(stationary(middle)) <= limit else (middle, high)
    shortest = (stationary(high) - start).norm().item()

    result = project(risk, start, limit, steps=STEPS, step_size=ETA, penalty=penalty)
    assert result.feasible
    excess = (result.action - start).norm().item() - shortest
    assert -1e-6 <= excess <= 0.25 * shortest + 2 * ETA, excess


@random_cases
@given(vector(1), st.sampled_from([-1.0, 1.0]), st.floats(0.01, 5.0), penalties, shares)
def test_a_coordinate_on_the_edge_does_not_hold_back_the_others(other, edge, pull, penalty, share):
    """The pull out of the box is far stronger than the one that can be followed."""
    distance = 0.9 * min(REACH, 1.0 + other.item())
    assume(distance > 0.01)
    slope = distance / (share * penalty)
    start = torch.tensor([edge, other.item()], dtype=torch.float64)

    def risk(a):
        outwards = (a[..., 0] - edge) * edge * slope * pull * 100
        return 0.3 + slope * (a[..., 1] - other.item() + distance) - outwards

    result = project(risk, start, 0.3, penalty=penalty)
    assert result.feasible and result.action[0] == edge
    assert 0 <= other.item() - distance - result.action[1] + 1e-9 <= ETA + 2e-9


def batch_problem(seed, size=64):
    generator = torch.Generator().manual_seed(seed)
    action = torch.rand(size, 2, generator=generator, dtype=torch.float64) * 2 - 1
    action[::5] = action[::5].sign()  # corners
    action[1::5, 0] = action[1::5, 0].sign()
    weight = torch.randn(3, size, 2, generator=generator, dtype=torch.float64)

    def risk_of(rows):
        w = weight[:, rows]
        return lambda a: torch.sin(3 * (a * w[0]).sum(-1)) + (a * w[1]).sum(-1) * (a * w[2]).sum(-1)

    return action, risk_of


@pytest.mark.parametrize("keep", ["last", "safest"])
@pytest.mark.parametrize("penalty", [0.0, 0.1, 1.0, 100.0])
def test_batch_properties(keep, penalty):
    """Box, untouched feasible samples, reported risks, a batch does as its samples do."""
    action, risk_of = batch_problem(0)
    risk = risk_of(slice(None))
    options = {"penalty": penalty, "keep": keep}
    result = project(risk, action, 0.2, **options)

    assert (result.action.abs() <= 1).all()
    safe = risk(action) <= 0.2
    assert 0 < safe.sum() < 64
    assert torch.equal(result.action[safe], action[safe])
    assert (result.steps[safe] == 0).all() and not result.intervened[safe].any()
    assert torch.equal(result.risk_before, risk(action))
    torch.testing.assert_close(result.risk_after, risk(result.action))
    assert torch.equal(result.feasible, result.risk_after <= 0.2)
    assert torch.equal(result.intervened, (result.action != action).any(-1))
    assert (result.steps <= STEPS).all()
    assert ((result.action - action).abs() <= result.steps[:, None].double() * ETA + 1e-12).all()
    if penalty:
        assert result.feasible[~safe].any()
    else:
        assert torch.equal(result.action, action)  # only the distance is left, and it is least

    for i in range(64):
        single = project(risk_of(i), action[i], 0.2, **options)
        for name in ("action", "risk_before", "risk_after", "steps", "intervened", "feasible"):
            torch.testing.assert_close(getattr(single, name), getattr(result, name)[i])


@pytest.mark.parametrize("batch", [(), (2, 3), (0,)])
@pytest.mark.parametrize("trailing", [False, True])
def test_shapes(batch, trailing):
    result = project(
        lambda a: a.sum(-1, keepdim=trailing), torch.full((*batch, 2), 0.5), 0.9, steps=3
    )
    assert result.action.shape == (*batch, 2)
    for name in ("risk_before", "risk_after", "steps", "intervened", "feasible"):
        assert getattr(result, name).shape == batch
    assert result.steps.dtype == torch.int64
    assert result.intervened.dtype == result.feasible.dtype == torch.bool


def test_keep_safest_and_keep_last():
    """No action is feasible; the iterates pass the least risk and go on to swing."""
    seen = []

    def risk(a):
        seen.append((a.item(), (1 + (a - 0.107) ** 2).item()))
        return 1 + (a.squeeze(-1) - 0.107) ** 2

    start = torch.tensor([0.5], dtype=torch.float64)
    last = project(risk, start, 0.5, steps=51, penalty=1000.0)
    assert last.action.item() == seen[-1][0] and not last.feasible
    seen.clear()
    safest = project(risk, start, 0.5, steps=51, penalty=1000.0, keep="safest")
    best = min(seen, key=lambda pair: pair[1])
    assert safest.action.item() == best[0] and safest.risk_after.item() == pytest.approx(best[1])
    assert safest.risk_after < last.risk_after and not safest.feasible


def test_safest_may_be_the_start():
    """The least risk is a kink: every step away is worse."""
    start = torch.tensor([0.0], dtype=torch.float64)
    risk = lambda a: 1.0 + torch.where(a > 0, a, -2 * a).squeeze(-1)  # noqa: E731
    result = project(risk, start, 0.5, steps=1, keep="safest", penalty=10.0)
    assert torch.equal(result.action, start) and result.steps == 1 and not result.intervened


def test_stops_where_the_gradient_is_zero():
    start = torch.tensor([[0.2, 0.4]])
    for risk in (lambda a: a.sum(-1) * 0 + 1, lambda a: torch.ones(a.shape[:-1])):
        result = project(risk, start, 0.5)
        assert torch.equal(result.action, start)
        assert not (result.steps.any() or result.intervened.any() or result.feasible.any())
    corner = torch.tensor([[1.0, -1.0]])
    result = project(lambda a: 5 - a[..., 0] + a[..., 1], corner, 0.5)  # all outward
    assert torch.equal(result.action, corner) and result.steps == 0


def test_risks_that_are_not_finite_do_no_harm():
    action = torch.tensor([[0.5], [0.6], [0.7]])
    result = project(
        lambda a: torch.tensor([[math.nan], [1.0], [math.inf]]) * (1 + a), action, 0.5, penalty=10.0
    )
    assert result.action.isfinite().all()
    assert torch.equal(result.action[0], action[0]) and not result.feasible[0]
    assert torch.equal(result.action[2], action[2])


def test_a_start_outside_the_box_is_brought_in():
    result = project(lambda a: a[..., 0], torch.tensor([1.5, 3.0]), 0.9, penalty=10.0)
    assert result.feasible and (result.action <= 1).all()


def test_under_no_grad_and_without_traces():
    torch.manual_seed(0)
    critic = value_operator(MLPValue(2, 16))
    ego, vehicles = torch.randn(8, 9), torch.zeros(8, 2, 6)
    action = (torch.rand(8, 2) * 2 - 1).requires_grad_()
    risk = lambda a: critic(ego, vehicles, a)  # noqa: E731
    limit = risk(action).min().item()
    with torch.no_grad():
        result = project(risk, action, limit, penalty=100.0)
        assert not torch.is_grad_enabled()
    assert result.intervened.any() and not result.action.requires_grad
    torch.testing.assert_close(project(risk, action, limit, penalty=100.0).action, result.action)
    assert all(p.grad is None for p in critic.parameters()) and action.grad is None
    with torch.inference_mode(), pytest.raises(RuntimeError, match="no_grad, not inference_mode"):
        project(risk, action, limit)


def test_evaluates_no_more_than_needed():
    calls = []
    risk = lambda a: (calls.append(1), a[..., 0])[1]  # noqa: E731
    project(risk, torch.tensor([[0.1], [0.2]]), 0.5)
    assert len(calls) == 1
    calls.clear()
    project(risk, torch.tensor([[0.1], [0.55]]), 0.5)
    assert len(calls) == 1 + 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"limit": math.nan}, "limit must be a number, got nan"),
        ({"steps": -1}, "steps must be >= 0, got -1"),
        ({"step_size": 0.0}, r"step_size must be finite and > 0, got 0.0"),
        ({"penalty": -1.0}, r"penalty must be finite and >= 0, got -1.0"),
        ({"keep": "first"}, "'last' or 'safest', got 'first'"),
        ({"low": 1.0}, r"low=1.0 and high=1.0"),
    ],
)
def test_errors(options, message):
    with pytest.raises(ValueError, match=message):
        project(lambda a: a.sum(-1), torch.zeros(3, 2), **{"limit": 0.1, **options})


def test_wrong_risk_shape_names_both():
    with pytest.raises(ValueError, match=r"shape \(3,\) or \(3, 1\) .* \(3, 2\), got \(3, 2\)"):
        project(lambda a: a, torch.zeros(3, 2), 0.1)
