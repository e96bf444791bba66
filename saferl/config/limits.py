"""What the limits of a problem bound, and whether an algorithm reads those that it is given."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from omegaconf import DictConfig, OmegaConf

from saferl.config.flat import flat

log = logging.getLogger(__name__)

#: What each limit is on.
BOUNDS = {
    "cost_limit": "the mean cost of an episode",
    "risk_limit": "the discounted cost ahead in each state",
}

#: In place of one that a task leaves to its user.
USUAL = {"cost_limit": 0.1, "risk_limit": 0.05}


def readers(cfg: DictConfig) -> dict[str, list[str]]:
    """The settings that each limit goes into, of a configuration that is not resolved."""
    settings = flat(OmegaConf.to_container(cfg, resolve=False))
    return {
        name: [key for key, value in settings.items() if f"${{{name}}}" in str(value)]
        for name in BOUNDS
    }


def check_limits(cfg: DictConfig, overrides: Sequence[str]) -> None:
    """Refuse a limit that is given in place of the one that an algorithm has; write the usual one where none is given.

    A ``cost_limit`` that an algorithm without any constraint is given stands beside its figures.

    Args:
        cfg: of a training, not resolved.
        overrides: of the command line.

    Raises:
        ValueError: names the limit, and what the algorithm reads.
    """
    read = {name: keys for name, keys in readers(cfg).items() if keys}
    for name, keys in read.items():
        if cfg[name] is None:
            cfg[name] = USUAL[name]
            log.warning(
                "%s=%g, as none is given: it bounds %s, which %s of algo=%s takes.",
                name,
                cfg[name],
                BOUNDS[name],
                " and ".join(keys),
                cfg.algo_name,
            )
    for key, value in flat(OmegaConf.to_container(cfg, resolve=False)).items():
        name = key.rpartition(".")[2]
        number = "." in key and name in BOUNDS and isinstance(value, (int, float))
        if number and value != cfg[name]:
            raise ValueError(f"{key} follows from {name}: set {name}={value}.")
    given = {override.partition("=")[0].lstrip("+") for override in overrides}
    for name in BOUNDS:
        if name in given and name not in read and (read or name != "cost_limit"):
            has = " and ".join(f"{other}, on {BOUNDS[other]}" for other in read) or "no limit"
            about = f"{name} is on {BOUNDS[name]}, which algo={cfg.algo_name} does not bound: it has {has}."
            if not given & set(read):
                raise ValueError(about)
            log.warning(about)  # a sweep gives both
