"""A configuration that comes with a run or a policy, perhaps somebody else's: it may name parts, not run code."""

from __future__ import annotations

import importlib.util
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hydra

#: Classes that a file may name.
_PARTS = re.compile(
    r"(?:saferl\.(?:algorithms|modules|objectives|envs|envs\.transforms|envs\.intersection|training\.(?:signals|collectors))"
    r"|torchrl\.(?:objectives|modules|record\.loggers)|torch\.nn)\.[A-Z]\w*"
)
#: By which a file names a class or a function, its ``path``.
NAMING = ("hydra.utils.get_class", "hydra.utils.get_method")
#: What a node may say to Hydra; positional arguments would not be looked at.
_HYDRAS = ("_target_", "_convert_", "_partial_", "_recursive_")
#: What folders are called by.
_FOLDERS = ("algo_name", "task.task")
#: Names of packages, parted by commas, whose parts a file may name, too.
TRUST = "SAFERL_TRUST"


def check_origin(settings: Any, path: Path) -> None:
    """Refuse what a file could run code by, or write outside its folder, before anything is built.

    It may name classes of saferl, TorchRL and ``torch.nn``, and classes and functions of one's own modules: those that are neither
    Python's nor installed nor lie beside the file, or that the environment variable ``SAFERL_TRUST`` names. It may look
    nothing up, as a run's file is written without interpolations.

    Args:
        settings: of the file, plain mappings and lists.
        path: of the file.

    Raises:
        ValueError: names the setting.
    """
    for name, value in _leaves(settings):
        *_, key = keys = name.split(".")
        if "${" in f"{name} {value}":  # a run's file is written without
            raise ValueError(f"{path}: {name} looks something up, {value!r}, which a file may not.")
        if unknown := [each for each in keys if each[:1] == "_" and each not in _HYDRAS]:
            raise ValueError(
                f"{path}: {name} may not be set by a file, as {unknown[0]} is not known."
            )
        if value is not None and ("_target_" in keys or key == "path"):
            naming = key == "_target_" and value in NAMING
            if (
                not naming
                and not _PARTS.fullmatch(str(value))
                and not _own(str(value), path.parent)
            ):
                raise ValueError(
                    f"{path}: {name} names {value!r}, which a file may not call. If the file is yours and the package is "
                    f"installed, say so: {TRUST}=package."
                )
        elif name == "task.id":
            module = str(value).rpartition(":")[0].partition(".")[0]
            if module in sys.stdlib_module_names:
                raise ValueError(f"{path}: {name} imports {module!r}, which a file may not.")
        elif (name in _FOLDERS or name.startswith("logger.")) and set(str(value)) & {"/", "\\"}:
            raise ValueError(f"{path}: {name} must be without / and \\, got {value!r}.")


def _leaves(node: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The settings of mappings and lists by dotted names."""
    if not isinstance(node, (dict, list)):
        yield prefix, node
        return
    for key, below in node.items() if isinstance(node, dict) else enumerate(node):
        yield from _leaves(below, f"{prefix}.{key}".removeprefix("."))


def _own(target: str, folder: Path) -> bool:
    """Whether a name is of a module of one's own, and was not merely imported into it.

    Args:
        target: the name.
        folder: of the file that says it, whose own modules are its author's.
    """
    package = target.partition(".")[0]
    trusted = package in os.environ.get(TRUST, "").split(",")
    if not trusted:
        if package in sys.stdlib_module_names or package == "saferl":
            return False
        try:
            spec = importlib.util.find_spec(package)
        except (ImportError, ValueError):
            return False
        if spec is None or spec.origin is None:
            return False
        place = Path(spec.origin).resolve()
        if {"site-packages", "dist-packages"} & set(place.parts):
            return False
        if folder.resolve() in place.parents:
            return False
    try:
        found = hydra.utils.get_object(target)
    except Exception:  # it is told when it is built
        return True
    return str(getattr(found, "__module__", "")).partition(".")[0] == package
