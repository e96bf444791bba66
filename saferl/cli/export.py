"""Turn a run into a policy for others: one file and its card."""

from __future__ import annotations

import logging
from pathlib import Path

from omegaconf import DictConfig

from saferl.checkpoint import run
from saferl.cli.launch import job_folder
from saferl.config.locate import pretrained_run
from saferl.deploy.card import card

log = logging.getLogger(__name__)


def export(cfg: DictConfig) -> None:
    """Write a policy into a folder, with a card."""
    if (cfg.checkpoint is None) == (cfg.pretrained is None):
        raise ValueError(
            "Give one of checkpoint=RUN or pretrained=NAME, and out=DIR, got "
            f"checkpoint={cfg.checkpoint} and pretrained={cfg.pretrained}."
        )
    if cfg.out is None:
        raise ValueError("out=... is missing: give the folder that gets the policy, out=DIR.")
    named = cfg.pretrained is not None
    source = pretrained_run(cfg.pretrained) if named else Path(str(cfg.checkpoint))
    out, about = job_folder() or Path(str(cfg.out)), None
    if cfg.format == "torch":
        file = run.export(source, out, cfg.project) / run.EXPORTED
    else:
        from saferl.deploy.package import package  # late, as it takes torch's exporters

        run.check_free(out)
        run.latest(source)
        file = out / f"policy.{cfg.format}"
        about = package(source, file, cfg.project, cfg.observation)
    card(source, file, about, cfg.project)
    size = file.stat().st_size / 2**20
    log.info("%s: %.2f MiB. Its card: %s", file, size, out / "README.md")
    if about is not None:
        log.info("Random observations: %s.", about["compared"])
    else:
        log.info("Test it: python -m saferl.evaluate checkpoint=%s", out)
