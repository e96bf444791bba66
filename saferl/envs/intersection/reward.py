"""The reward of the CMDP (Er_1, Er_2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from saferl.envs.intersection.geometry import project, reference_lines, wrap

READINGS = ("normalised", "raw")


@dataclass(frozen=True)
class Reward:
    """Er_1 + Er_2 (paper): -50 on collision, +100 on arrival, and the dense reward
    ``2 / (1 + r_ref) + r_act + r_des + I_RS r_safe``.

    Attributes:
        reading: how ``r_ref`` weighs [x, y, v_x, v_y, phi, omega] against the reference
            [x_ref, y_ref, 9, 0, phi_ref, 0]. ``raw``: SI units and the larger value over the two
            reference lines, as printed. ``normalised``: positions / 100 m, speeds / 20 m/s, and
            the smaller value, which is what "stay close to the reference line" needs.
        risk_shaping: I_RS, adds r_safe (the RS variants alone).
        collision, arrival: sparse rewards.
        speed: v_x of the reference, m/s.
        destination_scale: ``r_des = -(d_des / destination_scale)^2``, metres (ours; chosen
            so that parking anywhere beats leaving the road there, see ``benchmarks/reward_audit.py``).
        weights: Q. energy: R_a. smoothness: R_Delta, on absolute changes (ours).

    >>> Reward(reading="metric")
    Traceback (most recent call last):
    ...
    ValueError: reward.reading must be one of normalised, raw, got 'metric'.
    """

    reading: str = "normalised"
    risk_shaping: bool = False
    collision: float = -50.0
    arrival: float = 100.0
    speed: float = 9.0
    destination_scale: float = 150.0
    weights: tuple[float, ...] = (400.0, 400.0, 20.0, 20.0, 2.0, 0.5)
    energy: tuple[float, float] = (0.05, 0.02)
    smoothness: tuple[float, float] = (0.10, 0.10)

    def __post_init__(self):
        if self.reading not in READINGS:
            raise ValueError(
                f"reward.reading must be one of {', '.join(READINGS)}, got {self.reading!r}."
            )
        if not self.destination_scale > 0:
            raise ValueError(f"reward.destination_scale must be > 0, got {self.destination_scale}.")
        if not self.collision <= 0:
            raise ValueError(f"reward.collision must be <= 0, got {self.collision}.")
        if not self.arrival >= 0:
            raise ValueError(f"reward.arrival must be >= 0, got {self.arrival}.")
        for name, count in (("weights", 6), ("energy", 2), ("smoothness", 2)):
            if len(getattr(self, name)) != count:
                raise ValueError(
                    f"reward.{name} must be {count} numbers, got {getattr(self, name)}."
                )

    def reference(self, ego: Tensor, route: Tensor) -> Tensor:
        """r_ref [...] of the state ``ego`` [..., 6] on ``route`` [...]."""
        lines = reference_lines(route, ego).movedim(-3, 0)  # the two lines first
        nearest, _, _ = project(ego[..., :2], lines)
        x, y, v_x, v_y, phi, omega = ego.unbind(-1)
        metre, speed = (100.0, 20.0) if self.reading == "normalised" else (1.0, 1.0)
        error = (
            (x - nearest[..., 0]) / metre,
            (y - nearest[..., 1]) / metre,
            (v_x - self.speed) / speed,
            v_y / speed,
            wrap(phi - nearest[..., 2]),
            omega,
        )
        per_line = sum(w * e.square() for w, e in zip(self.weights, error, strict=True))
        assert isinstance(per_line, Tensor)
        return per_line.amin(0) if self.reading == "normalised" else per_line.amax(0)

    def terms(
        self,
        ego: Tensor,
        route: Tensor,
        control: Tensor,
        previous: Tensor,
        d_veh: Tensor,
        d_des: Tensor,
        observed: Tensor,
        collided: Tensor,
        success: Tensor,
    ) -> dict[str, Tensor]:
        """Every term of the reward, each [...]; arguments as in :meth:`__call__`."""
        change = (control - previous).abs()
        near = torch.where(d_veh <= 0.2, -3.0 * (1.0 - d_veh), -(1.0 - d_veh))
        terms = {
            "reference": 2.0 / (1.0 + self.reference(ego, route)),
            "action": -sum(
                self.energy[k] * control[..., k].square() + self.smoothness[k] * change[..., k]
                for k in range(2)
            ),
            "destination": -(d_des / self.destination_scale).square(),
            "collision": self.collision * collided.to(ego.dtype),
            "arrival": self.arrival * success.to(ego.dtype),
        }
        if self.risk_shaping:
            terms["safety"] = torch.where(observed & (d_veh <= 0.5), near, 0.0)
        return terms

    def __call__(self, *args, **kwargs) -> Tensor:
        """Reward [...] of a transition.

        Args:
            ego: state after the step [..., 6].
            route: int64 [...].
            control: executed a_x and delta_f, [..., 2], physical units.
            previous: the step's before, [..., 2]; the same as ``control`` at the first step.
            d_veh, d_des: distances after the step [...], m.
            observed: bool [...], whether any vehicle is observed (else r_safe is 0).
            collided: bool [...], collision or off the road.
            success: bool [...].
        """
        return torch.stack(list(self.terms(*args, **kwargs).values())).sum(0)
