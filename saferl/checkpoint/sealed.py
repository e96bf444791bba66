"""Files of a checkpoint that show whether they are as they were written."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import Checkpoint, StateDictCheckpointAdapter

_SEAL = "seal.json"
#: Structure and tensors; anything else might be read with pickle.
_OURS = re.compile(r"state\.json|state/meta\.json|state/[\w.]+\.memmap")


class Damaged(ValueError):
    """A file of a checkpoint is not as it was written."""


def digests(folder: Path) -> dict[str, list]:
    """Size and SHA-256 of each file below a folder, but for the seal."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name != _SEAL:
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            found[path.relative_to(folder).as_posix()] = [path.stat().st_size, digest]
    return found


class Sealed(StateDictCheckpointAdapter):
    """A state as TorchRL writes it, with the size and SHA-256 of each of its files.

    They are compared before anything is read: a tensor's file that was cut would be read as zeros, and made longer on
    disk by reading it. A file that TorchRL or TensorDict would unpickle is refused, whatever its seal says.
    """

    adapter_id = "saferl.sealed"

    def save(
        self, component: Any, path: Path, *, args: tuple[Any, ...], kwargs: Mapping[str, Any]
    ) -> Any:
        state = super().save(component, path, args=args, kwargs=kwargs)
        (path / _SEAL).write_text(json.dumps(digests(path)) + "\n", encoding="utf-8")
        return state

    def load(self, component: Any, path: Path, **options: Any) -> Any:
        try:
            written = json.loads((path / _SEAL).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise Damaged(f"{path.name}/{_SEAL} cannot be read") from error
        if link := next((each for each in (path, *path.rglob("*")) if each.is_symlink()), None):
            raise Damaged(f"{path.name}/{link.name} is a link, which no checkpoint has")
        found = digests(path)
        for name in found:
            if not _OURS.fullmatch(name):
                raise Damaged(f"{path.name}/{name} is no file of a checkpoint")
        if found != written:
            written = written if isinstance(written, dict) else {}
            names = sorted({*found, *written})
            name = next((n for n in names if found.get(n) != written.get(n)), _SEAL)
            raise Damaged(f"{path.name}/{name} is not as it was written")
        _check_sizes(path / "state")
        return super().load(component, path, **options)


def _check_sizes(state: Path) -> None:
    """That each tensor's file holds as much as the structure says: TensorDict makes one that is shorter longer on disk."""
    try:
        structure = json.loads((state / "meta.json").read_text(encoding="utf-8"))
        tensors = {name: about for name, about in structure.items() if isinstance(about, dict)}
        sizes = {
            name: math.prod(about["shape"])
            * getattr(torch, about["dtype"].removeprefix("torch.")).itemsize
            for name, about in tensors.items()
            if "dtype" in about
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise Damaged(f"{state.parent.name}/state/meta.json cannot be read") from error
    for name, size in sizes.items():
        file = state / f"{name}.memmap"
        if size and not (file.is_file() and file.stat().st_size == size):
            raise Damaged(
                f"{state.parent.name}/state/{file.name} does not hold what meta.json says"
            )


def sealed(**components: Any) -> Checkpoint:
    """TorchRL's coordinator of a checkpoint, for components with ``state_dict`` and ``load_state_dict``."""
    checkpoint = Checkpoint().register_adapter(object, Sealed())
    for name, component in components.items():
        checkpoint.register(name, component)
    return checkpoint
