"""What the figures of several costs are called: here, and nowhere else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor


def names(key: str, costs: Sequence[str], mark: str = "_") -> list[str]:
    """The names of a figure of each cost: its own where there is one cost, else with the cost's appended.

    >>> names("cost_return", ["cost"]), names("cost_return", ["road", "speed"])
    (['cost_return'], ['cost_return_road', 'cost_return_speed'])
    """
    return [key] if len(costs) == 1 else [f"{key}{mark}{cost}" for cost in costs]


def columns(key: str, values: Tensor, costs: Sequence[str]) -> dict[str, Tensor]:
    """A figure of each cost by its name.

    Args:
        key: what one is called.
        values: [*B] of one cost, [*B, K] of several.
        costs: their names.
    """
    each = [values] if len(costs) == 1 else values.unbind(-1)
    return dict(zip(names(key, costs), each, strict=True))


def by_name(figures: Mapping[str, Tensor], costs: Sequence[str]) -> dict[str, Tensor]:
    """Figures of episodes [n] by their names, of those that are of several costs [n, K] each."""
    named = (columns(k, v, costs if v.ndim > 1 else (k,)) for k, v in figures.items())
    return {name: each for group in named for name, each in group.items()}


def limits(limit: float | Sequence[float] | None, costs: Sequence[str]) -> list[float | None]:
    """The limit of each cost; None where there is none.

    >>> limits(None, ["road", "speed"]), limits(0.1, ["cost"]), limits([0.1, 0.2], ["road", "speed"])
    ([None, None], [0.1], [0.1, 0.2])
    """
    return [*limit] if isinstance(limit, Sequence) else [limit] * len(costs)


def scalars(key: str, value: Tensor, costs: Sequence[str]) -> dict[str, Tensor]:
    """A number, or one of each cost, by name; nothing where it is neither.

    >>> import torch
    >>> scalars("lambda", torch.tensor([1.0, 2.0]), ["road", "speed"])
    {'lambda_road': tensor(1.), 'lambda_speed': tensor(2.)}
    >>> scalars("loss", torch.tensor(1.0), ["road", "speed"]), scalars("many", torch.zeros(9), ["road"])
    ({'loss': tensor(1.)}, {})
    """
    if value.numel() == 1:
        return {key: value}
    return columns(key, value, costs) if value.shape == (len(costs),) else {}
