"""What the limits of a problem bound, and whether an algorithm reads those that it is given."""

from __future__ import annotations

from collections.abc import Sequence

from omegaconf import DictConfig, OmegaConf

from saferl.evaluation.compare import flat

#: What each limit is on.
BOUNDS = {
    "cost_limit": "the mean cost of an episode",
    "risk_limit": "the discounted cost ahead in each state",
}


def readers(cfg: DictConfig) -> dict[str, list[str]]:
    """The settings that each limit goes into, of a configuration that is not resolved."""
    settings = flat(OmegaConf.to_container(cfg, resolve=False))
    return {
        name: [key for key, value in settings.items() if f"${{{name}}}" in str(value)]
        for name in BOUNDS
    }


def check_limits(cfg: DictConfig, overrides: Sequence[str]) -> None:
    """Refuse a limit that an algorithm lacks, or that is given in place of the one that it has.

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
            raise ValueError(
                f"{name} must be given: it bounds {BOUNDS[name]}, which {' and '.join(keys)} of "
                f"algo={cfg.algo_name} takes."
            )
    given = {override.partition("=")[0].lstrip("+") for override in overrides}
    for name in BOUNDS:
        if name in given and name not in read and not given & set(read):
            has = " and ".join(f"{other}, on {BOUNDS[other]}" for other in read) or "no limit"
            if read or name != "cost_limit":
                raise ValueError(
                    f"{name} is on {BOUNDS[name]}, which algo={cfg.algo_name} does not bound: it has {has}."
                )
