"""What a learner updates from: transitions that are kept, or fresh ones alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer

from saferl.checkpoint.state import BufferState
from saferl.config.machine import memory


def _flat(data: TensorDictBase, keys: Sequence[NestedKey]) -> TensorDictBase:
    return data.select(*keys, strict=False).contiguous().reshape(-1)


def check_memory(option: str, count: int, transition: TensorDictBase, device: torch.device) -> None:
    """Refuse to keep more transitions than fit.

    Args:
        option: that says how many.
        count: of them.
        transition: one, or a batch [B] of them, as it is kept.
        device: where.

    Raises:
        ValueError: says how much memory they take and how much there is.
    """
    size = transition.bytes() / transition.numel()
    there = torch.cuda.mem_get_info(device)[1] if device.type == "cuda" else memory()
    if count * size > there:
        raise ValueError(
            f"{option} must be <= {int(there / size)}, got {count}: a transition takes {size:,.0f} bytes, all of them "
            f"{count * size / 2**30:.1f} GiB, and {device} has {there / 2**30:.1f} GiB."
        )


class Replay:
    """Transitions are kept and sampled again and again, as off-policy losses allow.

    Args:
        buffer: its transforms decide what is stored and what is sampled.
        stored: keys of a transition that it keeps, where they exist.
        updates_per_frame: batches for each collected frame.
        warmup_frames: collected before the first batch.
        demonstrate: gives transitions [N] that the buffer holds before the first frame, or None; they
            count as no frames.
        generator: that the buffer was given, for checkpoints.

    Raises:
        ValueError: a number out of range.
    """

    def __init__(
        self,
        buffer: ReplayBuffer,
        stored: Sequence[NestedKey],
        updates_per_frame: float = 0.25,
        warmup_frames: int = 1000,
        demonstrate: Callable[[], TensorDictBase] | None = None,
        generator: torch.Generator | None = None,
    ):
        for name, value, least in (
            ("updates_per_frame", updates_per_frame, 0),
            ("warmup_frames", warmup_frames, 1),
        ):
            if value < least:
                raise ValueError(f"{name} must be >= {least}, got {value}.")
        self.buffer, self.stored = buffer, stored
        self.buffer_state = BufferState(buffer, generator)
        self.updates_per_frame, self.warmup_frames = updates_per_frame, warmup_frames
        self.demonstrate = demonstrate
        self.owed = 0.0

    def prepare(self) -> None:
        """Before the first frame of a new run."""
        if self.demonstrate is not None:
            self.buffer.extend(_flat(self.demonstrate(), self.stored))

    def batches(self, data: TensorDictBase, frames: int) -> Iterator[TensorDictBase]:
        """Take collected data [B, T], the run's frame number ``frames`` its last; yields a batch for each
        update that it entitles to."""
        self.buffer.extend(_flat(data, self.stored))
        if frames < self.warmup_frames:
            return
        self.owed += data.numel() * self.updates_per_frame
        while self.owed >= 1.0:
            self.owed -= 1.0
            yield self.buffer.sample()

    def state_dict(self) -> dict[str, Any]:
        return {**self.buffer_state.state_dict(), "owed": self.owed}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.buffer_state.load_state_dict(state)
        self.owed = state["owed"]


class Epochs:
    """Each batch of fresh transitions is gone through a few times in mini-batches, and forgotten.

    Args:
        buffer: as large as a batch, with a sampler without replacement.
        stored: keys of a transition that the loss reads, where they exist.
        begin: is given each batch [B, T] first, and writes advantages and value targets into it.
        epochs: how often a batch is gone through.
        reward_scale: of the reward that ``begin`` sees.
        generator: that the buffer was given, for checkpoints.

    Raises:
        ValueError: fewer than one epoch.
    """

    def __init__(
        self,
        buffer: ReplayBuffer,
        stored: Sequence[NestedKey],
        begin: Callable[[TensorDictBase], Any],
        epochs: int = 10,
        reward_scale: float = 1.0,
        generator: torch.Generator | None = None,
    ):
        if epochs < 1:
            raise ValueError(f"epochs must be >= 1, got {epochs}.")
        self.buffer, self.stored, self.begin = buffer, stored, begin
        self.epochs, self.reward_scale, self.generator = epochs, reward_scale, generator

    def prepare(self) -> None:
        """Nothing is needed before the first frame."""

    def batches(self, data: TensorDictBase, frames: int) -> Iterator[TensorDictBase]:
        """Take collected data [B, T]; yields the mini-batches of its epochs."""
        data = data.clone(recurse=False)
        following = data.get("next").clone(recurse=False)
        data.set("next", following.set("reward", following.get("reward") * self.reward_scale))
        self.begin(data)
        self.buffer.empty()
        self.buffer.extend(_flat(data, self.stored))
        for _ in range(self.epochs):
            yield from self.buffer

    def state_dict(self) -> dict[str, Any]:
        """What shuffles the mini-batches: no transition outlives its batch, and checkpoints are made between them."""
        return {} if self.generator is None else {"generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        if self.generator is not None:
            self.generator.set_state(state["generator"].cpu())
