"""Collectors of one process: the learner's own, and a worker's among several."""

from __future__ import annotations

import faulthandler
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.utils._pytree import tree_map_only
from torchrl.checkpoint import GlobalRNGState
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, TransformedEnv


class WholeCollector(Collector):
    """A collector whose state is that of mid-episode: its environments, its last observation, its counters.

    TorchRL's ``Collector.state_dict`` holds neither the base environment nor the observation that the
    next action answers, so a run restored from it alone starts new episodes.

    The environment has ``state_dict`` and ``load_state_dict``; arguments are :class:`torchrl.collectors.Collector`'s.
    """

    @property
    def _base_env(self) -> EnvBase:
        return self.env.base_env if isinstance(self.env, TransformedEnv) else self.env

    def example(self) -> TensorDictBase:
        """A transition as it is collected, [B] zeros."""
        return self.env.fake_tensordict()

    def state_dict(self) -> dict[str, Any]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Everything that the next collected frame depends on, but for the global generators."""
        state = {
            "env": self._base_env.state_dict(),
            "carrier": self._carrier.to_dict(retain_none=False),
            "frames": self._frames,
            "iter": self._iter,
        }
        if isinstance(self.env, TransformedEnv):
            state["transform"] = self.env.transform.state_dict()
        return state

    def load_state_dict(self, state_dict: Mapping[str, Any], **kwargs: Any) -> None:
        """Continue exactly where :meth:`state_dict` was taken.

        Raises:
            ValueError: it is of several workers.
        """
        if "workers" in state_dict:
            raise ValueError(
                f"collector has {len(state_dict['workers'])} workers there and none here."
            )
        self._base_env.load_state_dict(state_dict["env"])  # pyright: ignore[reportArgumentType]
        if "transform" in state_dict:
            self.env.transform.load_state_dict(state_dict["transform"])  # pyright: ignore
        built = self._carrier
        carrier = TensorDict.from_dict(
            state_dict["carrier"], batch_size=self.env.batch_size, device=self.env.device
        )
        # Laid out as the environment lays it out: a product of matrices may round otherwise.
        for key in set(carrier.keys(True, True)) & set(built.keys(True, True)):
            carrier[key] = torch.empty_like(built[key]).copy_(carrier[key])
        self._carrier = carrier
        self._frames, self._iter = state_dict["frames"], state_dict["iter"]


@dataclass
class Seat:
    """What a process collects with.

    Attributes:
        env: environments [B].
        policy: acts in them.
        take: overwrites what the two read by what a learner has learned, tensors by name.
    """

    env: EnvBase
    policy: Any
    take: Callable[[Mapping[str, Tensor]], None]


@contextmanager
def _deadline(seconds: float) -> Iterator[None]:
    """End this process, with a trace of where it is, if it is not through in time."""
    faulthandler.dump_traceback_later(seconds, exit=True, file=sys.__stderr__ or 2)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


class Worker(WholeCollector):
    """The collector of a process among several, with an agent of its own that is told what the learner learns.

    TorchRL's collectors of several processes make it in each of them, and call it there by :meth:`map_fn`.

    Args:
        create_env_fn: makes the :class:`Seat` of this process from ``create_env_kwargs``.
        patience: seconds for the start, and for each batch; a process that takes longer ends, and says where it was.
        **settings: of :class:`torchrl.collectors.Collector`.
    """

    def __init__(
        self,
        create_env_fn: Callable[..., Seat],
        *,
        patience: float,
        create_env_kwargs: Mapping[str, Any],
        policy: None = None,
        policy_factory: Any = None,
        traj_pool: Any = None,
        **settings: Any,
    ):
        self._patience, self._told = patience, {}
        with _deadline(patience):
            self._seat = create_env_fn(**create_env_kwargs)
            # Numbers of trajectories are its own: those of a pool depend on who comes first.
            super().__init__(self._seat.env, self._seat.policy, **settings)

    def rollout(self) -> TensorDictBase:
        with _deadline(self._patience):
            return super().rollout()

    def print_remote_collector_info(self) -> None:
        """Nothing: in its place RayCollector has one that prints the whole policy."""

    def take(self, learned: Mapping[str, Tensor] | None = None) -> None:
        """Act by what has been learned from now on; without an argument by the tensors of the last call, which a
        learner that shares its memory has changed."""
        if learned is not None:
            self._told = learned
        self._seat.take(self._told)

    def snapshot(self) -> dict[str, Any]:
        """All that the next frame depends on, in arrays: each tensor would take an open file on its way."""
        state = self.state_dict() | {
            "rng": GlobalRNGState().state_dict(),
            "trajectories": self._traj_pool.state_dict(),
        }
        return tree_map_only(Tensor, lambda value: value.cpu().numpy(), state)

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Continue exactly where :meth:`snapshot` was taken."""
        state = tree_map_only(np.ndarray, torch.tensor, snapshot)
        self.load_state_dict(state)
        GlobalRNGState().load_state_dict(state["rng"])
        self._traj_pool.load_state_dict(state["trajectories"])
