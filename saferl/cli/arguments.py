"""A command line as a user types it, and as Hydra reads it."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

#: Settings that are paths.
PATHS = ("out", "checkpoint", "resume", "init")
#: Flags of Hydra that are followed by a value.
_VALUED = ("--config-dir", "-cd", "--config-name", "-cn", "--config-path", "-cp", "--package", "-p")
_VALUED += ("--cfg", "-c", "--experimental-rerun")
#: Paths that Hydra reads as they are: words that are no number and no truth value, and what is in quotes.
_PLAIN = re.compile(
    r"(?!(?:true|false|nan|inf)$)(?:(?:[a-z_/]|\.(?!\d))[\w./-]*)?|(['\"]).*\1",
    re.ASCII | re.IGNORECASE,
)
_NAMED = re.compile(r"^(cost|risk)_limit\.")
#: Functions by which a sweep may list paths.
_LISTING = re.compile(r"(?:choice|glob|shuffle|sort)\(.*\)")


def readable(arguments: Sequence[str]) -> list[str]:
    """The arguments in an order and a spelling that Hydra understands.

    - Flags may stand anywhere.
    - A path may hold any character: ``resume=run (1)``, ``out=algo=sac,seed=0``. Only ``${...}`` is looked up, and with ``-m`` a
      comma parts two paths, unless there is a file of that name.
    - A limit on one of several costs is set by its name: ``cost_limit.speed=0.1``.
    - A job of ``-m`` is named by the settings in which the jobs differ.

    >>> readable(["-m", "seed=0", "algo=sac,asac", "out=my run"])
    ['seed=0', 'algo=sac,asac', "out='my run'", "hydra.job.config.override_dirname.exclude_keys=['seed','out']", '-m']
    """
    flags: list[str] = []
    settings: list[str] = []
    given = iter(arguments)
    for argument in given:
        if argument.startswith("-"):
            flags.append(argument)
            if argument in _VALUED:
                flags += filter(None, [next(given, None)])
        else:
            settings.append(argument)
    many = any(flag in ("-m", "--multirun") for flag in flags)
    # In place of a number for one cost, which has no names to override.
    settings = [_NAMED.sub(r"+\g<0>", _quoted(setting, many)) for setting in settings]
    return [*settings, *(_names(settings) if many else []), *flags]


def _quoted(setting: str, many: bool) -> str:
    """A setting that is a path, in quotes where Hydra would read something else."""
    key, _, value = setting.partition("=")
    if key not in PATHS or "${" in value:
        return setting
    # All jobs of a sweep share ``out``.
    several = many and key != "out" and not os.path.exists(value)
    if several and _LISTING.fullmatch(value):
        return setting
    return f"{key}={','.join(map(_in_quotes, value.split(',') if several else [value]))}"


def _in_quotes(path: str) -> str:
    if path == "null" or _PLAIN.fullmatch(path):
        return path
    # A quote is written \\', and backslashes are doubled before it and at the end.
    text = re.sub(r"(\\*)('|$)", lambda found: 2 * found[1] + (found[2] and "\\'"), path)
    return f"'{text}'"


def _names(settings: Sequence[str]) -> list[str]:
    """Leaves the settings that all jobs share out of their folders' names."""
    try:
        parsed = OverridesParser.create().parse_overrides(list(settings))
    except HydraException:  # the composition says what is wrong
        return []
    differing = {each.key_or_group for each in parsed if each.is_sweep_override()}
    shared = dict.fromkeys(each.key_or_group for each in parsed)
    names = ",".join(f"'{key}'" for key in shared if key not in differing)
    return [f"hydra.job.config.override_dirname.exclude_keys=[{names}]"]
