"""Whole runs on disk: atomic, without pickle, and enough to continue exactly.

TorchRL's own checkpoint coordinator writes and rotates :mod:`saferl.checkpoint.state`; this module says where
they lie, and takes single ones out of them.
"""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.checkpoint import Checkpoint, CheckpointError, CheckpointRotation, GlobalRNGState

from saferl.checkpoint.sealed import Damaged, sealed
from saferl.checkpoint.state import Fitting
from saferl.config.foreign import check_origin

CONFIG = "config.yaml"
FOLDER = "checkpoints"
EXPORTED = "policy.torchrl"
_CPU = torch.device("cpu")


class RunCheckpoint:
    """Checkpoints of one run, under ``RUN/checkpoints``.

    Args:
        run: the run's folder.
        keep: how many to keep.
        **components: whatever has ``state_dict`` and ``load_state_dict``.
    """

    def __init__(self, run: Path, keep: int = 1, **components: Any):
        self.run = run
        self.checkpoint = sealed(**components, rng=GlobalRNGState())
        self.rotation = CheckpointRotation(run / FOLDER, keep_last=keep)

    def save(self, frames: int, metadata: dict[str, Any]) -> Path:
        """Write atomically; an interrupted write leaves the previous checkpoint whole."""
        return self.rotation.save(self.checkpoint, step=frames, metadata=metadata)

    def load_latest(self) -> Path:
        """Restore every component from the newest checkpoint, and clear away unfinished ones.

        Raises:
            FileNotFoundError: the run holds none.
            ValueError: a component does not fit.
        """
        path = latest(self.run, "resume")
        for leftover in self.rotation.directory.glob(".checkpoint-*"):
            shutil.rmtree(leftover, ignore_errors=True)
        _load(self.checkpoint, path)
        return path


def _load(checkpoint: Checkpoint, path: Path) -> None:
    try:
        checkpoint.load(path, strict="error", map_location=_CPU)
    except zipfile.BadZipFile as error:
        raise ValueError(f"checkpoint {path} is damaged: {error}.") from error
    except (CheckpointError, OSError) as error:
        if isinstance(error.__cause__, Damaged):
            raise ValueError(f"checkpoint {path} is damaged: {error.__cause__}.") from error
        raise ValueError(
            f"checkpoint {path} does not fit this configuration: {error.__cause__ or error} "
            f"Use the configuration that it was trained with ({CONFIG} in its run)."
        ) from error


def latest(run: Path, option: str = "checkpoint") -> Path:
    """Newest checkpoint of a run's folder, or an exported policy; a checkpoint itself as it is.

    Args:
        run: folder or file.
        option: what errors call it.

    Raises:
        FileNotFoundError: there is no such folder, or no checkpoint in it.
    """
    if not run.exists():
        raise FileNotFoundError(f"{option}: no such file or folder: {run}")
    folder = run / FOLDER
    newest = CheckpointRotation(folder, keep_last=1).latest() if folder.is_dir() else None
    for path in (run, newest, run / EXPORTED):
        if path is not None and Checkpoint.is_checkpoint(path):
            return path
    raise FileNotFoundError(f"{option}: {run} holds no checkpoint (looked in {folder}).")


def run_folder(path: Path, option: str = "checkpoint") -> Path:
    """Folder of the run that a checkpoint belongs to: the one with ``config.yaml``.

    Args:
        path: a run's folder, or a checkpoint in it.
        option: what errors call it.

    Raises:
        FileNotFoundError: no config.yaml where it should be.
    """
    if not path.exists():
        raise FileNotFoundError(f"{option}: no such file or folder: {path}")
    nested = path.absolute().parent.name == FOLDER
    for folder in (path, *path.absolute().parents[: 2 if nested else int(path.is_file())]):
        if (folder / CONFIG).is_file():
            return folder
    raise FileNotFoundError(f"{option}: no {CONFIG} in {path}; is it a saferl run?")


def run_config(path: Path, option: str = "checkpoint") -> DictConfig:
    """The resolved configuration that a run was trained with.

    Args:
        path: a run's folder, or a checkpoint in it.
        option: what errors call it.

    Raises:
        FileNotFoundError: it is not there.
        ValueError: it names what a file may not call (:func:`saferl.config.foreign.check_origin`).
    """
    file = run_folder(path, option) / CONFIG
    cfg = OmegaConf.load(file)
    if not isinstance(cfg, DictConfig):
        raise ValueError(f"{option}: {file} holds no settings.")
    check_origin(OmegaConf.to_container(cfg, resolve=False), file)
    return cfg


def load_component(path: Path, component: Fitting) -> None:
    """Load one component of a checkpoint into a live module.

    Raises:
        ValueError: the parameters do not fit; names the first that differs.
    """
    _load(sealed(**{component.name: component}), path)


class _Held:
    """Carries one component's state from a checkpoint to another."""

    def load_state_dict(self, state: dict) -> None:
        self.state = state

    def state_dict(self) -> dict:
        return self.state


def progress(path: Path) -> dict[str, int] | None:
    """Frames and episodes at a checkpoint; None where it does not tell.

    Args:
        path: a run, a checkpoint in it, or an exported policy.
    """
    path, held = latest(path), _Held()
    if "progress" not in Checkpoint.manifest(path)["components"]:
        return None
    _load(sealed(progress=held), path)
    return {name: held.state[name] for name in ("frames", "episodes")}


def export(path: Path, folder: Path) -> Path:
    """Write what a trained policy needs into a folder: its configuration, and one file of networks
    with how long they were trained, by which a projector acts.

    Args:
        path: a run, or a checkpoint in it.
        folder: gets ``config.yaml`` and ``policy.torchrl``; ``checkpoint=`` and ``init=`` read it.

    Raises:
        FileNotFoundError: ``path`` holds no run or no checkpoint.
        ValueError: ``folder`` holds a run or a policy already.
    """
    if any((folder / name).exists() for name in (FOLDER, "metrics.csv", EXPORTED)):
        raise ValueError(f"out: {folder} holds a run or a policy already; take another folder.")
    config = run_config(path)
    checkpoint = sealed(loss=_Held(), progress=_Held())
    _load(checkpoint, latest(path))
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint.save(folder / EXPORTED, format="archive")
    # Where the run lay is nobody else's business.
    OmegaConf.save(OmegaConf.merge(config, {"out": None, "init": None}), folder / CONFIG)
    return folder
