"""Multipliers against recursions computed in plain Python."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from saferl.modules import DualAscent, LagrangeMultiplier, PIDMultiplier

violations = st.lists(st.floats(-2, 2), min_size=1, max_size=30)
gains = st.floats(0, 3)
random_cases = settings(deadline=None, max_examples=60, database=None)


@random_cases
@given(violations, st.floats(0, 2), st.floats(1e-3, 2), st.booleans(), st.floats(0, 4))
def test_dual_ascent_recursion(sequence, init, lr, signed, room):
    multiplier = DualAscent(init, lr, signed, maximum=init + room)
    value = init
    for violation in sequence:
        multiplier.update(multiplier.penalty(torch.tensor(violation, dtype=torch.float64)))
        value += lr * (violation if signed else max(0.0, violation))
        value = min(max(value, 0.0), init + room)
        assert multiplier.value.item() == pytest.approx(value, abs=1e-12)


@random_cases
@given(violations, st.tuples(gains, st.floats(0.1, 3), gains), st.floats(0, 2), st.booleans())
def test_pid_recursion(sequence, gains, init, signed):
    kp, ki, kd = gains
    multiplier = PIDMultiplier(kp, ki, kd, init, signed, maximum=5.0)
    integral, previous = init / ki, None
    for violation in sequence:
        multiplier.update(multiplier.penalty(torch.tensor(violation, dtype=torch.float64)))
        error = violation if signed else max(0.0, violation)
        integral = min(max(0.0, integral + error), 5.0 / ki)
        rise = 0.0 if previous is None else max(0.0, error - previous)
        value = min(max(0.0, kp * error + ki * integral + kd * rise), 5.0)
        previous = error
        assert multiplier.value.item() == pytest.approx(value, abs=1e-9)


def test_default_pid_is_valid_and_reacts():
    multiplier = PIDMultiplier()
    multiplier.update(torch.tensor(1.0))
    assert multiplier.value.item() == pytest.approx(0.1 + 0.01)


@pytest.mark.parametrize("make", [DualAscent, PIDMultiplier])
def test_a_tensor_is_averaged_after_the_penalty(make):
    violation = torch.tensor([[[-1.0], [3.0]], [[0.5], [-4.0]]])
    for signed, mean in ((False, 3.5 / 4), (True, -1.5 / 4)):
        by_tensor, by_mean = make(init=1.0, signed=signed), make(init=1.0, signed=signed)
        by_tensor.update(by_tensor.penalty(violation))
        by_mean.update(torch.tensor(mean))
        torch.testing.assert_close(by_tensor.value, by_mean.value)


def test_penalty():
    violation = torch.tensor([-1.0, 0.0, 2.0], requires_grad=True)
    state_wise, signed = LagrangeMultiplier(), LagrangeMultiplier(signed=True)
    torch.testing.assert_close(state_wise.penalty(violation), torch.tensor([0.0, 0.0, 2.0]))
    torch.testing.assert_close(signed.penalty(violation), violation)
    (slope,) = torch.autograd.grad(state_wise.penalty(violation).sum(), violation)
    torch.testing.assert_close(slope, torch.tensor([0.0, 0.0, 1.0]))
    assert (state_wise.value * violation).dtype == torch.float32


class Steep(DualAscent):
    def penalty(self, violation):
        return super().penalty(violation) + 5 * violation.clamp(min=0).square()


def test_a_penalty_of_ones_own_counts_once():
    """What moves the multiplier is the slope of the Lagrangian, and not the penalty of a penalty."""
    multiplier = Steep(init=1.0, lr=0.1)
    violation = torch.tensor([1.0, -1.0])
    lagrangian = multiplier.penalty(violation).mean()  # times lambda
    multiplier.update(lagrangian)
    assert multiplier.value.item() == pytest.approx(1.0 + 0.1 * 6 / 2)


def test_base_class_is_a_fixed_multiplier():
    multiplier = LagrangeMultiplier(init=0.7)
    multiplier.update(torch.tensor(5.0))
    assert multiplier.value.item() == 0.7


def test_state_wise_ascent_never_falls_and_signed_never_goes_negative():
    state_wise, signed = DualAscent(1.0, 0.1), DualAscent(1.0, 0.1, signed=True)
    for _ in range(100):
        for multiplier in (state_wise, signed):
            multiplier.update(multiplier.penalty(torch.tensor(-1.0)))
    assert state_wise.value.item() == 1.0
    assert signed.value.item() == 0.0
    signed.update(torch.tensor(1.0))
    assert signed.value.item() == pytest.approx(0.1)  # no memory of the time at zero


def test_pid_does_not_wind_up():
    multiplier = PIDMultiplier(kp=0.0, ki=0.1, kd=0.0, maximum=2.0)
    for _ in range(1000):
        multiplier.update(torch.tensor(-1.0))
    multiplier.update(torch.tensor(1.0))
    assert multiplier.value.item() == pytest.approx(0.1)
    for _ in range(1000):
        multiplier.update(torch.tensor(1.0))
    assert multiplier.value.item() == 2.0
    multiplier.update(torch.tensor(-1.0))
    assert multiplier.value.item() == pytest.approx(1.9)


def test_small_violations_add_up():
    """1e-4 * 1e-4 is lost beside 1.0 in float32."""
    multiplier = DualAscent(init=1.0, lr=1e-4)
    for _ in range(1000):
        multiplier.update(torch.tensor(1e-4))
    assert multiplier.value.item() - 1.0 == pytest.approx(1e-5, rel=1e-4)


@pytest.mark.parametrize("make", [DualAscent, lambda: PIDMultiplier(1.0, 1.0, 1.0, init=1.0)])
def test_bad_batches_are_ignored(make):
    multiplier = make()
    before = {key: value.clone() for key, value in multiplier.state_dict().items()}
    for bad in (torch.tensor(math.nan), torch.full((3,), math.inf), torch.zeros(0)):
        multiplier.update(bad)
        torch.testing.assert_close(dict(multiplier.state_dict()), before)
    clean = make()
    clean.update(torch.tensor([1.0, 2.0]))
    multiplier.update(torch.tensor([1.0, math.nan, 2.0, -math.inf]))
    torch.testing.assert_close(multiplier.value, clean.value)
    assert multiplier.value.isfinite()


@pytest.mark.parametrize("make", [DualAscent, lambda: PIDMultiplier(0.3, 0.2, 0.1, init=1.0)])
def test_resume_continues(make):
    sequence = torch.tensor([0.3, 0.9, -0.2, 0.4])
    straight, first, second = make(), make(), make()
    for violation in sequence:
        straight.update(violation)
    for violation in sequence[:2]:
        first.update(violation)
    second.load_state_dict(first.state_dict())
    live = second.value
    for violation in sequence[2:]:
        second.update(violation)
    assert second.value.item() == straight.value.item() and second.value is live
    assert not list(second.parameters())


def test_update_needs_no_graph():
    multiplier = DualAscent()
    violation = torch.ones(3, requires_grad=True)
    multiplier.update(violation * 2)
    assert not multiplier.value.requires_grad and violation.grad is None


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: DualAscent(init=-1.0), r"init must be finite and >= 0, got -1.0"),
        (lambda: DualAscent(init=math.nan), "init must be finite"),
        (lambda: DualAscent(lr=0.0), r"lr must be finite and > 0, got 0.0"),
        (lambda: DualAscent(lr=math.inf), "lr must be finite"),
        (lambda: DualAscent(init=2.0, maximum=1.0), "maximum=1.0 and init=2.0"),
        (lambda: DualAscent(maximum=math.nan), "maximum must be >= init"),
        (lambda: PIDMultiplier(-0.1, 0.1), r"kp must be finite and >= 0, got -0.1"),
        (lambda: PIDMultiplier(0.0, 0.0, 0.0), "At least one of kp, ki and kd"),
    ],
)
def test_errors(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("shape", [(4,), (2, 1), ()])
def test_penalties_of_several_constraints_have_their_number(shape):
    multiplier = DualAscent(init=1.0).expand(2)
    with pytest.raises(ValueError, match=r"penalty must be \[\*B, 2\] of 2 constraints, got"):
        multiplier.update(torch.ones(shape))


def controlled(errors, times, **settings):
    """The recursion of an exponential PID multiplier in plain floats."""
    kp, ki, kd, smoothing, swing = (
        settings[name] for name in ("kp", "ki", "kd", "smoothing", "swing")
    )
    integral, smooth, values = math.log(settings["init"]), None, []
    for error, elapsed in zip(errors, times, strict=True):
        weight = 1 - math.exp(-elapsed / smoothing) if smoothing else 1.0
        before = smooth
        smooth = error if before is None else before + weight * (error - before)
        rise = 0.0 if before is None else max(smooth - before, 0.0)
        integral = max(integral + ki * elapsed * error, math.log(1e-6))
        control = swing * math.tanh(kp * smooth / swing) + integral + kd * rise
        values.append(math.exp(max(control, math.log(1e-6))))
    return values


@pytest.mark.parametrize("kd", [0.0, 2.0])
@pytest.mark.parametrize("smoothing", [0.0, 0.05])
def test_exponential_control(kd: float, smoothing: float):
    """As a recursion in plain floats, over violations and times of all sizes; the value stays positive."""
    settings = dict(kp=8.0, ki=15.0, kd=kd, smoothing=smoothing, swing=1.5, init=0.5)
    generator = torch.Generator().manual_seed(0)
    errors = (torch.randn(60, generator=generator) - 0.3).tolist() + [-1.0] * 40
    times = (torch.rand(100, generator=generator) * 0.05).tolist()
    multiplier, found = PIDMultiplier(exponential=True, **settings), []
    for error, elapsed in zip(errors, times, strict=True):
        multiplier.update(torch.tensor([error, error]), elapsed)
        found.append(float(multiplier.value))
    assert found == pytest.approx(controlled(errors, times, **settings), rel=1e-5)
    assert found[-1] >= 1e-6


def test_a_longer_time_is_several_short_ones():
    """Of the integral; and the size of the rewards does not matter to an exponential multiplier."""
    once, thrice, large = (
        PIDMultiplier(kp=0, ki=2.0, kd=0, init=init, exponential=True) for init in (1.0, 1.0, 1e3)
    )
    once.update(torch.tensor(0.4), elapsed=0.3)
    large.update(torch.tensor(0.4), elapsed=0.3)
    for _ in range(3):
        thrice.update(torch.tensor(0.4), elapsed=0.1)
    assert float(once.value) == pytest.approx(float(thrice.value)) == pytest.approx(math.exp(0.24))
    assert float(large.value) == pytest.approx(1e3 * float(once.value))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"exponential": True}, "init must be >= 1e-06 where exponential, got 0.0"),
        ({"swing": 0.0}, "swing must be > 0, got 0.0"),
        ({"smoothing": -1.0}, "smoothing must be finite and >= 0, got -1.0"),
    ],
)
def test_control_refuses(settings, message: str):
    with pytest.raises(ValueError, match=message):
        PIDMultiplier(**settings)
