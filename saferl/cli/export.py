"""Reduce a run to what its policy needs."""

from __future__ import annotations

import logging
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from saferl.checkpoint import run

log = logging.getLogger(__name__)


def export(cfg: DictConfig) -> None:
    """Reduce a run to its configuration and networks."""
    for key in ("checkpoint", "out"):
        if cfg[key] is None:
            raise ValueError(f"{key}=... is missing: give checkpoint=RUN and out=DIR.")
    out = Path(str(cfg.out))
    if HydraConfig.get().mode is RunMode.MULTIRUN:  # one folder a job
        out = Path(HydraConfig.get().runtime.output_dir)
    folder = run.export(Path(str(cfg.checkpoint)), out)
    size = (folder / run.EXPORTED).stat().st_size / 2**20
    log.info("%s: %.1f MiB. Test it: python -m saferl.evaluate checkpoint=%s", folder, size, folder)
