"""What the paper claims, answered from the runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from saferl.report.systems import LABELS, System

CONFIRMED, REFUTED, OPEN, NO_DATA = VERDICTS = ("confirmed", "refuted", "not decided", "no data")
_BASELINES = ("cpo", "ppo_rs", "sac_rs", "sac_lag")


@dataclass(frozen=True)
class Claim:
    """That one system has more, or less, of a figure than another, in the mean of the tasks.

    Attributes:
        claim: in words.
        system, other: names.
        figure: which.
        sign: 1 if the claim is that ``system`` has more of it, -1 if less.
        seeds, other_seeds: how many there are of each.
        difference: of the means, ``system`` less ``other``; None without data.
        low, high: its 95% interval; None where one has fewer than two seeds.
    """

    claim: str
    system: str
    other: str
    figure: str
    sign: int
    seeds: int = 0
    other_seeds: int = 0
    difference: float | None = None
    low: float | None = None
    high: float | None = None

    @property
    def verdict(self) -> str:
        """One of :data:`VERDICTS`.

        >>> about = ("A is faster", "a", "b", "speed", 1, 5, 5)
        >>> [Claim(*about, *numbers).verdict for numbers in ((1, 0.5, 1.5), (-1, -2, -0.1), (1, -1, 3), ())]
        ['confirmed', 'refuted', 'not decided', 'no data']
        """
        if self.difference is None:
            return NO_DATA
        if self.low is None or self.high is None or self.low <= 0 <= self.high:
            return OPEN
        return CONFIRMED if self.sign * self.low > 0 else REFUTED


def _claims() -> list[Claim]:
    fewer, faster = ("collision_rate", -1), ("speed", 1)
    told = {
        ("arsac", "asac"): "Risk-awareness lowers collisions with attention",
        ("rsac", "sac"): "Risk-awareness lowers collisions without attention",
        ("arsac", "rsac"): "Attention lowers collisions with risk-awareness",
        ("asac", "sac"): "Attention lowers collisions without risk-awareness",
        ("arsac", "arsac_unprojected"): "The projection lowers collisions",
    }
    compared = [
        Claim(f"ARSAC has fewer collisions than {LABELS[other]}", "arsac", other, *fewer)
        for other in (*_BASELINES, "sac")
    ]
    parts = [
        Claim(f"{claim} ({LABELS[one]} against {LABELS[other]})", one, other, *fewer)
        for (one, other), claim in told.items()
    ]
    speeds = [
        Claim(f"ARSAC is not slower than {LABELS[other]}", "arsac", other, *faster)
        for other in (*_BASELINES, "sac", "rsac", "asac")
    ]
    return [*compared, *parts, *speeds]


def answers(systems: Sequence[System]) -> list[Claim]:
    """Each claim with its numbers, those of one seed without an interval: it says nothing of another."""
    there = {system.name: system for system in systems if system.trained}
    return [_answer(claim, there) for claim in _claims()]


def _answer(claim: Claim, there: Mapping[str, System]) -> Claim:
    mine, other = there.get(claim.system), there.get(claim.other)
    claim = replace(
        claim,
        seeds=len(mine.seeds) if mine else 0,
        other_seeds=len(other.seeds) if other else 0,
    )
    estimates = [each and each.estimate("mean", claim.figure) for each in (mine, other)]
    if estimates[0] is None or estimates[1] is None:
        return claim
    apart = estimates[0] - estimates[1]
    surely = min(claim.seeds, claim.other_seeds) > 1
    low, high = apart.interval() if surely else (None, None)
    return replace(claim, difference=apart.value, low=low, high=high)
