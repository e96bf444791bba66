"""Whole runs on disk: atomic, without pickle, and enough to continue exactly.

TorchRL's own checkpoint coordinator writes and rotates :mod:`saferl.checkpoint.state`; this module says where
they lie, and takes single ones out of them.
"""

from __future__ import annotations

import os
import shutil
import weakref
import zipfile
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.checkpoint import Checkpoint, CheckpointError, CheckpointRotation, GlobalRNGState

from saferl.checkpoint.policy import (
    EXPORTED,
    policy_config,
    policy_counted,
    policy_state,
    settings,
    write_policy,
)
from saferl.checkpoint.sealed import Damaged, sealed
from saferl.checkpoint.state import Fitting
from saferl.config.foreign import check_origin

CONFIG = "config.yaml"
FOLDER = "checkpoints"
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
        self._opened: int | None = None

    def save(self, frames: int, metadata: dict[str, Any]) -> Path:
        """Write atomically; an interrupted write leaves the previous checkpoint whole.

        Raises:
            OSError: it cannot be written, for lack of room perhaps; or the run's folder is no longer that of the first save.
        """
        self._check_folder()
        try:
            path = self.rotation.save(self.checkpoint, step=frames, metadata=metadata)
        except (RuntimeError, OSError) as error:  # torch's, where a file cannot grow, and Python's
            self._check_folder()
            raise OSError(f"the checkpoint of frame {frames} cannot be written: {error}") from error
        self._check_folder()
        return path

    def _check_folder(self) -> None:
        """Refuse to go on in a folder that took the place of the run's own, which would lack all but a checkpoint."""
        if self._opened is None:  # while it is open, no other folder has its number
            self.run.mkdir(parents=True, exist_ok=True)
            self._opened = os.open(self.run, os.O_RDONLY)
            weakref.finalize(self, os.close, self._opened)
        if not self.run.exists() or not os.path.samestat(os.fstat(self._opened), self.run.stat()):
            raise FileNotFoundError(f"{self.run} was moved or deleted while the run wrote to it.")

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


def begun(run: Path) -> bool:
    """Whether a run's folder holds a whole checkpoint: one that was killed before its first has nothing to go on from."""
    folder = run / FOLDER
    return folder.is_dir() and CheckpointRotation(folder, keep_last=1).latest() is not None


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
    if run.is_file():
        return run
    for path in (run, newest):
        if path is not None and Checkpoint.is_checkpoint(path):
            return path
    if (run / EXPORTED).is_file():
        return run / EXPORTED
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
        path: a run's folder, a checkpoint in it, or an exported policy.
        option: what errors call it.

    Raises:
        FileNotFoundError: it is not there.
        ValueError: it names what a file may not call (:func:`saferl.config.foreign.check_origin`).
    """
    file = path / EXPORTED if path.is_dir() else path
    if file.is_file() and not (path / CONFIG).exists():
        cfg = policy_config(file)
    else:
        file = run_folder(path, option) / CONFIG
        cfg = settings(file.read_text(encoding="utf-8"), file)
    check_origin(OmegaConf.to_container(cfg, resolve=False), file)
    return cfg


def load_component(path: Path, component: Fitting) -> None:
    """Load one component of a checkpoint, or an exported policy, into a live module.

    Raises:
        ValueError: the parameters do not fit; names the first that differs.
    """
    if path.is_dir():
        _load(sealed(**{component.name: component}), path)
        return
    # What is no tensor has no part in a policy.
    rest = {k: v for k, v in component.state_dict().items() if not isinstance(v, torch.Tensor)}
    try:
        component.load_state_dict({**rest, **policy_state(path)})
    except ValueError as error:
        raise ValueError(f"{path} does not fit its configuration: {error}") from error


class _Held:
    """Carries one component's state from a checkpoint to another."""

    def load_state_dict(self, state: dict) -> None:
        self.state = state

    def state_dict(self) -> dict:
        return self.state


def progress(path: Path) -> dict[str, int]:
    """Frames and episodes at a checkpoint.

    Args:
        path: a run, a checkpoint in it, or an exported policy.
    """
    path, held = latest(path), _Held()
    if path.is_file():
        counted = policy_counted(path)
    else:
        _load(sealed(progress=held), path)
        counted = held.state
    return {name: int(counted[name]) for name in ("frames", "episodes")}


def check_free(folder: Path) -> None:
    """Refuse a folder that an exported policy and its card would destroy.

    Raises:
        ValueError: it holds a run, a policy or a ``README.md`` already.
    """
    held = any((folder / name).exists() for name in (FOLDER, "metrics.csv"))
    if held or any(folder.glob("policy.*")):
        raise ValueError(f"out: {folder} holds a run or a policy already; take another folder.")
    if (folder / "README.md").exists():
        raise ValueError(
            f"out: {folder} holds a README.md, which the policy's would replace; take another folder."
        )


def export(path: Path, folder: Path, project: bool = True) -> Path:
    """Write what a trained policy needs as one file into a folder.

    Args:
        path: a run, a checkpoint in it, or a policy.
        folder: gets ``policy.safetensors``; ``checkpoint=`` and ``init=`` read it.
        project: with its projector, if it was trained with one.

    Raises:
        FileNotFoundError: ``path`` holds no run or no checkpoint.
        ValueError: ``folder`` holds a run or a policy already.
    """
    check_free(folder)
    found, loss = latest(path), _Held()
    if found.is_file():
        loss.state = policy_state(found)
    else:
        _load(sealed(loss=loss), found)
    cfg = run_config(path)
    if not project:
        cfg.projector = {"_target_": None}
    write_policy(folder, loss.state, cfg, progress(path))
    return folder
