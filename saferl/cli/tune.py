"""Search for hyper-parameters by optuna: settings of a training, some of them with a range.

  python -m saferl.tune algo=arsac task=gs frames=200000 "encoder.width=int(tag(log,interval(16,64)))" --trials 20

Ranges are Hydra's: interval(LOW,HIGH), tag(log,interval(LOW,HIGH)), int(interval(LOW,HIGH)), range(LOW,END,STEP), and
lists a,b,c. Interrupted, the same command goes on.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from saferl.cli.errors import MISTAKES, explain
from saferl.cli.launch import INTERRUPTED
from saferl.cli.settings import compose
from saferl.config import schema
from saferl.config.machine import check_machine
from saferl.config.space import Dimension, split

#: Settings that the search itself sets.
OWN = {"out": "give the search's folder with --out DIR", "resume": "the same command goes on"}


def main(arguments: list[str] | None = None) -> None:
    """Search, and print the best trials and the command of the best."""
    parser = argparse.ArgumentParser(
        "python -m saferl.tune",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "settings", nargs="*", metavar="KEY=VALUE", help="as python -m saferl takes them"
    )
    parser.add_argument("--trials", type=int, default=20, help="in all (%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("tune"), help="folder (%(default)s)")
    parser.add_argument("--sampler-seed", type=int, default=0, help="of what is tried")
    parser.add_argument(
        "--seeds", type=int, default=0, help="at the end, train the best with so many other seeds"
    )
    given = parser.parse_intermixed_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    try:
        fixed, space = checked(given.settings, given.trials)
        from saferl.cli.search import Search  # late: most mistakes need no torch

        Search(given.out, fixed, space, given.sampler_seed).run(given.trials, given.seeds)
    except MISTAKES as error:
        line = explain(error, "config", given.settings)
        raise SystemExit(f"error: {line}") from None
    except KeyboardInterrupt as interrupt:
        print(str(interrupt) or "Interrupted.", "The same command goes on.", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None


def checked(settings: Sequence[str], trials: int) -> tuple[list[str], list[Dimension]]:
    """What is fixed and what is searched, each end of it as it would be trained.

    Raises:
        ValueError, HydraException: something cannot be meant.
    """
    if find_spec("optuna") is None:
        raise ValueError("python -m saferl.tune needs optuna: pip install 'saferl[tune]'.")
    if trials < 1:
        raise ValueError(f"--trials must be >= 1, got {trials}.")
    fixed, space = split(settings)
    for key in (each.partition("=")[0].lstrip("+") for each in settings):
        if key in OWN:
            raise ValueError(f"{key} is not of a search: {OWN[key]}.")
    first = {each.key: each.ends[0] for each in space}
    for dimension in space:
        for end in dimension.ends:
            values = {**first, dimension.key: end}
            cfg = compose([*fixed, *(f"{key}={value}" for key, value in values.items())])
            schema.check(cfg)
            check_machine(cfg)
    return fixed, space
