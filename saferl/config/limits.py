"""What the limits of a problem bound, and whether an algorithm reads those that it is given."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

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


def order_limits(cfg: DictConfig, costs: Sequence[str], given: Collection[str] = ()) -> None:
    """Write each limit as parts read it: a number of one cost, of several a list in their order. One number is no limit of
    several costs: where no part reads it and nobody gave it, none stands.

    Args:
        cfg: of a training, not resolved, or that of a run.
        costs: their names, ``task.costs``.
        given: limits that the command line gives.

    Raises:
        ValueError: it is of other costs, or not of all; names the limit and the costs.
    """
    read = readers(cfg)
    for name in BOUNDS:
        cfg[name] = ordered(name, cfg[name], costs, bool(read[name]) or name in given)


def ordered(name: str, limit: Any, costs: Sequence[str], needed: bool = True) -> Any:
    """One limit, see :func:`order_limits`.

    >>> ordered("cost_limit", {"speed": 0.2, "road": 0.1}, ["road", "speed"])
    [0.1, 0.2]
    >>> ordered("cost_limit", [0.1], ["road", "speed"])
    Traceback (most recent call last):
    ...
    ValueError: cost_limit must be a limit for each of task.costs=[road,speed], as cost_limit=[1,2] or cost_limit.road=1 \
cost_limit.speed=2, got [0.1].
    """
    if isinstance(limit, (DictConfig, ListConfig)):
        limit = OmegaConf.to_container(limit)
    found = limit
    if isinstance(limit, Mapping):
        for key in limit:
            if key not in costs:
                raise ValueError(
                    f"{name}.{key} is of no cost: choose from {', '.join(costs)} (task.costs)."
                )
        found = [limit[key] for key in costs if key in limit]
    count = len(costs)
    if isinstance(found, list) and len(found) == count:
        return found if count > 1 else found[0]
    if not isinstance(found, list) and (count == 1 or not needed):
        return found if count == 1 else None
    if count == 1:
        raise ValueError(f"{name} must be one number, as task.costs is {costs[0]}, got {limit}.")
    each = " ".join(f"{name}.{key}={index + 1}" for index, key in enumerate(costs))
    numbers = ",".join(str(index + 1) for index in range(count))
    got = "null" if limit is None else limit
    raise ValueError(
        f"{name} must be a limit for each of task.costs=[{','.join(costs)}], as {name}=[{numbers}] or {each}, got {got}."
    )


def check_limits(
    cfg: DictConfig, overrides: Sequence[str], costs: Sequence[str] = ("cost",)
) -> None:
    """Refuse a limit that is given in place of the one that an algorithm has; write the usual one where none is given.

    A ``cost_limit`` that an algorithm without any constraint is given stands beside its figures.

    Args:
        cfg: of a training, not resolved.
        overrides: of the command line.
        costs: names of what is limited, see :func:`order_limits`.

    Raises:
        ValueError: names the limit, and what the algorithm reads.
    """
    given = {override.partition("=")[0].lstrip("+") for override in overrides}
    given = {key.partition(".")[0] if key.partition(".")[0] in BOUNDS else key for key in given}
    order_limits(cfg, costs, given)
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
    for name in BOUNDS:
        if name in given and name not in read and (read or name != "cost_limit"):
            has = " and ".join(f"{other}, on {BOUNDS[other]}" for other in read) or "no limit"
            about = f"{name} is on {BOUNDS[name]}, which algo={cfg.algo_name} does not bound: it has {has}."
            if not given & set(read):
                raise ValueError(about)
            log.warning(about)  # a sweep gives both
