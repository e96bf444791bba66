"""Reduce a run to what its policy needs."""

from __future__ import annotations

import logging
from pathlib import Path

from omegaconf import DictConfig

from saferl.checkpoint import run
from saferl.cli.launch import job_folder

log = logging.getLogger(__name__)


def export(cfg: DictConfig) -> None:
    """Reduce a run to its configuration and networks."""
    for key in ("checkpoint", "out"):
        if cfg[key] is None:
            raise ValueError(f"{key}=... is missing: give checkpoint=RUN and out=DIR.")
    folder = run.export(Path(str(cfg.checkpoint)), job_folder() or Path(str(cfg.out)))
    size = (folder / run.EXPORTED).stat().st_size / 2**20
    log.info("%s: %.1f MiB. Test it: python -m saferl.evaluate checkpoint=%s", folder, size, folder)
