"""Whole runs on disk: atomic, without pickle, and enough to continue exactly.

TorchRL's own checkpoint coordinator writes and rotates; this module adds the components that it does
not know: the collector in mid-episode, and files that grow while a run lasts.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint, CheckpointRotation, GlobalRNGState
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, TransformedEnv

FOLDER = "checkpoints"


class CollectorState:
    """A collector in mid-episode: its environments' state, its last observation, its counters.

    TorchRL's ``Collector.state_dict`` holds neither the base environment nor the observation that the
    next action answers, so a run restored from it alone starts new episodes.
    """

    def __init__(self, collector: Collector):
        self.collector = collector

    @property
    def _base_env(self) -> EnvBase:
        env = self.collector.env
        return env.base_env if isinstance(env, TransformedEnv) else env

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next collected frame depends on, but for the global generators."""
        state = {
            "env": self._base_env.state_dict(),
            "carrier": self.collector._carrier.to_dict(retain_none=False),
            "frames": self.collector._frames,
            "iter": self.collector._iter,
        }
        if isinstance(self.collector.env, TransformedEnv):
            state["transform"] = self.collector.env.transform.state_dict()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where :meth:`state_dict` was taken."""
        collector = self.collector
        self._base_env.load_state_dict(state["env"])
        if "transform" in state:
            collector.env.transform.load_state_dict(state["transform"])
        collector._carrier = TensorDict.from_dict(
            state["carrier"], batch_size=collector.env.batch_size, device=collector.env.device
        )
        collector._frames, collector._iter = state["frames"], state["iter"]


class GrowingFiles:
    """Append-only text files, cut back to their length at the checkpoint when it is loaded."""

    def __init__(self, *paths: Path):
        self.paths = paths

    def state_dict(self) -> dict[str, int]:
        """Length of each file in bytes, by name."""
        return {path.name: path.stat().st_size if path.exists() else 0 for path in self.paths}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Cut each file back; what was written after the checkpoint will be written again."""
        for path in self.paths:
            if path.exists():
                with path.open("r+b") as file:
                    file.truncate(state[path.name])


class RunCheckpoint:
    """Checkpoints of one run, under ``RUN/checkpoints``.

    Args:
        run: the run's folder.
        keep: how many to keep.
        **components: whatever has ``state_dict`` and ``load_state_dict`` (or dumps and loads, as a
            replay buffer).
    """

    def __init__(self, run: Path, keep: int = 1, **components: Any):
        self.checkpoint = Checkpoint(**components, rng=GlobalRNGState())
        self.rotation = CheckpointRotation(run / FOLDER, keep_last=keep)

    def save(self, frames: int, metadata: dict[str, Any]) -> Path:
        """Write atomically; an interrupted write leaves the previous checkpoint whole."""
        return self.rotation.save(self.checkpoint, step=frames, metadata=metadata)

    def load_latest(self) -> Path:
        """Restore every component from the newest checkpoint.

        Raises:
            FileNotFoundError: the run holds none.
        """
        path = latest(self.rotation.directory.parent)
        self.checkpoint.load(path, strict="error")
        return path


def latest(run: Path) -> Path:
    """Newest checkpoint of a run's folder; a checkpoint's own folder is returned as it is.

    Raises:
        FileNotFoundError: there is no such folder, or no checkpoint in it.
    """
    if not run.exists():
        raise FileNotFoundError(f"checkpoint: no such file or folder: {run}")
    if Checkpoint.is_checkpoint(run):
        return run
    path = (
        CheckpointRotation(run / FOLDER, keep_last=1).latest() if (run / FOLDER).exists() else None
    )
    if path is None:
        raise FileNotFoundError(f"checkpoint: {run} holds no checkpoint (looked in {run / FOLDER})")
    return path


def load_component(path: Path, component: Any, name: str) -> None:
    """Load one named component of a checkpoint into a live object.

    Raises:
        ValueError: the parameters do not fit; names the first that differs.
    """
    checkpoint = Checkpoint(**{name: component})
    try:
        checkpoint.load(path, strict="error", map_location=torch.device("cpu"))
    except Exception as error:
        raise ValueError(
            f"checkpoint {path} does not fit the configured {name}: {error} "
            "Use the configuration it was trained with (config.yaml in its run)."
        ) from error
