"""Options that make a run small."""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from saferl.paths import config_dir

#: Turns any training into one of seconds.
SMALL = (
    "episodes=null",
    "frames=24",
    "warmup_frames=8",
    "batch_size=8",
    "buffer_size=64",
    "updates_per_frame=0.5",
    "rollout_frames=8",
    "record_every=8",
    "encoder.policy.width=16",
    "evaluation.episodes=1",
    "logger=none",
    "device=cpu",
    "threads=1",
    "env.num_envs=2",
    "compile=false",
)
EMPTY = ("env=batched", "env.num_envs=2", "task.vehicles=0")


def compose(*overrides: str, config: str = "config") -> DictConfig:
    """The configuration that a command line describes."""
    with hydra.initialize_config_dir(config_dir(), version_base="1.3"):
        return hydra.compose(config, list(overrides))
