"""What all constrained losses refuse alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar, get_args

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from saferl.modules import LagrangeMultiplier
from saferl.modules.limits import as_limit

Multiplier = TypeVar("Multiplier", bound=LagrangeMultiplier)


def check_choice(name: str, value: Any, choices: Any) -> Any:
    """A value that is one of a ``Literal``'s.

    Raises:
        ValueError: it is another one; names the key, the value and the choices.
    """
    if value not in get_args(choices):
        raise ValueError(f"{name} must be one of {', '.join(get_args(choices))}, got {value!r}.")
    return value


def check_limit(name: str, limit: float | Sequence[float], count: int | None = None) -> Tensor:
    """A limit on each of ``count`` costs in their units, float64: a scalar that serves all, or [count].

    Raises:
        ValueError: one is negative or not finite, or they are not as many; names it.
    """
    for each in torch.as_tensor(limit).reshape(-1):
        if not (each.isfinite() and each >= 0):
            raise ValueError(f"{name} must be >= 0, got {limit}.")
    return as_limit(name, limit, count)


def check_gamma(hyperparams: dict[str, Any]) -> None:
    """The discount among an estimator's settings, if it is there.

    Raises:
        ValueError: it lies outside [0, 1].
    """
    gamma = hyperparams.get("gamma", 0.0)
    if not 0 <= gamma <= 1:
        raise ValueError(f"gamma must be in [0, 1], got {gamma}.")


def check_cost(tensordict: TensorDictBase, key: NestedKey, count: int) -> None:
    """That a batch ``[*B]`` holds ``count`` costs under ``"next"``.

    Raises:
        KeyError: it does not; tells what is there.
        ValueError: they are not as many.
    """
    cost = tensordict.get(("next", key), None)
    if cost is not None and cost.shape[-1] != count:
        raise ValueError(
            f"{('next', key)} must be {[*tensordict.shape, count]}, as many costs as the loss has constraints, got "
            f"{[*cost.shape]}."
        )
    if cost is None:
        raise KeyError(
            f"The batch has no entry {('next', key)}; under 'next' it has "
            f"{sorted(map(str, tensordict.get('next').keys()))}. "
            "Name your cost with loss.set_keys(cost=...)."
        )


def check_begun(tensordict: TensorDictBase, key: NestedKey) -> None:
    """That a batch ``[*B]`` holds what ``begin`` writes.

    Raises:
        KeyError: it does not.
    """
    if tensordict.get(key, None) is None:
        raise KeyError(
            f"The batch has no entry {key!r}: loss.begin(data) writes it into a whole batch "
            "[*B, T] of fresh transitions, before it is cut into mini-batches."
        )


def check_lagrange(lagrange: Any, kind: type[Multiplier] = LagrangeMultiplier) -> Multiplier:
    """A multiplier of a kind.

    Raises:
        ValueError: it is something else.
    """
    if not isinstance(lagrange, kind):
        raise ValueError(f"lagrange must be a {kind.__name__}, got {lagrange!r}.")
    return lagrange


def check_risk(risk: Any) -> Callable[[Tensor], Tensor]:
    """What makes a risk [*B, 1] of the members' values [n, *B, N], by trying it.

    Raises:
        ValueError: it is no function, or makes something else.
    """
    try:
        shape = tuple(risk(torch.zeros(2, 3, 1)).shape)
    except Exception as error:
        raise ValueError(
            f"risk must be a function, such as saferl.modules.Largest(), of values [n, *B, N], got {risk!r}."
        ) from error
    if shape != (3, 1):
        raise ValueError(
            f"risk must make [3, 1] of values [2, 3, 1], got {list(shape)} of {risk!r}."
        )
    return risk


def count_members(name: str, members: Any, number: str, count: int | None) -> int:
    """How many members an ensemble has: ``count``, by default two, or as many as a list holds.

    Raises:
        ValueError: ``count`` is below one or not the length of the list; or they are a list of one, of
            which TorchRL makes parameters that no optimizer sees.
    """
    if not isinstance(members, list):
        count = 2 if count is None else count
        if count < 1:
            raise ValueError(f"{number} must be >= 1, got {count}.")
        return count
    if len(members) == 1:
        raise ValueError(f"{name} must be a critic or a list of several, got a list of one.")
    if count not in (None, len(members)):
        raise ValueError(
            f"{number} must be {len(members)}, as {name} is a list of so many, got {count}."
        )
    return len(members)
