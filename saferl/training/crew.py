"""Several processes that collect for one learner."""

from __future__ import annotations

import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, Protocol

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.utils._pytree import tree_map_only
from torchrl.collectors import MultiSyncCollector


class Learns(Protocol):
    """What workers are told of an agent."""

    def learned(self) -> dict[str, Tensor]: ...

    def switches(self) -> dict[str, Tensor]: ...

    def take(self, learned: Mapping[str, Tensor]) -> None: ...


class WorkerLost(ChildProcessError):
    """A worker is gone, and with it what it had begun.

    Attributes:
        killed: whether somebody else ended it, as the system does that has no memory left; it may be begun again.
    """

    def __init__(self, message: str, killed: bool):
        super().__init__(message)
        self.killed = killed


class Crew(ABC):
    """TorchRL's collector of several processes, each of which is told before each batch what has been learned.

    Batches come in the order of the workers, whoever is through first: a seed gives the same training again.

    Args:
        collector: of :class:`saferl.training.collector.Worker` in each process, in step with each other.
        workers: how many.
        agent: the learner's.
        device: the learner's.
    """

    def __init__(self, collector: Any, workers: int, agent: Learns, device: torch.device):
        self.collector, self.workers = collector, workers
        self.agent, self.device = agent, device

    @abstractmethod
    def tell(self) -> None:
        """Give each worker what has been learned; it holds from its next frame on."""

    @abstractmethod
    def lost(self) -> WorkerLost | None:
        """The worker that is gone, if one is."""

    @property
    @abstractmethod
    def frames(self) -> int:
        """Collected by all."""

    @frames.setter
    @abstractmethod
    def frames(self, count: int) -> None: ...

    @contextmanager
    def _watched(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # many kinds, as it depends on what it was busy with
            lost = self.lost()
            if lost is None:
                raise
            raise lost from error

    def __iter__(self) -> Iterator[TensorDictBase]:
        # Not the collector's own iterator, which would end the others before one can see who is gone.
        batches = self.collector.iterator()
        while True:
            with self._watched():
                self.tell()
                data = next(batches)
            yield self.whole(data).to(self.device)

    def whole(self, data: TensorDictBase) -> TensorDictBase:
        """The workers' data as one batch [B, T]."""
        return data

    def example(self) -> TensorDictBase:
        """A worker's transition as it is collected, [b] zeros."""
        with self._watched():
            return self.collector.map_fn("example")[0]

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next frames of all workers depend on."""
        with self._watched():
            states = self.collector.map_fn("snapshot")
        return {
            "frames": self.frames,
            "switches": self.agent.switches(),
            "workers": {
                str(index): tree_map_only(np.ndarray, torch.tensor, state)
                for index, state in enumerate(states)
            },
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where :meth:`state_dict` was taken.

        Raises:
            ValueError: it is of another number of workers.
        """
        workers = dict(state.get("workers", {}))
        if len(workers) != self.workers:
            there = len(workers) or "no"
            raise ValueError(f"collector has {there} workers there and {self.workers} here.")
        arrays = tree_map_only(Tensor, lambda value: value.cpu().numpy(), workers)
        with self._watched():
            self.collector.map_fn("restore", [(arrays[str(i)],) for i in range(self.workers)])
        self.frames = state["frames"]
        self.agent.take(state["switches"])

    def shutdown(self) -> None:
        """End the workers."""
        threads = torch.get_num_threads()
        self.collector.shutdown()
        torch.set_num_threads(threads)  # which TorchRL's collectors change


class Processes(Crew):
    """Of one machine: what is learned lies in memory that they share."""

    collector: MultiSyncCollector

    def __init__(
        self, collector: MultiSyncCollector, workers: int, agent: Learns, device: torch.device
    ):
        super().__init__(collector, workers, agent, device)
        self._shared: dict[str, Tensor] = {}

    def tell(self) -> None:
        learned = self.agent.learned()
        if self._shared:
            for name, value in learned.items():
                self._shared[name].copy_(value)
            self.collector.map_fn("take")
            return
        self._shared = {k: v.to("cpu", copy=True).share_memory_() for k, v in learned.items()}
        self.collector.map_fn("take", [(self._shared,)] * self.workers)

    def lost(self) -> WorkerLost | None:
        time.sleep(0.5)  # until the system has told
        for index, process in enumerate(self.collector.procs):
            code = None
            with suppress(ValueError):  # TorchRL has closed it, which was one of the others
                code = process.exitcode
            if code is None:
                continue
            who = f"worker {index} of {self.workers}"
            if code < 0:
                how = f"was killed by {signal.Signals(-code).name}"
                return WorkerLost(f"{who} {how}.", killed=True)
            how = f"ended with status {code}, on a mistake or for taking longer than collector.patience"
            return WorkerLost(f"{who} {how}; its trace stands above.", killed=False)
        return None

    @property
    def frames(self) -> int:
        return self.collector._frames

    @frames.setter
    def frames(self, count: int) -> None:
        self.collector._frames = count


class Machines(Crew):
    """Processes of a Ray cluster: what is learned is sent to each machine once."""

    def tell(self) -> None:
        import ray  # of an extra

        learned = ray.put({k: v.to("cpu", copy=True) for k, v in self.agent.learned().items()})
        self.collector.map_fn("take", [(learned,)] * self.workers)

    def lost(self) -> WorkerLost | None:
        import ray
        import ray.exceptions

        calls = [each.__ray_ready__.remote() for each in self.collector.remote_collectors]
        answered, _ = ray.wait(calls, num_returns=len(calls), timeout=10.0)
        for index, call in enumerate(calls):
            try:
                if call in answered:  # one that is gone does, too
                    ray.get(call)
            except ray.exceptions.RayActorError as error:
                how = " ".join(str(error).split())
                return WorkerLost(f"worker {index} of {self.workers} is gone: {how}", killed=True)
        return None

    def whole(self, data: TensorDictBase) -> TensorDictBase:
        return data.flatten(0, 1)

    @property
    def frames(self) -> int:
        return self.collector.collected_frames

    @frames.setter
    def frames(self, count: int) -> None:
        self.collector.collected_frames = count
