"""A trained policy as one file that anybody may open: networks, configuration and checksum, by safetensors."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

#: The name of the file in its folder.
EXPORTED = "policy.safetensors"
#: Entries of its header.
_CONFIG, _COUNTED, _CHECKSUM = "config", "counted", "sha256"


def _checksum(tensors: Mapping[str, Tensor], config: str, counted: str) -> str:
    digest = hashlib.sha256()
    for text in (config, counted):
        digest.update(text.encode() + b"\0")
    for name in sorted(tensors):
        tensor = tensors[name].contiguous()
        digest.update(f"{name} {tensor.dtype} {list(tensor.shape)}".encode() + b"\0")
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def write_policy(
    folder: Path, state: Mapping[str, Any], cfg: DictConfig, counted: Mapping[str, float]
) -> Path:
    """Write a policy into a folder, whole or not at all, in place of one that is there.

    Args:
        folder: gets ``policy.safetensors``.
        state: of the loss, its ``state_dict``; what is no tensor is left out.
        cfg: the run's.
        counted: how long it was trained (``frames``, ``episodes``), and what else is to be known of it.

    Returns:
        The file.
    """
    tensors = {
        name: value.detach().cpu().clone().contiguous()
        for name, value in state.items()
        if isinstance(value, Tensor)
    }
    # Where the run lay is nobody else's business.
    mine = OmegaConf.merge(cfg, {"out": None, "init": None, "resume": None})
    config, numbers = OmegaConf.to_yaml(mine, resolve=True), json.dumps(dict(counted))
    about = {_CONFIG: config, _COUNTED: numbers}
    about[_CHECKSUM] = _checksum(tensors, config, numbers)
    folder.mkdir(parents=True, exist_ok=True)
    part, file = folder / f".{EXPORTED}.part", folder / EXPORTED
    part.write_bytes(
        save(tensors, metadata=about)
    )  # which everybody may read who may read the folder
    os.replace(part, file)
    return file


def _header(file: Path) -> dict[str, str]:
    """The header of a policy's file.

    Raises:
        ValueError: it is none.
    """
    try:
        with safe_open(file, "pt") as opened:
            about = opened.metadata() or {}
    except SafetensorError as error:
        raise ValueError(f"{file} is damaged, or no policy: {error}.") from error
    missing = {_CONFIG, _COUNTED, _CHECKSUM} - set(about)
    if missing:
        raise ValueError(f"{file} is no policy of saferl: it has no {', '.join(sorted(missing))}.")
    return about


def settings(text: str, file: Path) -> DictConfig:
    """A configuration from its text.

    Raises:
        ValueError: it is none; names the file.
    """
    try:
        plain = yaml.safe_load(text)
        cfg = OmegaConf.create(text) if isinstance(plain, dict) else None
    except (yaml.YAMLError, OmegaConfBaseException) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{file} cannot be read: {reason}.") from error
    if not isinstance(cfg, DictConfig):
        raise ValueError(f"{file} holds no settings.")
    for group in ("task", "env", "loss", "encoder", "learning"):
        if not isinstance(cfg.get(group), DictConfig):
            raise ValueError(f"{file}: {group} must be a mapping of settings.")
    return cfg


def policy_config(file: Path) -> DictConfig:
    """The configuration that a policy was trained with.

    Raises:
        ValueError: the file is damaged, or no policy.
    """
    policy_state(file)  # whose checksum is of the configuration, too
    return settings(_header(file)[_CONFIG], file)


def policy_counted(file: Path) -> dict[str, float]:
    """How long a policy was trained.

    Raises:
        ValueError: the file is damaged, or no policy.
    """
    try:
        counted = json.loads(_header(file)[_COUNTED])
        return {**counted, "frames": int(counted["frames"]), "episodes": int(counted["episodes"])}
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{file} is damaged: it does not say how long it was trained.") from error


def policy_state(file: Path) -> dict[str, Tensor]:
    """The tensors of a policy, which are compared with its checksum.

    Raises:
        ValueError: the file is damaged, or no policy.
    """
    about = _header(file)
    try:
        with safe_open(file, "pt") as opened:
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"{file} is damaged: {error}.") from error
    if _checksum(tensors, about[_CONFIG], about[_COUNTED]) != about[_CHECKSUM]:
        raise ValueError(f"{file} is damaged: it is not as it was written.")
    return tensors
