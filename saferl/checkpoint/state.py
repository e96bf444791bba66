"""What a checkpoint of a run holds: components with ``state_dict`` and ``load_state_dict``.

TorchRL knows modules and optimizers; these are the parts that it does not: the buffer as plain tensors, files that grow while a run lasts, and modules that say
what does not fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import ReplayBuffer


class BufferState:
    """The filled rows of a replay buffer, where it writes next, and what it samples by.

    ``ReplayBuffer.dumps`` pickles its transforms and its prefetch queue; this does not. The
    transforms are settings, not state, and are not saved.

    Args:
        buffer: without prefetching, over a tensor storage.
        generator: that it was given; None: it samples by torch's own.
    """

    def __init__(self, buffer: ReplayBuffer, generator: torch.Generator | None = None):
        self.buffer, self.generator = buffer, generator

    def state_dict(self) -> dict[str, Any]:
        """Rows [n, ...], writer, sampler and generator."""
        buffer, count = self.buffer, len(self.buffer)
        return {
            "count": count,
            "rows": buffer.storage[:count].to_dict() if count else {},
            "writer": buffer.writer.state_dict(),
            "sampler": buffer.sampler.state_dict(),
            "generator": None if self.generator is None else self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Fill the buffer as it was.

        Raises:
            ValueError: it is smaller than what was saved.
        """
        buffer, count = self.buffer, state["count"]
        if count > buffer.storage.max_size:
            raise ValueError(
                f"buffer_size must be >= {count}, the saved rows, got {buffer.storage.max_size}."
            )
        buffer.empty()
        if count:
            rows = TensorDict.from_dict(state["rows"], batch_size=[count])
            buffer.storage.set(range(count), rows)  # pyright: ignore[reportArgumentType]
        buffer.writer.load_state_dict(state["writer"])
        buffer.sampler.load_state_dict(state["sampler"])
        if self.generator is not None:
            self.generator.set_state(state["generator"].cpu())


class GrowingFiles:
    """Small text files that grow while a run lasts; they return to what they were when saved.

    Args:
        *paths: the files.
    """

    def __init__(self, *paths: Path):
        self.paths = paths

    def state_dict(self) -> dict[str, str]:
        """Text of each file by name."""
        return {path.name: path.read_bytes().decode() for path in self.paths if path.exists()}

    def load_state_dict(self, state: dict[str, str]) -> None:
        """Rewrite each file; what came after the checkpoint will be written again."""
        for path in self.paths:
            if path.name in state:
                path.write_bytes(state[path.name].encode())
            else:
                path.unlink(missing_ok=True)


class Fitting:
    """A module whose loading names the parameters that differ, instead of listing them all.

    Args:
        module: the live module.
        name: what it is called in errors.
    """

    def __init__(self, module: torch.nn.Module, name: str = "loss"):
        self.module, self.name = module, name

    def state_dict(self) -> Mapping[str, Any]:
        return self.module.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Load into the live parameters.

        Raises:
            ValueError: names or shapes differ; tells the first and how many.
        """
        mine = self.module.state_dict()
        differences = [
            f"{key} is {_shape(state.get(key))} in the checkpoint and {_shape(mine.get(key))} here"
            for key in sorted({*mine, *state}, key=lambda key: (key.startswith("_"), key))
            if _shape(state.get(key)) != _shape(mine.get(key))
        ]
        if differences:
            more = f" (and {len(differences) - 1} more)" if len(differences) > 1 else ""
            raise ValueError(f"another {self.name}: {differences[0]}{more}.")
        self.module.load_state_dict(state)


class Networks(Fitting):
    """A loss that takes from another only the networks that both have.

    What is no network (discount, limits, temperature, multiplier) stays as it is, and so do cost
    critics that the other one lacks.

    Args:
        loss: the live loss.
    """

    NAMES = frozenset(
        f"{target}{network}_params"
        for network in (
            "actor_network",
            "qvalue_network",
            "critic_network",
            "cost_critic",
            "risk_critic",
        )
        for target in ("", "target_")
    )

    def __init__(self, loss: torch.nn.Module):
        super().__init__(loss)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Load the shared networks.

        Raises:
            ValueError: as :meth:`Fitting.load_state_dict`.
        """
        mine = self.module.state_dict()
        shared = self.NAMES & {_network(key) for key in mine} & {_network(key) for key in state}
        kept = {key: value for key, value in mine.items() if _network(key) not in shared}
        taken = {key: value for key, value in state.items() if _network(key) in shared}
        super().load_state_dict(kept | taken)


def _network(key: str) -> str:
    return key.partition(".")[0]


def _shape(value: Any) -> str:
    if value is None:
        return "absent"
    return str(list(value.shape)) if isinstance(value, Tensor) else "a setting"
