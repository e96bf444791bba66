"""What corrects actions on the way to the environment has in common: it executes another action, and says so."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Transform

_STASH = "_correction"


class Switched:
    """A switch, ``enabled``, that a transform shares with its clones: TorchRL makes them of the transforms of an environment
    that is wrapped once more, and whoever holds the first one must still reach what runs."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._switch = [True]  # no tensor: to ask a GPU would be to wait for it

    @property
    def enabled(self) -> bool:
        return self._switch[0]

    @enabled.setter
    def enabled(self, on: bool) -> None:
        self._switch[0] = on


class Correction(Transform):
    """Base of what executes another action than the proposed one; a subclass says which in :meth:`correct`.

    Append it outermost, outside a ``SerialEnv`` or ``ParallelEnv``: it then meets the policy's own action, random
    warm-up actions included, with all environments in one batch. ``action`` in collected data stays the proposed one.

    Args:
        action_key: the entry of the proposed action.

    Attributes:
        reports: what it writes under ``next`` beside ``action_executed`` [*B, A], each [*B, N], with its kind and N. All are
            zero after a reset.
        latencies: seconds that each of the last 10,000 corrections took.
    """

    reports: Mapping[str, tuple[torch.dtype, int]] = {"intervened": (torch.bool, 1)}

    def __init__(self, action_key: NestedKey = "action"):
        super().__init__()
        self.action_key = unravel_key(action_key)
        self.latencies = deque[float](maxlen=10_000)
        self._box: dict[str, Any] | None = None

    @property
    def reads(self) -> Sequence[NestedKey]:
        """What :meth:`correct` reads, the action among it."""
        raise NotImplementedError

    def correct(self, tensordict: TensorDictBase, **box: Any) -> TensorDict:
        """What is to be executed in place of the proposed action, [*B]: ``action_executed`` and :attr:`reports`.

        Args:
            tensordict: [*B], with :attr:`reads`; stays as it is.
            **box: ``low`` and ``high`` of the actions.
        """
        raise NotImplementedError

    def set_progress(self, fraction: float) -> None:
        """Told which share of a run is spent, for those who begin later."""

    def _env(self) -> EnvBase:
        env = self.parent
        if env is None:
            raise RuntimeError(f"{type(self).__name__} must be appended to an environment.")
        return env

    def _bounds(self) -> dict[str, Any]:
        """``low`` and ``high`` of the environment's actions: numbers where all coordinates share them."""
        if self._box is None:
            spec = self._env().full_action_spec[self.action_key]
            ends: dict[str, Any] = {"low": -torch.inf, "high": torch.inf}
            if isinstance(spec, Bounded):
                ends = {name: getattr(spec.space, name) for name in ends}
                ends = {name: end.reshape(-1, end.shape[-1])[0] for name, end in ends.items()}
                if all((end == end[0]).all() for end in ends.values()):
                    ends = {name: float(end[0]) for name, end in ends.items()}
            self._box = ends
        return self._box

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        report = self.correct(tensordict, **self._bounds())
        # Inner transforms may rescale the action from here on: the report stays in policy units.
        tensordict.set(_STASH, report)
        return tensordict.set(self.action_key, report.get("action_executed").clone())

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.update(tensordict.get(_STASH))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        env = self.container
        if env is None:
            raise RuntimeError(f"{type(self).__name__} must be appended to an environment.")
        for key in ("action_executed", *self.reports):
            tensordict_reset.set(key, env.full_observation_spec[key].zero())
        return tensordict_reset

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        self._box = None  # it may be another environment than before
        action = self._env().full_action_spec[self.action_key]
        report = observation_spec.clone()
        report["action_executed"] = Unbounded(
            action.shape, device=action.device, dtype=action.dtype
        )
        for key, (dtype, size) in self.reports.items():
            kind = Binary if dtype is torch.bool else Unbounded
            shape = torch.Size((*report.shape, size))
            report[key] = kind(shape=shape, device=action.device, dtype=dtype)
        return report
