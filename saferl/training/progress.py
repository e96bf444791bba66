"""How far a run has come: its budget, its counters, its wall-clock."""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass(frozen=True)
class Budget:
    """How long to train: a number of episodes or of frames, whichever is given.

    >>> Budget(episodes=100).spent(frames=0, episodes=25)
    0.25
    """

    episodes: int | None = None
    frames: int | None = None

    def __post_init__(self):
        for name in ("episodes", "frames"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name} must be >= 1, got {value}.")
        if (self.episodes is None) == (self.frames is None):
            raise ValueError(
                "Give one budget, episodes or frames (the other null): "
                f"got episodes={self.episodes}, frames={self.frames}."
            )

    def spent(self, frames: int, episodes: int) -> float:
        """Fraction of the budget that is spent, in [0, 1]."""
        done = episodes if self.episodes else frames
        return min(1.0, done / self.whole)

    def done(self, progress: Progress) -> int:
        """How many of the budget's episodes or frames are behind."""
        return progress.episodes if self.episodes else progress.frames

    @property
    def whole(self) -> int:
        """The number of episodes or frames."""
        return self.episodes or self.frames or 0


@dataclass
class Progress:
    """Counters of a run; a checkpoint component.

    Attributes:
        last_end: how much of the budget was done when an episode last ended.
    """

    frames: int = 0
    episodes: int = 0
    updates: int = 0
    last_end: int = 0
    last_record: int = 0
    last_save: int = -1

    def state_dict(self) -> dict[str, float]:
        return dict(self.__dict__)

    def load_state_dict(self, state: dict[str, float]) -> None:
        self.__dict__.update(state)


class Clock:
    """Wall-clock seconds by phase, kept out of ``metrics.csv``."""

    def __init__(self):
        self.seconds: dict[str, float] = {"collect": 0.0, "learn": 0.0, "other": 0.0}
        self._last = time.perf_counter()

    def state_dict(self) -> dict[str, float]:
        return dict(self.seconds)

    def load_state_dict(self, state: dict[str, float]) -> None:
        self.seconds.update(state)

    @contextmanager
    def phase(self, name: str):
        start = time.perf_counter()
        self.seconds["other"] += start - self._last
        try:
            yield
        finally:
            self._last = time.perf_counter()
            self.seconds[name] += self._last - start
