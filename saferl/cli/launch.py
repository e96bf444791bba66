"""From a command line to a command: Hydra's composition, and one clear line for every mistake."""

from __future__ import annotations

import importlib
import os
import sys
import traceback
from contextlib import suppress
from pathlib import Path
from tempfile import NamedTemporaryFile

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from saferl.cli.arguments import PATHS, readable
from saferl.cli.errors import MISTAKES, explain
from saferl.config import schema
from saferl.config.locate import config_dir
from saferl.config.machine import check_machine

INTERRUPTED = 130
#: What a job of a sweep leaves in its folder where it could not run to its end.
FAILED = "error.txt"
#: Names the file in which jobs, whatever processes they run in, say that they failed.
_FAILURES = "SAFERL_FAILURES"


def job_folder() -> Path | None:
    """The folder of this job of a sweep (``-m``); None where the command is the only one."""
    job = HydraConfig.get()
    return Path(job.runtime.output_dir) if job.mode is RunMode.MULTIRUN else None


def launch(command: str, config: str) -> None:
    """Run the command ``saferl.cli.COMMAND`` on the configuration that ``sys.argv`` describes.

    Exits with 0, with 1 after one line about a mistake, or with 130 after Ctrl-C.
    ``HYDRA_FULL_ERROR=1`` shows the trace instead of the line. Of several jobs (``-m``) each runs, whatever becomes of the
    others; what went wrong stands in the job's folder, and the exit status is 1.
    """
    sys.argv[1:] = readable(sys.argv[1:])
    # Threads of GNU's OpenMP that wait awake without end take the cores from another run's.
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    before = os.environ.get("HYDRA_FULL_ERROR")
    # Hydra prints its own exceptions over many lines unless it is told to let them pass.
    os.environ["HYDRA_FULL_ERROR"] = "1"

    def run(cfg: DictConfig) -> None:
        folder = Path(HydraConfig.get().runtime.output_dir)
        many = HydraConfig.get().mode is RunMode.MULTIRUN
        try:
            if many:  # of an earlier try
                (folder / FAILED).unlink(missing_ok=True)
            for key in PATHS:
                if cfg.get(key) == "":
                    raise ValueError(f"{key} must be a path, got ''.")
            if cfg.get("resume") is None:  # else the run's own is checked
                schema.check(cfg)
                check_machine(cfg)
            # Late: help and most mistakes need no torch.
            getattr(importlib.import_module(f"saferl.cli.{command}"), command)(cfg)
        except BaseException as error:
            if many and isinstance(error, Exception):
                told = isinstance(error, MISTAKES) and before != "1"
                line = explain(error) if told else traceback.format_exc()
                print(f"error: {line}", file=sys.stderr)
                (folder / FAILED).write_text(f"{line}\n", encoding="utf-8")
                with Path(os.environ[_FAILURES]).open("a", encoding="utf-8") as file:
                    file.write(f"{os.path.relpath(folder)}\n")
                return
            _drop_if_empty(folder)
            if isinstance(error, MISTAKES) and before != "1":
                raise SystemExit(f"error: {explain(error)}") from None
            raise

    try:
        # Where the jobs are, too, which may be on other machines.
        here = Path.cwd() if os.access(Path.cwd(), os.W_OK) else None
        with NamedTemporaryFile("r", encoding="utf-8", prefix=".failures-", dir=here) as failures:
            os.environ[_FAILURES] = failures.name
            hydra.main(version_base="1.3", config_path=config_dir(), config_name=config)(run)()
            if failed := failures.read().splitlines():
                raise SystemExit(
                    f"error: {', '.join(failed)} failed; each says why in its {FAILED}."
                )
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except MISTAKES as error:
        if before == "1":
            raise
        raise SystemExit(f"error: {explain(error, config, sys.argv[1:])}") from None
    except Exception as error:
        if before == "1" or type(error).__module__.partition(".")[0] != "submitit":
            raise
        first = str(error).strip().partition("\n")[0]
        raise SystemExit(
            f"error: a job of the sweep ended before its end ({first}); the folder .submitit of the sweep holds what it said. "
            "The same command again does what is missing."
        ) from None
    except KeyboardInterrupt as interrupt:
        print(str(interrupt) or "Interrupted.", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None
    finally:
        del os.environ["HYDRA_FULL_ERROR"]
        os.environ.pop(_FAILURES, None)
        if before is not None:
            os.environ["HYDRA_FULL_ERROR"] = before


def _drop_if_empty(folder: Path) -> None:
    """Undo the output folder, which Hydra makes before anything can be checked."""
    here = Path.cwd()
    with suppress(OSError):  # it is not empty, or not there
        while folder != here:
            folder.rmdir()
            folder = folder.parent if folder.is_relative_to(here) else here
