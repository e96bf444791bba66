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
    r"(?:saferl\.(?:algorithms|modules|objectives|envs|envs\.transforms|envs\.intersection(?:\.foresight|\.drivers)?|training\.(?:signals|collectors))"
    r"|torchrl\.(?:objectives|modules|record\.loggers)|torch\.nn)\.[A-Z]\w*"
)
#: By which a file names a class or a function, its ``path``.
NAMING = ("hydra.utils.get_class", "hydra.utils.get_method")
#: What a node may say to Hydra; positional arguments would not be looked at.
_HYDRAS = ("_target_", "_convert_", "_partial_", "_recursive_")
#: What folders are called by.
_FOLDERS = ("algo_name", "task.task", "projector.name")
#: Names of packages, parted by commas, whose parts a file may name, too.
TRUST = "SAFERL_TRUST"


def check_origin(settings: Any, path: Path) -> None:
    """Refuse what a file could run code by, or write outside its folder, before anything is built.

    It may name classes of saferl, TorchRL and ``torch.nn``, and classes and functions of one's own modules: those that are neither
    Python's nor installed nor came with the file, or that the environment variable ``SAFERL_TRUST`` names. An environment
    (``task.id``) may be of an installed package, too. It may look nothing up, as a run's file is written without
    interpolations.

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
            if module and not _elsewhere(module, path.parent):
                raise ValueError(
                    f"{path}: {name} imports {module!r}, which a file may not. If the file is yours, say so: {TRUST}={module}."
                )
        elif (name in _FOLDERS or name.startswith("logger.")) and (
            set(str(value)) & {"/", "\\"} or value in (".", "..")
        ):
            raise ValueError(f"{path}: {name} must be a name without / and \\, got {value!r}.")


def _leaves(node: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The settings of mappings and lists by dotted names."""
    if not isinstance(node, (dict, list)):
        yield prefix, node
        return
    for key, below in node.items() if isinstance(node, dict) else enumerate(node):
        yield from _leaves(below, f"{prefix}.{key}".removeprefix("."))


def _elsewhere(package: str, folder: Path) -> bool:
    """Whether a package is trusted, or neither Python's nor came with a file.

    Args:
        package: its name.
        folder: of the file, whose author's are the modules below it and the packages around it. A folder without an
            ``__init__.py`` counts as such, too, as it may be anybody's.
    """
    if package in os.environ.get(TRUST, "").split(","):
        return True
    if package in sys.stdlib_module_names:
        return False
    try:
        spec = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return False
    if spec is None:  # it is told when it is imported
        return True
    if spec.origin is None:
        return False
    place, folder = Path(spec.origin).resolve(), folder.resolve()
    around = place.name == "__init__.py" and place.parent in (folder, *folder.parents)
    return not around and folder not in place.parents


def _own(target: str, folder: Path) -> bool:
    """Whether a name is of a module of one's own, and was not merely imported into it.

    Args:
        target: the name.
        folder: of the file that says it, whose own modules are its author's.
    """
    package = target.partition(".")[0]
    if package == "saferl" or not _elsewhere(package, folder):
        return False
    if package not in os.environ.get(TRUST, "").split(","):
        spec = importlib.util.find_spec(package)
        if spec is None or {"site-packages", "dist-packages"} & set(Path(str(spec.origin)).parts):
            return False
    try:
        found = hydra.utils.get_object(target)
    except Exception:  # it is told when it is built
        return True
    return str(getattr(found, "__module__", "")).partition(".")[0] == package
