"""A search space in the grammar by which Hydra sweeps: ``interval``, ``range``, ``choice`` and lists."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep, Override, RangeSweep


@dataclass(frozen=True)
class Dimension:
    """A setting that is searched.

    Attributes:
        key: as on the command line.
        low, high: both ends of a number, whole ones where it is.
        log: whether its logarithm is drawn evenly.
        step: between two values; None: any number (1 of a whole one).
        choices: in place of a number, as on the command line.
    """

    key: str
    low: Any = None
    high: Any = None
    log: bool = False
    step: Any = None
    choices: tuple[str, ...] = ()

    @property
    def ends(self) -> tuple[Any, ...]:
        """Values by which one sees whether the whole dimension is allowed."""
        return self.choices or (self.low, self.high)


def split(overrides: Sequence[str]) -> tuple[list[str], list[Dimension]]:
    """A command line's fixed settings, and those that it searches.

    Raises:
        ValueError: a dimension is empty, or none is there.
        HydraException: an override is no override.

    >>> split(["algo=sac", "encoder.width=int(tag(log,interval(16,64)))", "learning.tau=0.01,0.005"])
    (['algo=sac'], [Dimension(key='encoder.width', low=16, high=64, log=True, step=None, choices=()), \
Dimension(key='learning.tau', low=None, high=None, log=False, step=None, choices=('0.01', '0.005'))])
    """
    fixed, space = [], []
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    for text, each in zip(overrides, parsed, strict=True):
        if each.is_sweep_override():
            space.append(_dimension(text, each))
        else:
            fixed.append(text)
    if not space:
        raise ValueError(
            "Give at least one setting to search: KEY=interval(LOW,HIGH), KEY=tag(log,interval(LOW,HIGH)), "
            "KEY=int(interval(LOW,HIGH)), KEY=range(LOW,END,STEP) or KEY=a,b,c."
        )
    keys = [text.partition("=")[0] for text in overrides]
    for dimension in space:
        if keys.count(dimension.key) > 1:
            raise ValueError(f"{dimension.key} is searched, and given twice.")
    return fixed, space


def _dimension(text: str, each: Override) -> Dimension:
    key, value = each.get_key_element(), each.value()
    low: Any
    high: Any
    if isinstance(value, IntervalSweep):
        low, high, log = value.start, value.end, "log" in value.tags
        if value.tags - {"log"}:
            raise ValueError(f"{text}: a tag must be log, got {', '.join(sorted(value.tags))}.")
        if not low < high:
            raise ValueError(f"{text} is empty: its low end must be below its high end.")
        if log and not low > 0:
            raise ValueError(f"{text}: the low end of a logarithm must be > 0, got {low}.")
        return Dimension(key, low, high, log)
    values = list(each.sweep_string_iterator())
    if len(values) < 2:
        raise ValueError(f"{text} has nothing to search: give two values or more, got {values}.")
    if isinstance(value, RangeSweep):
        numbers = sorted(each.sweep_iterator())  # pyright: ignore
        return Dimension(key, numbers[0], numbers[-1], step=numbers[1] - numbers[0])
    return Dimension(key, choices=tuple(values))
