"""Lagrange multipliers of a cost constraint: plain dual ascent and PID control."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def _check(name: str, value: float, *, positive: bool = False) -> float:
    if not math.isfinite(value) or value < 0 or (positive and value == 0):
        sign = "> 0" if positive else ">= 0"
        raise ValueError(f"{name} must be finite and {sign}, got {value}.")
    return float(value)


#: Below this an exponential multiplier does not fall, or it would be long in coming back.
LEAST = 1e-6


class LagrangeMultiplier(nn.Module):
    """A multiplier lambda >= 0 of a constraint ``violation <= 0``: fixed, unless a subclass moves it.

    A loss adds ``multiplier.value.detach() * multiplier.penalty(violation)`` to each sample; a
    training loop calls :meth:`update` with fresh penalties, once for each update: their mean is the
    Lagrangian's slope in lambda.

    Of several constraints it is a vector [K], which penalties and violations [*B, K] meet in their last dimension. Each
    is moved by itself.

    A state-wise constraint (``signed=False``) counts only the samples that violate it, and its
    multiplier cannot fall (E11, paper). A signed one averages surplus and shortage.

    All state is in float64 buffers, which a float32 loss can multiply by without being promoted;
    ``loss.float()`` would round small updates away.

    Args:
        init: first value; of several constraints a list [K].
        signed: whether satisfied samples count against violated ones.
        maximum: upper bound of the value, for safety; infinite by default.

    Raises:
        ValueError: if ``init`` is negative or not finite, or ``maximum < init``.

    Examples:
        >>> import torch
        >>> from saferl.modules import LagrangeMultiplier
        >>> multiplier = LagrangeMultiplier(init=2.0)
        >>> multiplier.value * multiplier.penalty(torch.tensor([-0.5, 0.5]))
        tensor([0., 1.])
    """

    value: Tensor

    def __init__(
        self, init: float | Sequence[float] = 1.0, signed: bool = False, maximum: float = math.inf
    ):
        super().__init__()
        # In float32, 1 + 1e-4 * violation is 1 for every violation below 6e-4.
        value = torch.tensor(init, dtype=torch.float64).squeeze()
        for each in value.reshape(-1).tolist():
            if not maximum >= _check("init", each):
                raise ValueError(f"maximum must be >= init, got maximum={maximum} and init={init}.")
        self.register_buffer("value", value)
        self.signed = signed
        self.maximum = float(maximum)

    @property
    def count(self) -> int:
        """K, how many constraints it is of."""
        return self.value.numel()

    def expand(self, count: int) -> Self:
        """Make it one of ``count`` constraints, in place: its own value serves each, if it has one alone.

        Raises:
            ValueError: it has another number of values.

        >>> LagrangeMultiplier(init=2.0).expand(3).value
        tensor([2., 2., 2.], dtype=torch.float64)
        """
        if self.count not in (1, count):
            raise ValueError(f"init must be a number or {count} of them, got {self.count}.")
        for name, buffer in list(self.named_buffers(recurse=False)):
            if buffer.shape == self.value.shape and name != "value":
                self.register_buffer(name, buffer.expand(count).squeeze().clone())
        self.value = self.value.expand(count).squeeze().clone()
        return self

    def penalty(self, violation: Tensor) -> Tensor:
        """The term of each sample that lambda multiplies, [*B] or [*B, K]: ReLU or identity."""
        return violation if self.signed else F.relu(violation)

    def _mean(self, penalty: Tensor) -> tuple[Tensor, Tensor]:
        """Mean of the finite entries of each constraint (float64), and whether there is one."""
        if self.count > 1 and penalty.shape[-1:] != self.value.shape:
            raise ValueError(
                f"penalty must be [*B, {self.count}] of {self.count} constraints, got {list(penalty.shape)}."
            )
        penalty = penalty.detach().to(self.value).reshape(-1, *self.value.shape)
        finite = penalty.isfinite()
        total = torch.where(finite, penalty, 0.0).sum(0)
        return total / finite.sum(0).clamp(min=1), finite.any(0)

    def update(self, penalty: Tensor, elapsed: float = 1.0) -> None:
        """Moves the multiplier by penalties of any shape ([*B, K] of several constraints), which are averaged; here, not at all.

        A loss reports theirs as ``"constraint_violation"``; for violations of your own,
        ``multiplier.update(multiplier.penalty(violation))``. Entries that are not finite are left
        out; with none left (or an empty tensor) nothing changes, so one bad batch cannot turn the
        multiplier into NaN.

        Args:
            penalty: of any shape; of several constraints [*B, K].
            elapsed: since the last update, in the unit of time that rates are of.

        Raises:
            ValueError: penalties of several constraints have another last size.
        """


class DualAscent(LagrangeMultiplier):
    """Projected gradient ascent on the dual (E7 and E11, paper).

    lambda <- max(0, lambda + lr * mean(penalty)), where the penalty of a violation is its ReLU by
    default (as E11 prints it: the multiplier can only grow) and the violation itself if ``signed``.

    Args:
        init: first value; of several constraints a list [K].
        lr: step size alpha_lambda, for each unit of time.
        signed: whether satisfied samples lower the multiplier.
        maximum: upper bound of the value.

    Raises:
        ValueError: if ``init < 0``, ``lr <= 0``, either is not finite, or ``maximum < init``.

    Examples:
        >>> import torch
        >>> from saferl.modules import DualAscent
        >>> multiplier = DualAscent(init=1.0, lr=0.1, signed=True)
        >>> multiplier.update(torch.tensor([0.5, 1.5]))
        >>> round(multiplier.value.item(), 6)
        1.1
    """

    def __init__(
        self,
        init: float | Sequence[float] = 1.0,
        lr: float = 1e-4,
        signed: bool = False,
        maximum: float = math.inf,
    ):
        super().__init__(init, signed, maximum)
        self.lr = _check("lr", lr, positive=True)

    @torch.no_grad()
    def update(self, penalty: Tensor, elapsed: float = 1.0) -> None:
        mean, _ = self._mean(penalty)
        self.value.copy_((self.value + self.lr * elapsed * mean).clamp(0.0, self.maximum))


class PIDMultiplier(LagrangeMultiplier):
    """PID control of the multiplier (Stooke, Achiam and Abbeel, 2020, Algorithm 2).

    With e the mean penalty, which is the mean violation if ``signed``, e_s the same smoothed, and e' the e_s before:
    I <- clip(I + ki * e, 0, maximum), lambda <- clip(kp * e_s + I + kd * max(0, e_s - e'), 0, maximum).

    If ``exponential`` (ours), what is controlled is log(lambda): I, which begins at log(init), and the sum are clipped
    between log(1e-6) and log(maximum). A step is then relative, and the same gains serve rewards and costs of any
    size. With a ``swing``, kp * e_s is bounded by it: swing * tanh(kp * e_s / swing).

    The integral is kept in units of lambda (or of its logarithm) and clipped at every step (anti-windup), so that it
    lets go as soon as the sign of the violation changes. It starts at ``init``. The derivative acts on
    rising violations only, and not at the first update.

    Args:
        kp: gain on the violation.
        ki: gain on its running sum, for each unit of time.
        kd: gain on its increase since the last update.
        init: first value; of several constraints a list [K].
        signed: whether satisfied samples lower the multiplier; Stooke et al. do so.
        maximum: upper bound of the value and of the integral.
        smoothing: time over which e_s averages e; 0: not at all.
        swing: bound of the proportional part, so that a policy that is far from its limit is not driven there at
            any price; infinite by default.
        exponential: see above.

    Raises:
        ValueError: if a gain, ``init`` or ``smoothing`` is negative or not finite, all gains are 0,
            ``maximum < init``, ``swing`` is not positive, or ``init`` is below 1e-6 and ``exponential``.

    Examples:
        >>> import torch
        >>> from saferl.modules import PIDMultiplier
        >>> multiplier = PIDMultiplier(kp=1.0, ki=0.5, kd=2.0, init=0.0)
        >>> for violation in (0.2, 0.4):
        ...     multiplier.update(torch.tensor(violation))
        >>> round(multiplier.value.item(), 6)  # 1 * 0.4 + 0.5 * (0.2 + 0.4) + 2 * (0.4 - 0.2)
        1.1
    """

    integral: Tensor
    previous: Tensor
    started: Tensor

    def __init__(
        self,
        kp: float = 0.1,
        ki: float = 0.01,
        kd: float = 0.01,
        init: float | Sequence[float] = 0.0,
        signed: bool = True,
        maximum: float = math.inf,
        smoothing: float = 0.0,
        swing: float = math.inf,
        exponential: bool = False,
    ):
        super().__init__(init, signed, maximum)
        self.kp, self.ki, self.kd = _check("kp", kp), _check("ki", ki), _check("kd", kd)
        if self.kp == self.ki == self.kd == 0:
            raise ValueError("At least one of kp, ki and kd must be > 0, got 0, 0 and 0.")
        if exponential and bool((self.value < LEAST).any()):
            raise ValueError(f"init must be >= {LEAST} where exponential, got {init}.")
        if not swing > 0:
            raise ValueError(f"swing must be > 0, got {swing}.")
        self.smoothing, self.swing = _check("smoothing", smoothing), float(swing)
        self.exponential = exponential
        self.register_buffer("integral", self.value.log() if exponential else self.value.clone())
        self.register_buffer("previous", torch.zeros_like(self.value))
        self.register_buffer("started", torch.zeros_like(self.value, dtype=torch.bool))

    @torch.no_grad()
    def update(self, penalty: Tensor, elapsed: float = 1.0) -> None:
        mean, known = self._mean(penalty)
        weight = -math.expm1(-elapsed / self.smoothing) if self.smoothing else 1.0
        smooth = torch.where(self.started, self.previous + weight * (mean - self.previous), mean)
        rise = torch.where(self.started, F.relu(smooth - self.previous), 0.0)
        least, most = 0.0, self.maximum
        if self.exponential:
            least, most = math.log(LEAST), math.log(most)
        integral = (self.integral + self.ki * elapsed * mean).clamp(least, most)
        proportional = self.kp * smooth
        if self.swing < math.inf:
            proportional = self.swing * (proportional / self.swing).tanh()
        value = (proportional + integral + self.kd * rise).clamp(least, most)
        if self.exponential:
            value = value.exp()
        self.integral.copy_(torch.where(known, integral, self.integral))
        self.value.copy_(torch.where(known, value, self.value))
        self.previous.copy_(torch.where(known, smooth, self.previous))
        self.started.logical_or_(known)
