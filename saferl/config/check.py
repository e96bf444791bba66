"""Refuse a configuration that cannot be meant, before anything is built from it."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import hydra
from omegaconf import MISSING, DictConfig, ListConfig, OmegaConf

from saferl.config import schema
from saferl.config.foreign import NAMING
from saferl.envs.task import Task

_KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}
_KINDS |= {NoneType: "null"}

#: What the parts of a composition must be, by their places. A risk is any function: the loss tries it.
PARTS = {
    "task": "saferl.envs.task.Task",
    "env": "torchrl.envs.EnvBase",
    "encoder": "saferl.modules.Encoder",
    "learning": "saferl.algorithms.Algorithm",
    "loss": "torchrl.objectives.LossModule",
    "lagrange.multiplier": "saferl.modules.LagrangeMultiplier",
    "lagrange.signal": "saferl.training.signals.Signal",
    "projector": "saferl.envs.transforms.Correction",
    "transform": "saferl.envs.transforms.Saute",
    "collector": "saferl.training.collectors.Collecting",
    "logger.sinks": "torchrl.record.loggers.Logger",
}


def check(cfg: DictConfig) -> None:
    """Check all that a configuration says, but for what its parts say of each other.

    Raises:
        ValueError: names the key, the value and what is allowed.
    """
    known = cfg
    if OmegaConf.get_type(cfg) is dict:  # a run's own file, which somebody may have edited
        known = OmegaConf.merge(OmegaConf.structured(schema.Training), cfg)
        _as_they_are(cfg, known)
    schema.check(known)  # pyright: ignore[reportArgumentType]
    check_targets(cfg)


def _as_they_are(node: Any, known: Any, path: str = "") -> None:
    """Refuse text that the schema would read as something else: what is built reads the file's own node."""
    for key, value in node.items():
        if isinstance(value, DictConfig) and isinstance(known[key], DictConfig):
            _as_they_are(value, known[key], f"{path}{key}.")
        elif isinstance(value, str) and not isinstance(known[key], str):
            kind = _KINDS.get(type(known[key]), "no text")
            raise ValueError(f"{path}{key} must be {kind}, got {value!r}.")


def check_task(evaluation: Any, task: Task) -> None:
    """Check what the closing test of a training asks of its task.

    Raises:
        ValueError: drivers or pictures that the task has not, or more episodes.
    """
    task.as_test().check_episodes("evaluation.episodes", evaluation.episodes)
    for name in evaluation.drivers:
        if name not in task.drivers:
            choices = ", ".join(task.drivers) or f"none: task={task.task} has no drivers"
            raise ValueError(f"evaluation.drivers must be among {choices}, got {name!r}.")
    if evaluation.draw != "none" and not task.pictures:
        raise ValueError(
            f"evaluation.draw must be none, as task={task.task} draws no pictures, got {evaluation.draw}."
        )


def check_targets(node: Any, path: str = "", kind: Any = None) -> None:
    """Check that each ``_target_`` below a node makes what its place needs (``kind``), and its arguments, by names and
    kinds; each mapping that stands for a dataclass against its fields; and that every number is finite.

    Raises:
        ValueError: names the key and what is allowed.
    """
    if isinstance(node, float) and not math.isfinite(node):
        raise ValueError(f"{path} must be finite, got {node}.")
    if isinstance(node, ListConfig):
        for index, item in enumerate(node):
            check_targets(item, f"{path}[{index}]")
    if not isinstance(node, DictConfig):
        return
    target, accepted = node.get("_target_"), None
    if target is not None:
        _check_kind(node, path, kind or part(path))
        accepted = arguments(target)
    if target is None and is_dataclass(kind):
        target, accepted = f"{path}, a {kind.__name__},", get_type_hints(kind)  # pyright: ignore
    for key in _required(node.get("_target_")):
        if key not in node:
            raise ValueError(f"{path}.{key} is missing: {target} has no default for it.")
    for key, value in node.items():
        name = f"{path}.{key}".removeprefix(".")
        if accepted is not None and not str(key).startswith("_"):
            if key not in accepted:
                raise ValueError(
                    f"unknown key {name}: {target} takes {', '.join(accepted) or 'nothing'}."
                )
            if not isinstance(value, DictConfig) and not fits(value, accepted[key]):
                raise ValueError(f"{name} must be {describe(accepted[key])}, got {value!r}.")
        check_targets(value, name, (accepted or {}).get(str(key)))


def part(path: str) -> type | None:
    """What the part at this place of a composition must be; None where it is none."""
    place = path.partition("[")[0]
    return hydra.utils.get_object(PARTS[place]) if place in PARTS else None


def _check_kind(node: DictConfig, path: str, kind: Any) -> None:
    """Refuse a ``_target_`` that makes something else than its place needs, as far as that is known before."""
    naming = node._target_ in NAMING
    key = "path" if naming else "_target_"
    if key not in node:
        raise ValueError(f"{path}.path is missing: {node._target_} has no default for it.")
    found = _object(node[key], f"{path}.{key}")
    options = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    if not any(_suits(found, naming, option) for option in options):
        raise ValueError(f"{path}.{key} must name {described(kind)}, got {node[key]!r}.")


def _suits(found: Any, naming: bool, kind: Any) -> bool:
    """Whether what is named (``naming``), or what it makes, may be of a kind; what is not known may be of any."""
    if get_origin(kind) is type:
        return naming and inspect.isclass(found) and _below(found, get_args(kind)[0])
    if not inspect.isclass(kind) or kind in (Any, inspect.Parameter.empty):
        return True
    if not inspect.isclass(found):
        with suppress(Exception):  # a builtin has no annotations
            found = get_type_hints(found).get("return")
    return not naming and (not inspect.isclass(found) or _below(found, kind))


def _below(found: type, kind: Any) -> bool:
    try:
        return issubclass(found, kind)
    except TypeError:  # a protocol whose members are not methods, and other kinds that cannot tell
        return True


def described(kind: Any) -> str:
    """What a name must stand for, in words.

    >>> described(Task), described(type[Task])
    ('a kind of Task', 'a subclass of Task')
    """
    if get_origin(kind) is type:
        return f"a subclass of {get_args(kind)[0].__name__}"
    return f"a kind of {kind.__name__}" if inspect.isclass(kind) else describe(kind)


def _object(name: Any, key: str) -> Any:
    """What a dotted name stands for.

    Raises:
        ValueError: nothing; calls it ``key``.
    """
    try:
        return hydra.utils.get_object(name)
    except Exception as error:
        raise ValueError(f"{key} names nothing that can be imported: {name!r}.") from error


def _required(target: str | None) -> list[str]:
    """The settings that a dataclass named by a ``_target_`` leaves to the configuration."""
    kind = None if target is None else hydra.utils.get_object(target)
    if not is_dataclass(kind):
        return []
    return [field.name for field in fields(kind) if field.default == MISSING]


def arguments(target: str) -> dict[str, Any] | None:
    """Arguments that a ``_target_`` takes with their annotations; None where it takes any.

    Raises:
        ValueError: there is no such class or function.
    """
    function: Any = _object(target, "_target_")
    kinds: dict[str, Any] = {}
    if is_dataclass(function):  # whose fields may come from other modules
        with suppress(NameError):
            kinds = get_type_hints(function)
    # A metaclass, as TorchRL's environments have, hides what __init__ takes.
    function = function.__init__ if inspect.isclass(function) else function
    if function is object.__init__:
        return {}
    try:
        signature = inspect.signature(function, eval_str=True)
    except NameError:  # annotations that exist for type checkers alone
        signature = inspect.signature(function)
    parameters = signature.parameters
    if any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values()):
        return None
    return {
        name: kinds.get(name, parameter.annotation)
        for name, parameter in parameters.items()
        if name != "self"
    }


def fits(value: Any, kind: Any) -> bool:
    """Whether a value is of an annotated kind; kinds that YAML cannot say fit everything.

    >>> fits(3, float), fits("3", float), fits(True, int), fits([1, 2.5], tuple[float, float])
    (True, False, False, True)
    """
    if kind in (int, float):
        numbers = (int, float) if kind is float else int
        return isinstance(value, numbers) and not isinstance(value, bool)
    if kind in _KINDS or kind is None:
        return isinstance(value, kind or NoneType)
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return any(fits(value, option) for option in inner)
    if origin is Literal:
        return value in inner
    if origin in (tuple, list, Sequence) and inner[0] in _KINDS:
        listed = isinstance(value, (list, tuple, ListConfig))
        if origin is tuple and Ellipsis not in inner and listed and len(value) != len(inner):
            return False
        return listed and all(fits(item, inner[0]) for item in value)
    if origin is Callable:
        return callable(value)
    if origin is type:
        return inspect.isclass(value)
    return not is_dataclass(kind)


def describe(kind: Any) -> str:
    """A kind in words.

    >>> describe(int | None)
    'a whole number or null'
    """
    if get_origin(kind) in (Union, UnionType):
        return " or ".join(describe(option) for option in get_args(kind))
    if get_origin(kind) is Literal:
        return " or ".join(map(str, get_args(kind)))
    if get_origin(kind) in (tuple, list, Sequence):
        inner = get_args(kind)
        size = f" of {len(inner)}" if get_origin(kind) is tuple and Ellipsis not in inner else ""
        return f"a list{size}, each {describe(inner[0])}"
    if get_origin(kind) is Callable:
        return "a function, by its _target_"
    if get_origin(kind) is type:
        return "a class, by its _target_"
    if is_dataclass(kind):
        return f"a mapping of {', '.join(field.name for field in fields(kind))}"
    return _KINDS.get(kind, str(kind))
