"""Small trainers, and their loop by hand."""

from __future__ import annotations

from pathlib import Path

from small import EMPTY, SMALL, compose
from tensordict import TensorDict

from saferl.algorithms.assemble import build_trainer
from saferl.training.trainer import Trainer


def trainer_of(folder: Path, *overrides: str) -> Trainer:
    return build_trainer(compose(*SMALL, *EMPTY, *overrides), folder)


def collect(trainer: Trainer, batches: int) -> list[TensorDict]:
    """Run the loop's body; returns what was collected."""
    data, iterator = [], iter(trainer.collector)
    for _ in range(batches):
        data.append(next(iterator))
        trainer._take(data[-1])
    return data
