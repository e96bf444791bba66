"""Where experience is collected: in the learner's process, in several of its machine, or on several machines."""

from __future__ import annotations

import signal
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any

import torch
from torchrl.collectors import MultiSyncCollector, RemoteModuleWeightUpdater

from saferl.config.machine import cores
from saferl.config.schema import above, at_least
from saferl.training.collector import Seat, WholeCollector, Worker
from saferl.training.crew import Crew, Learns, Machines, Processes, WorkerLost


@dataclass(frozen=True)
class Plan:
    """What is to be collected.

    Attributes:
        agent: the learner's.
        device: the learner's.
        own: makes the seat of the learner's process.
        seat: makes that of worker ``index`` of ``workers``, in whatever process.
        num_envs: environments of all.
        decisions: of each in a batch.
        random_frames: of random actions, of all together, at the start.
    """

    agent: Learns
    device: torch.device
    own: Callable[[], Seat]
    seat: Callable[..., Seat]
    num_envs: int
    decisions: int
    random_frames: int

    @property
    def frames(self) -> int:
        """Of a batch."""
        return self.decisions * self.num_envs


class Collecting(ABC):
    """A way to collect, which conf/collector names."""

    workers: int = 1

    def check(self, num_envs: int) -> None:
        """Refuse what cannot collect from so many environments, before anything is built.

        Raises:
            ValueError: names the settings, and what they must be.
        """
        if num_envs % self.workers:
            raise ValueError(
                "env.num_envs must be a multiple of collector.workers, which share them, got "
                f"{num_envs} and {self.workers}."
            )

    @abstractmethod
    def collect(self, plan: Plan) -> WholeCollector | Crew:
        """Begin to; what is returned is to be shut down."""


class Single(Collecting):
    """In the learner's process, with its own networks."""

    def collect(self, plan: Plan) -> WholeCollector:
        seat = plan.own()
        return WholeCollector(
            seat.env,
            seat.policy,
            frames_per_batch=plan.frames,
            total_frames=-1,
            init_random_frames=plan.random_frames,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )


@dataclass(frozen=True)
class _Several(Collecting):
    workers: int = 2
    patience: float = 1800.0

    def __post_init__(self):
        at_least(1, self, "workers", prefix="collector.")
        above(0, self, "patience", prefix="collector.")


@dataclass(frozen=True)
class Multi(_Several):
    """In processes of this machine, by TorchRL's MultiSyncCollector; on the CPU, wherever the learner is.

    Args:
        workers: processes, which share the environments.
        patience: seconds that the start of a worker, and a batch, may take before it is given up.

    Raises:
        ValueError: a number out of range.
    """

    def check(self, num_envs: int) -> None:
        super().check(num_envs)
        if self.workers > (usable := max(2, cores())):
            raise ValueError(
                f"collector.workers must be <= {usable}, the cores that are there, got {self.workers}."
            )

    def collect(self, plan: Plan) -> Processes:
        seat: Any = partial(plan.seat, workers=self.workers)
        worker: Any = partial(Worker, patience=self.patience)
        try:
            collector = MultiSyncCollector(
                [seat] * self.workers,
                create_env_kwargs=[{"index": index} for index in range(self.workers)],
                collector_class=worker,
                frames_per_batch=plan.frames,
                total_frames=-1,
                init_random_frames=plan.random_frames,
                cat_results=0,
                use_buffers=True,
                num_threads=torch.get_num_threads(),
                init_fn=_undisturbed,
                auto_register_policy_transforms=False,
            )
        except ValueError as error:  # of a worker, with its trace
            raise ValueError(str(error).partition("\n\nWorker traceback")[0]) from error
        except RuntimeError as error:
            if "failed to initialize" not in str(error):
                raise
            raise WorkerLost(f"{str(error).partition('. ')[0]}.", killed=False) from error
        return Processes(collector, self.workers, plan.agent, plan.device)


def _undisturbed() -> None:
    """Ctrl-C and SIGTERM reach all processes of a terminal or a job; the learner needs its workers to save by."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


@dataclass(frozen=True)
class Ray(_Several):
    """In processes of a Ray cluster, by TorchRL's RayCollector; on the CPU, wherever the learner is.

    The cluster is the one that the environment variable ``RAY_ADDRESS`` names; without it, one of this machine
    is begun. Each machine needs saferl, and the packages of your own parts.

    Args:
        workers: processes, which share the environments.
        patience: seconds that the start of a worker, and a batch, may take before it is given up.
        cpus: cores of each worker, by which Ray distributes them.

    Raises:
        ValueError: a number out of range.
    """

    cpus: float = 1.0

    def __post_init__(self):
        super().__post_init__()
        above(0, self, "cpus", prefix="collector.")

    def check(self, num_envs: int) -> None:
        super().check(num_envs)
        if find_spec("ray") is None:
            raise ValueError("collector=ray needs Ray: pip install 'saferl[ray]'.")

    def collect(self, plan: Plan) -> Machines:
        from torchrl.collectors.distributed import RayCollector  # needs the extra

        settings = {"patience": self.patience, "auto_register_policy_transforms": False}
        seat: Any = partial(plan.seat, workers=self.workers)
        worker: Any = Worker
        collector = RayCollector(
            [seat] * self.workers,
            collector_class=worker,
            collector_kwargs=[
                settings | {"create_env_kwargs": {"index": index}} for index in range(self.workers)
            ],
            remote_configs={"num_cpus": self.cpus},
            ray_init_config={"include_dashboard": False, "log_to_driver": True},
            frames_per_batch=plan.frames,
            total_frames=sys.maxsize,
            init_random_frames=plan.random_frames,
            sync=True,
            weight_updater=RemoteModuleWeightUpdater(),  # says that it is up to us: Worker.take
        )
        return Machines(collector, self.workers, plan.agent, plan.device)
