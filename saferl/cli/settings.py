"""From settings as one types them to a configuration, and back."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

import hydra
from omegaconf import DictConfig

from saferl.config.locate import config_dir


def compose(overrides: Sequence[str]) -> DictConfig:
    """The configuration of a training."""
    with hydra.initialize_config_dir(config_dir(), version_base="1.3"):
        return hydra.compose("config", list(overrides))


def command(overrides: Sequence[str]) -> str:
    """How one trains with these settings."""
    return shlex.join(["python", "-m", "saferl", *overrides])
