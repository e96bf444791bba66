"""Refuse a configuration that cannot be meant, before anything is built from it."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import hydra
from omegaconf import DictConfig, ListConfig, OmegaConf

from saferl.envs.intersection.drivers import DRIVERS
from saferl.paths import config_dir

_KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}
_KINDS |= {NoneType: "null"}

#: Kind, lowest and highest value of each number that no class checks itself.
TRAINING = {
    "seed": (int, 0, 2**31 - 1),
    "threads": (int, 1, math.inf),
    "compile": (bool, 0, 1),
    "episodes": (int | None, 1, math.inf),
    "frames": (int | None, 1, math.inf),
    "gamma": (float, 0, 1),
    "gae_lambda": (float, 0, 1),
    "cost_limit": (float, 0, math.inf),
    "cost_target": (Literal["max", "mean"], 0, 0),
    "cost_backup": (Literal["sum", "reach"], 0, 0),
    "batch_size": (int, 1, math.inf),
    "buffer_size": (int, 1, math.inf),
    "warmup_frames": (int, 1, math.inf),
    "demonstrations": (int, 0, math.inf),
    "updates_per_frame": (float, 0, math.inf),
    "rollout_frames": (int, 1, math.inf),
    "epochs": (int, 1, math.inf),
    "update_order": (Literal["joint", "sequential"], 0, 0),
    "reward_scale": (float, 0, math.inf),
    "tau": (float, 0, 1),
    "target_entropy": (Literal["auto"] | float, -math.inf, math.inf),
    "alpha_init": (float, 0, math.inf),
    "initial_std": (float, 0.02, math.inf),
    "exploration": (float, 0, 1),
    "exploration_hold": (int, 1, math.inf),
    "multiplier_lr": (float, 0, math.inf),
    "record_every": (int, 1, math.inf),
    "save_every": (int, 1, math.inf),
    "save_minutes": (float | None, 0, math.inf),
    "evaluation.episodes": (int, 1, math.inf),
    "evaluation.num_envs": (int, 1, math.inf),
    "evaluation.drivers": (list[str], 0, 0),
    "evaluation.gif": (int, 0, math.inf),
    "evaluation.policy_frequency": (int, 1, math.inf),
    "env.num_envs": (int, 1, math.inf),
    "collector.frames_per_env": (int, 1, math.inf),
    "encoder.policy.width": (int, 1, math.inf),
    "critic.members": (int, 1, math.inf),
    "critic.layer_norm": (bool | None, 0, 1),
    "cost_critic.members": (int, 0, math.inf),
    "cost_critic.outputs": (int | None, 1, math.inf),
    "cost_critic.layer_norm": (bool | None, 0, 1),
    "init": (str | None, 0, 0),
    "algo_name": (str, 0, 0),
}
POSITIVE = (
    "updates_per_frame",
    "reward_scale",
    "tau",
    "alpha_init",
    "multiplier_lr",
    "save_minutes",
)
TESTING = {
    "episodes": (int, 1, math.inf),
    "seed": (int, 0, 2**31 - 1),
    "threads": (int, 1, math.inf),
    "gif": (int, 0, math.inf),
    "project": (bool, 0, 1),
    "compile": (bool, 0, 1),
    "checkpoint": (str | None, 0, 0),
    "pretrained": (str | None, 0, 0),
    "policy": (str | None, 0, 0),
}


def check_training(cfg: DictConfig) -> None:
    """Check the configuration of a training run.

    Raises:
        ValueError: an unknown key, a value of another kind or out of range; names key, value and
            what is allowed.
    """
    check_keys(cfg)
    check_numbers(cfg, TRAINING)
    if {"/", "\\"} & set(cfg.algo_name):
        raise ValueError(f"algo_name must be without / and \\, got {cfg.algo_name!r}.")
    for name, rates in cfg.lr.items():
        pair = isinstance(rates, ListConfig) and len(rates) == 2
        if not pair or not all(fits(rate, float) and 0 <= rate < math.inf for rate in rates):
            raise ValueError(f"lr.{name} must be [first, last], both >= 0, got {rates!r}.")
    for name in cfg.evaluation.drivers:
        if name not in DRIVERS:
            raise ValueError(
                f"evaluation.drivers must be among {', '.join(DRIVERS)}, got {name!r}."
            )
    for key in ("drivers", "gif"):
        if cfg.evaluation[key] and "rows" not in cfg.task:
            raise ValueError(
                f"evaluation.{key} is of the road, which task={cfg.task.task} has not, got {cfg.evaluation[key]}."
            )
    for key in ("batch_size", "demonstrations"):
        if cfg.buffer_size < cfg[key]:
            raise ValueError(f"buffer_size must be >= {key}, got {cfg.buffer_size} and {cfg[key]}.")
    if cfg.experience._target_.endswith("Replay"):
        collected = cfg.env.num_envs * cfg.collector.frames_per_env
        if cfg.buffer_size < collected:
            raise ValueError(
                f"buffer_size must be >= env.num_envs * collector.frames_per_env, got {cfg.buffer_size} and {collected}."
            )
        if cfg.frames is not None and cfg.frames < cfg.warmup_frames:
            raise ValueError(
                f"warmup_frames must be <= frames, or nothing is learned, got {cfg.warmup_frames} and {cfg.frames}."
            )
    check_targets(cfg)


def check_testing(cfg: DictConfig) -> None:
    """Check the configuration of a test.

    Raises:
        ValueError: as :func:`check_training`.
    """
    check_numbers(cfg, TESTING)
    check_targets(cfg)


def check_numbers(cfg: DictConfig, table: dict[str, tuple[Any, float, float]]) -> None:
    """Check values against a table of kinds and ranges.

    Raises:
        ValueError: names the key, the value and what is allowed.
    """
    for key, (kind, low, high) in table.items():
        value = OmegaConf.select(cfg, key)
        within = not fits(value, float) or (
            math.isfinite(value) and low <= value <= high and (value > 0 or key not in POSITIVE)
        )
        if fits(value, kind) and within:
            continue
        allowed = describe(kind)
        if fits(0, kind) and low > -math.inf:
            more = "> 0" if key in POSITIVE else f">= {low}"
            allowed += f", {more}" if high == math.inf else f", {more} and <= {high}"
        raise ValueError(f"{key} must be {allowed}, got {value!r}.")


def check_keys(cfg: DictConfig) -> None:
    """Refuse keys that no file of ``conf`` has, which is how a typo in an experiment shows.

    Raises:
        ValueError: names the key and those beside it.
    """
    root = Path(config_dir())
    primary = OmegaConf.load(root / "config.yaml")
    assert isinstance(primary, DictConfig)
    groups = {folder.name for folder in root.iterdir() if folder.is_dir()} - {"hydra"}
    known = (set(primary) | groups | {"algo_name"}) - {"defaults", "hydra", "algo", "experiment"}
    _check_like(cfg, [primary], "", known)
    for name in ("lr", "evaluation"):
        _check_like(cfg[name], [primary[name]], f"{name}.")
    for group in groups & set(cfg):
        if isinstance(cfg[group], DictConfig) and "_target_" not in cfg[group]:
            files = [OmegaConf.load(path) for path in (root / group).glob("*.yaml")]
            _check_like(cfg[group], files, f"{group}.")


def _check_like(node: DictConfig, files: list, prefix: str, known: set | None = None) -> None:
    """Refuse keys that none of the files has, and plain values where they have mappings."""
    files = [OmegaConf.to_container(file, resolve=False) for file in files]
    known = known or {key for file in files for key in file}
    for key, value in node.items():
        if key not in known:
            raise ValueError(
                f"unknown key {prefix}{key!s}; choose from {', '.join(sorted(map(str, known)))}."
            )
        like = {type(file[key]): file[key] for file in files if key in file}
        if dict in like and not isinstance(value, DictConfig) and type(value) not in like:
            raise ValueError(
                f"{prefix}{key!s} must be a mapping of {', '.join(like[dict])}, got {value!r}."
            )


def check_targets(node: Any, path: str = "", kind: Any = None) -> None:
    """Check each ``_target_`` below a node against its signature (names and kinds of arguments), each
    mapping that stands for a dataclass (``kind``) against its fields, and that every number is finite.

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
    target = node.get("_target_")
    accepted = None if target is None else arguments(target)
    if target is None and is_dataclass(kind):
        target, accepted = f"{path}, a {kind.__name__},", get_type_hints(kind)  # pyright: ignore
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


def arguments(target: str) -> dict[str, Any] | None:
    """Arguments that a ``_target_`` takes with their annotations; None where it takes any.

    Raises:
        ValueError: there is no such class or function.
    """
    try:
        function = hydra.utils.get_object(target)
    except Exception as error:
        raise ValueError(f"_target_ names nothing that can be imported: {target!r}.") from error
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
    return {name: p.annotation for name, p in parameters.items() if name != "self"}


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
