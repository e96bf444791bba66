"""Sweeps of tests that are run again: which test a folder holds, and whether it is over."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from saferl.checkpoint.run import progress

#: In the folder of a sweep's job.
ASKED = "asked.json"


def asked(cfg: DictConfig) -> dict[str, Any]:
    """What makes two jobs of sweeps the same test: their settings, and how far the policy's training had come."""
    told = HydraConfig.get().overrides.task
    apart = [each for each in told if not each.startswith(("out=", "threads=", "env.num_envs="))]
    counted = progress(Path(cfg.checkpoint)) if cfg.checkpoint is not None else None
    return {"settings": sorted(apart), "training": counted}


def is_there(out: Path, test: Mapping[str, Any] | None) -> bool:
    """Whether a folder holds this test of a sweep, finished.

    Raises:
        ValueError: it holds another one.
    """
    file = out / ASKED
    try:
        before = json.loads(file.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):  # or cut off, which says nothing
        before = {}
    same = test is not None and before.get("test") == test
    if (out / "metrics.json").exists() and not same:
        raise ValueError(f"out: {out} holds a test already; take another folder.")
    return same and bool(before["finished"])


def keep(out: Path, test: Mapping[str, Any] | None, finished: bool) -> None:
    """Write beside the results of a sweep's job which test it is, so that the sweep may be run again."""
    if test is not None:
        told = json.dumps({"test": test, "finished": finished}, indent=2)
        (out / ASKED).write_text(f"{told}\n", encoding="utf-8")
