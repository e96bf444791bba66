"""Options that make a run small."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import hydra
from omegaconf import DictConfig

from saferl.config.locate import config_dir

#: Of either family, by the start of a setting.
OFF_POLICY = (
    "learning.warmup_frames=8",
    "learning.buffer_size=64",
    "learning.updates_per_frame=0.5",
)
ON_POLICY = ("learning.rollout_frames=8",)
#: Turns any training into one of seconds; :func:`fitting` leaves out what is of the other family.
SMALL = (
    "episodes=null",
    "frames=24",
    *OFF_POLICY,
    *ON_POLICY,
    "learning.batch_size=8",
    "record_every=8",
    "encoder.width=16",
    "evaluation.episodes=1",
    "logger=none",
    "device=cpu",
    "threads=1",
    "env.num_envs=2",
    "compile=false",
)
EMPTY = ("env=batched", "env.num_envs=2", "task.vehicles=0")


def fitting(arguments: Sequence[str]) -> list[str]:
    """A command line without those of :data:`SMALL` that its algorithm has not."""
    algo = [a.removeprefix("algo=") for a in arguments if a.startswith("algo=")]
    file = Path(config_dir()) / "algo" / f"{[*algo][-1] if algo else 'arsac'}.yaml"
    fresh = "learning=on_policy" in arguments or (
        file.is_file() and "/learning: on_policy" in file.read_text()
    )
    return [a for a in arguments if a not in (OFF_POLICY if fresh else ON_POLICY)]


def compose(*overrides: str, config: str = "config") -> DictConfig:
    """The configuration that a command line describes."""
    with hydra.initialize_config_dir(config_dir(), version_base="1.3"):
        return hydra.compose(config, fitting(overrides))
