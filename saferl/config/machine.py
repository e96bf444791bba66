"""What no machine could serve, or this one cannot: refused at once, with what is there."""

from __future__ import annotations

import math
import os
import sys
from contextlib import suppress
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from saferl.config.flat import flat

#: Bytes that an environment takes at least, and copies of a layer in training: its weights, their gradients, both
#: moments of Adam, the targets.
_ENVIRONMENT, _COPIES = 10_000, 5
#: Uses of a number than which no training has more.
_MOST = {"learning.updates_per_frame": 1_000, "learning.epochs": 10_000}


def cores() -> int:
    """How many this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not Linux
        return os.cpu_count() or 1


def memory() -> int:
    """Bytes that this process or its container may have in all, and no end where the system does not say."""
    try:
        import resource
    except ImportError:  # not a Unix
        return sys.maxsize
    there = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    if (allowed := resource.getrlimit(resource.RLIMIT_AS)[0]) != resource.RLIM_INFINITY:
        there.append(allowed)
    with suppress(OSError, ValueError):  # no control group, or one without a limit
        there.append(int(Path("/sys/fs/cgroup/memory.max").read_text()))
    return min(there)


def check_machine(cfg: DictConfig) -> None:
    """Refuse numbers of a training or a test that this machine cannot serve.

    Raises:
        ValueError: names the setting, what it would take and what is there.
    """
    settings = {
        name: value
        for name, value in flat(OmegaConf.to_container(cfg, resolve=False)).items()
        if isinstance(value, (int, float)) and not isinstance(value, bool)
    }
    there, usable = memory(), max(2, cores())  # two are the default everywhere
    for name, value in settings.items():
        if name == "threads" and value > usable:
            raise ValueError(f"threads must be <= {usable}, the cores that are there, got {value}.")
        if name.rpartition(".")[2] == "num_envs" and value * _ENVIRONMENT > there:
            raise ValueError(
                f"{name} must be <= {there // _ENVIRONMENT}, as each takes 10 kB or more and {_gib(there)} are there, "
                f"got {value}."
            )
        if name.startswith("encoder.") and name.endswith("width"):
            most = math.isqrt(there // (4 * _COPIES))
            if value > most:
                raise ValueError(
                    f"{name} must be <= {most}, as a layer of {value} by {value} takes "
                    f"{_gib(4 * _COPIES * value**2)} in training and {_gib(there)} are there, got {value}."
                )
        if value > _MOST.get(name, math.inf):
            raise ValueError(f"{name} must be <= {_MOST[name]}, got {value}.")


def _gib(size: float) -> str:
    return f"{size / 2**30:,.0f} GiB"
