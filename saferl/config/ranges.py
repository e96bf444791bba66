"""Ranges and choices of settings, each refused in one line; it needs no tensor."""

from __future__ import annotations

import math
from importlib.util import find_spec
from typing import Any

ORDERS = ("joint", "sequential")
DEVICES = ("auto", "cpu", "cuda")
DRAWN = ("none", "all", "collisions", "frozen", "success")
FORMATS = ("gif", "mp4", "png")
TRACED = ("none", "collisions", "all")
#: Forms of an exported policy, and the packages that each takes beside torch.
EXPORTS = {"torch": (), "pt2": (), "onnx": ("onnx", "onnxscript", "onnxruntime")}
OBSERVATIONS = ("features", "state")


def at_least(least: float, settings: Any, *names: str, prefix: str = "") -> None:
    """Refuse settings below ``least``, and those that are not finite; None passes."""
    for name in names:
        value = getattr(settings, name)
        if value is not None and not least <= value < math.inf:
            raise ValueError(f"{prefix}{name} must be >= {least}, got {value}.")


def limits(settings: Any, *names: str) -> None:
    """Refuse limits that are neither a finite number >= 0 nor several of them, in a list or by name; None passes."""
    for name in names:
        given = getattr(settings, name)
        each = {} if given is None else {name: given}
        if isinstance(given, dict):
            each = {f"{name}.{key}": value for key, value in given.items()}
        elif isinstance(given, list):
            each = {f"{name}[{index}]": value for index, value in enumerate(given)}
        for key, value in each.items():
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                raise ValueError(f"{key} must be a number, got {value!r}.")
            if not 0 <= value < math.inf:
                raise ValueError(f"{key} must be >= 0, got {value}.")


def above(least: float, settings: Any, *names: str, prefix: str = "") -> None:
    """Refuse settings of ``least`` and below, and those that are not finite; None passes."""
    for name in names:
        value = getattr(settings, name)
        if value is not None and not least < value < math.inf:
            raise ValueError(f"{prefix}{name} must be > {least}, got {value}.")


def share(settings: Any, *names: str, prefix: str = "") -> None:
    """Refuse settings outside [0, 1]."""
    for name in names:
        value = getattr(settings, name)
        if not 0 <= value <= 1:
            raise ValueError(f"{prefix}{name} must be >= 0 and <= 1, got {value}.")


def one_of(choices: tuple[str, ...], settings: Any, name: str, prefix: str = "") -> None:
    """Refuse what is not among the choices."""
    if getattr(settings, name) not in choices:
        raise ValueError(
            f"{prefix}{name} must be one of {', '.join(choices)}, got {getattr(settings, name)!r}."
        )


def drawing(settings: Any, prefix: str = "") -> None:
    """Refuse pictures of no kind, and those that lack the package that makes them."""
    one_of(DRAWN, settings, "draw", prefix)
    at_least(1, settings, "draw_most", prefix=prefix)
    one_of(FORMATS, settings, "draw_format", prefix)
    if settings.draw_format == "mp4" and find_spec("imageio_ffmpeg") is None:
        raise ValueError(
            f"{prefix}draw_format=mp4 needs imageio-ffmpeg: pip install 'saferl[video]'."
        )


def seeded(settings: Any) -> None:
    """Refuse a seed that an episode's cannot follow from."""
    at_least(0, settings, "seed")
    if settings.seed >= 2**31:
        raise ValueError(f"seed must be < 2**31, got {settings.seed}.")
