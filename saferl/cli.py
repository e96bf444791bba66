"""From a command line to a command: Hydra's composition, and one clear line for every mistake."""

from __future__ import annotations

import difflib
import os
import sys
from contextlib import suppress
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, InstantiationException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from saferl.paths import config_dir

#: What a user can get wrong; any other exception is a fault of ours and keeps its trace.
MISTAKES = (ValueError, OSError, HydraException, OmegaConfBaseException)
PATHS = ("out", "checkpoint", "resume", "init")
INTERRUPTED = 130


def launch(command: str, config: str) -> None:
    """Run a function of :mod:`saferl.commands` on the configuration that ``sys.argv`` describes.

    Exits with 0, with 1 after one line about a mistake, or with 130 after Ctrl-C.
    ``HYDRA_FULL_ERROR=1`` shows the trace instead of the line.
    """
    # Threads of GNU's OpenMP that wait awake without end take the cores from another run's.
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    before = os.environ.get("HYDRA_FULL_ERROR")
    # Hydra prints its own exceptions over many lines unless it is told to let them pass.
    os.environ["HYDRA_FULL_ERROR"] = "1"

    def run(cfg: DictConfig) -> None:
        from saferl import commands  # late: help and most mistakes need no torch

        try:
            for key in PATHS:
                if cfg.get(key) == "":
                    raise ValueError(f"{key} must be a path, got ''.")
            getattr(commands, command)(cfg)
        except BaseException as error:
            _drop_if_empty(Path(HydraConfig.get().runtime.output_dir))
            if isinstance(error, MISTAKES) and before != "1":
                raise SystemExit(f"error: {explain(error)}") from None
            raise

    try:
        hydra.main(version_base="1.3", config_path=config_dir(), config_name=config)(run)()
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except MISTAKES as error:
        if before == "1":
            raise
        raise SystemExit(f"error: {explain(error, config, sys.argv[1:])}") from None
    except KeyboardInterrupt as interrupt:
        print(str(interrupt) or "Interrupted.", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None
    finally:
        del os.environ["HYDRA_FULL_ERROR"]
        if before is not None:
            os.environ["HYDRA_FULL_ERROR"] = before


def _drop_if_empty(folder: Path) -> None:
    """Undo the output folder, which Hydra makes before anything can be checked."""
    here = Path.cwd()
    with suppress(OSError):  # it is not empty, or not there
        while folder != here:
            folder.rmdir()
            folder = folder.parent if folder.is_relative_to(here) else here


def explain(error: Exception, config: str = "config", arguments: list[str] | None = None) -> str:
    """A mistake in one line: which key, what was given, what is expected."""
    if isinstance(error, MissingConfigException) and error.options:
        group, _, choice = str(error.missing_cfg_file).rpartition("/")
        return f"{group} must be one of {', '.join(error.options)}, got {choice!r}."
    if isinstance(error, InstantiationException):
        place = str(error).rpartition("full_key: ")[2]
        cause = error.__cause__ or str(error).splitlines()[0]
        return f"{cause} (in {place})" if place != str(error) else str(cause)
    message = " ".join(str(error).split())
    if message.startswith("Could not override"):
        return _unknown_key(message.split("'")[1], config, arguments or [])
    if isinstance(error, HydraException):
        return message.partition(" See https")[0]
    return message


def _unknown_key(key: str, config: str, arguments: list[str]) -> str:
    """Tells what stands beside a key that does not exist."""
    rest = [a for a in arguments if "=" in a and not a.lstrip("+~").startswith((key, "-"))]
    try:
        with hydra.initialize_config_dir(config_dir(), version_base="1.3"):
            composed = hydra.compose(config, rest)
    except HydraException:
        return f"unknown key {key!r}; --help lists the keys."
    parent, _, name = key.rpartition(".")
    node = OmegaConf.select(composed, parent) if parent else composed
    while parent and not isinstance(node, DictConfig):
        parent, _, name = parent.rpartition(".")
        node = OmegaConf.select(composed, parent) if parent else composed
    choices = [str(k) for k in node if k != "_target_"]
    if "_target_" in node:
        from saferl import validation  # late, as it imports the target

        accepted = validation.arguments(node._target_)
        if accepted == {}:
            return f"unknown key {key!r}; {node._target_} takes nothing."
        choices = list(accepted or choices)
    if not choices:  # an empty mapping: what it may hold, its class says
        return f"unknown key {key!r}; {parent} is empty by default, set it with +{key}=..."
    if name in choices:
        return f"{key!r} stands at the default of its class; set it with +{key}=..."
    close = difflib.get_close_matches(name, choices, n=1)
    hint = f" (did you mean {close[0]}?)" if close else ""
    return f"unknown key {key!r}{hint}; choose from {', '.join(choices)}."
