"""The training loop: collect, store, learn, record, save."""

from __future__ import annotations

import logging
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.record.loggers import Logger

from saferl.checkpoint.run import RunCheckpoint
from saferl.checkpoint.state import Fitting, GrowingFiles
from saferl.evaluation.costs import scalars
from saferl.evaluation.progress import bar
from saferl.training.best import BestPolicy
from saferl.training.collector import WholeCollector
from saferl.training.crew import Crew
from saferl.training.learner import Learner
from saferl.training.limit import CostWatch
from saferl.training.progress import Budget, Clock, Progress
from saferl.training.records import CsvLog, EpisodeWindow, Means
from saferl.training.watchdog import Watchdog

log = logging.getLogger(__name__)


class Experience(Protocol):
    """What the trainer asks of :mod:`saferl.training.experience`."""

    buffer: ReplayBuffer

    def prepare(self) -> None: ...

    def batches(self, data: TensorDictBase, frames: int) -> Iterator[TensorDictBase]: ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...


@contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Collects Ctrl-C and SIGTERM, so that a run ends between two steps; a second one ends it now."""
    received: list[int] = []

    def note(number: int, frame: object) -> None:
        if received:
            raise KeyboardInterrupt(
                "Interrupted twice: what came after the last checkpoint is lost."
            )
        received.append(number)

    if threading.current_thread() is not threading.main_thread():
        yield received
        return
    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _not_finite(values: Mapping[str, Any]) -> list[str]:
    """Names of the tensors that hold a number that is not finite."""
    return [
        name
        for name, value in values.items()
        if isinstance(value, Tensor) and value.is_floating_point() and not value.isfinite().all()
    ]


@dataclass
class Trainer:
    """Trains from built parts; it knows none of them by name.

    Attributes:
        run: folder of the run's files.
        collector: yields [B, T] batches of transitions; its state is whole.
        experience: takes each batch, and gives what the learner updates from.
        learner: makes one update from what it is given.
        budget: how long.
        record_every: frames between two rows of ``metrics.csv``.
        save_every: frames between two checkpoints.
        save_minutes: of wall-clock, after which a checkpoint is due all the same; None: never.
        after_collect: called with each batch's finished episodes (a TensorDict of per-episode
            ``return``, ``cost_return`` and outcomes, [n]; [n, K] of several costs) and the fraction of the budget spent.
        open_loggers: makes the TorchRL loggers that receive the scalars of each row; called when
            training starts.
        window: means over the last episodes.
        watch: of the limit on the mean cost of an episode.
        costs: names of the K numbers of a cost.
        watchdog: of the critics' values; None: they are not looked at.
        best: keeps the best policy so far; None: only the newest checkpoint is kept.
    """

    run: Path
    collector: WholeCollector | Crew
    experience: Experience
    learner: Learner
    budget: Budget
    record_every: int = 2000
    save_every: int = 50_000
    save_minutes: float | None = 5.0
    window: EpisodeWindow = field(default_factory=EpisodeWindow)
    watch: CostWatch = field(default_factory=CostWatch)
    costs: Sequence[str] = ("cost",)
    watchdog: Watchdog | None = None
    best: BestPolicy | None = None
    after_collect: list[Callable[[TensorDictBase, float], None]] = field(default_factory=list)
    open_loggers: Callable[[], Sequence[Logger]] = list

    def __post_init__(self):
        for name in ("record_every", "save_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be >= 1, got {getattr(self, name)}.")
        if self.save_minutes is not None and not self.save_minutes > 0:
            raise ValueError(f"save_minutes must be null or > 0, got {self.save_minutes}.")
        self.progress, self.clock = Progress(), Clock()
        self.metrics = CsvLog(self.run / "metrics.csv")
        self.timing = CsvLog(self.run / "timing.csv")
        self.means = Means()
        # Buffers that are to be filled.
        self._empty = set(_not_finite(dict(self.learner.loss.named_buffers())))
        self._loggers: Sequence[Logger] = ()
        self._saved_at = time.monotonic()
        optional = {"watchdog": self.watchdog, "best": self.best}
        self.checkpoint = RunCheckpoint(
            self.run,
            **{name: part for name, part in optional.items() if part is not None},
            loss=Fitting(self.learner.loss),
            optimizer=self.learner.optimizer,
            buffer=self.experience,
            collector=self.collector,
            progress=self.progress,
            clock=self.clock,
            window=self.window,
            watch=self.watch,
            means=self.means,
            files=GrowingFiles(self.metrics.path, self.timing.path),
        )

    def resume(self) -> None:
        """Continue from the newest checkpoint of the run.

        Raises:
            FileNotFoundError: there is none.
            ValueError: it does not fit what was built.
        """
        path = self.checkpoint.load_latest()
        log.info("Resumed %s at frame %d.", path, self.progress.frames)

    def close(self) -> None:
        """Close the environments and end the workers: a simulator may be one of which a process holds only one."""
        self.collector.shutdown()

    @property
    def _costs(self) -> Tensor | None:
        """Of the last episodes [n], of several costs [n, K]."""
        return self.window.values.get("cost_return")

    @property
    def spent(self) -> float:
        """Fraction of the budget that is spent, in [0, 1]."""
        return self.budget.spent(self.progress.frames, self.progress.episodes)

    def train(self) -> None:
        """Train until the budget is spent; checkpoints at the start, now and then, and at the end.

        Raises:
            KeyboardInterrupt: the first Ctrl-C, after a checkpoint was left; a second one at once.
            ValueError: an action, a loss term or a parameter is not finite; names it and the frame.
        """
        progress = self.progress
        shown = bar(
            total=self.budget.whole,
            initial=self.budget.done(progress),
            unit="episode" if self.budget.episodes else "frame",
            desc="train",
            postfix=self.window.short(self.watch.limit),
        )
        batches, data = iter(self.collector), None
        with self._logging(), _interrupts() as interrupted, shown:
            if progress.last_save < 0:
                self.experience.prepare()
                self.save()
            while self.spent < 1.0 and not interrupted:
                with self.clock.phase("collect"):
                    data = next(batches)
                if len(self._take(data)):
                    shown.set_postfix(self.window.short(self.watch.limit), refresh=False)
                shown.update(self.budget.done(progress) - shown.n)
                if progress.frames - progress.last_record >= self.record_every:
                    self._record(data)
                if self._save_is_due() and self.spent < 1.0:
                    self.save()
            if interrupted:
                self.save()
                raise KeyboardInterrupt(
                    f"Interrupted at frame {progress.frames}. Continue with resume={self.run}"
                )
            if data is not None and progress.frames > progress.last_record:
                self._record(data)
        self.save()
        self.watch.judge(self._costs)
        if not progress.updates:
            log.warning("Nothing was learned: the budget ended before the first update.")

    @contextmanager
    def _logging(self) -> Iterator[None]:
        """Opens the loggers and tells them the rows of ``metrics.csv``, which a resume has cut off at
        its checkpoint, in place of what an earlier process told them."""
        self._loggers = self.open_loggers()
        try:
            for sink in [logger.experiment for logger in self._loggers]:
                # TensorBoard keeps every event; a new file can hide those of the files before it.
                if self.progress.last_save >= 0 and hasattr(sink, "purge_step"):
                    sink.close()
                    sink.purge_step = 0
            for row in self.metrics.read():
                self._log(row)
            yield
        finally:
            # TorchRL's loggers have no end of their own; what they write to does.
            for logger in self._loggers:
                sink = logger.experiment
                end = getattr(sink, "close", None) or getattr(sink, "finish", None)
                if end is not None:
                    end()

    def _log(self, row: dict[str, float]) -> None:
        for logger in self._loggers:
            for key, value in row.items():
                logger.log_scalar(key, value, step=int(row["frames"]))

    def _save_is_due(self) -> bool:
        minutes = (time.monotonic() - self._saved_at) / 60
        frames = self.progress.frames - self.progress.last_save
        return frames >= self.save_every or minutes >= (self.save_minutes or math.inf)

    def _diverged(self, name: str) -> ValueError:
        newest = self.checkpoint.rotation.latest()
        if newest is None:
            return ValueError(
                f"{name} is not finite before the first update; look at what init= names."
            )
        return ValueError(
            f"{name} is not finite at frame {self.progress.frames}: the training diverged."
            f"{self.watchdog.first() if self.watchdog else ''} Its last good checkpoint is {newest}; smaller learning rates "
            "(learning.lr) may help."
        )

    def _check_finite(self) -> None:
        """Refuse to go on, or to be kept, with a number that is not finite.

        Raises:
            ValueError: names the first one.
        """
        for name in _not_finite(self.means.sums) + _not_finite(self.learner.loss.state_dict()):
            if name not in self._empty:
                raise self._diverged(name)

    def save(self) -> None:
        """Write a checkpoint of everything, unless the newest one is of this very frame.

        Raises:
            ValueError: something that is learned is not finite; the checkpoint before stays.
        """
        if self.progress.last_save < self.progress.frames:
            self._check_finite()
            self.progress.last_save = self.progress.frames
            self.checkpoint.save(self.progress.frames, {"episodes": self.progress.episodes})
        self._saved_at = time.monotonic()

    def _take(self, data: TensorDictBase) -> TensorDict:
        """Make the updates that a batch entitles to; returns its finished episodes [n]."""
        progress = self.progress
        if not data["action"].isfinite().all():
            raise self._diverged("the policy's action")
        # Of what was spent when these frames were begun: the last batch of a run is learned from, too.
        self.learner.schedule(self.spent)
        if self.watchdog is not None:
            self.watchdog.take(data)
        if (intervened := data.get(("next", "intervened"), None)) is not None:
            self.means.add("intervention_rate", intervened.float().mean())
        finished = self.window.extend(data)
        progress.frames += data.numel()
        progress.episodes += finished.shape[0]
        for hook in self.after_collect:
            hook(finished, self.spent)
        if len(finished):
            self.watch.take(finished["cost_return"])
            self.watch.look(self._costs, progress.frames, self.spent)
            progress.last_end = self.budget.done(progress)
        with self.clock.phase("learn"):
            for batch in self.experience.batches(data, progress.frames):
                progress.updates += 1
                for key, value in self.learner.update(batch).items():
                    for name, number in scalars(key, value, self.costs).items():
                        self.means.add(name, number)
        return finished

    def _record(self, data: TensorDictBase) -> None:
        """One row of ``metrics.csv`` (no wall-clock) and one of ``timing.csv``; a look at the critics in the states that were
        collected last, and at whether the policy is the best so far."""
        progress = self.progress
        progress.last_record = progress.frames
        if self.watchdog is not None:
            self.watchdog.look(data, progress.frames)
        if self.best is not None:
            counted = {name: getattr(progress, name) for name in ("frames", "episodes", "updates")}
            self.best.look(self.window.values, counted, self._check_finite)
        for name in _not_finite(self.means.sums):
            raise self._diverged(name)
        row = {
            "frames": progress.frames,
            "episodes": progress.episodes,
            "updates": progress.updates,
            **self.window.summary(),
            **self.means.take(),
        }
        for group in self.learner.optimizer.param_groups:
            row[f"lr_{group['name']}"] = group["lr"]
        self.metrics.write(row)
        seconds = self.clock.seconds
        self.timing.write({"frames": progress.frames, "updates": progress.updates, **seconds})
        self._log(row)
