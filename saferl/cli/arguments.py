"""A command line as a user types it, and as Hydra reads it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

#: Settings that are paths.
PATHS = ("out", "checkpoint", "resume", "init")
#: Flags of Hydra that are followed by a value.
_VALUED = ("--config-dir", "-cd", "--config-name", "-cn", "--config-path", "-cp", "--package", "-p")
_VALUED += ("--cfg", "-c", "--experimental-rerun")
#: Values that Hydra reads as they are: words that are no number and no truth value, and what is in quotes.
_PLAIN = re.compile(
    r"(?!(?:true|false|nan|inf)$)(?:[a-z_./][\w./-]*)?|(['\"]).*\1", re.ASCII | re.IGNORECASE
)


def readable(arguments: Sequence[str]) -> list[str]:
    """The arguments in an order and a spelling that Hydra understands.

    - Flags may stand anywhere.
    - A path may hold any character: ``resume=run (1)``, ``out=algo=sac,seed=0``. With ``-m`` a comma parts two paths, unless
      there is a file of that name.
    - A job of ``-m`` is named by the settings in which the jobs differ.

    >>> readable(["seed=0", "-m", "algo=sac,asac", "out=my run"])[:4]
    ['-m', 'seed=0', 'algo=sac,asac', "out='my run'"]
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
    settings = [_quoted(setting, many) for setting in settings]
    return [*flags, *settings, *(_names(settings) if many else [])]


def _quoted(setting: str, many: bool) -> str:
    """A setting that is a path, in quotes where Hydra would read something else."""
    key, _, value = setting.partition("=")
    if key not in PATHS or _PLAIN.fullmatch(value) or "${" in value:
        return setting
    if many and "," in value and key != "out" and not Path(value).exists():
        return setting
    # A quote is written \', and backslashes are doubled before it and at the end.
    text = re.sub(r"(\\*)('|$)", lambda found: 2 * found[1] + (found[2] and "\\'"), value)
    return f"{key}='{text}'"


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
