"""Random numbers as functions of a seed, and environments whose episodes are.

No generator is shared: what happens in an episode follows from its own 31-bit seed, whoever plays beside it.
"""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

_MIX = (-7046029254386353131, -4658895280553007687, -7723592293110705685)
U31 = 0x7FFFFFFF


def _shift(x: Tensor, bits: int) -> Tensor:
    return (x >> bits) & ((1 << (64 - bits)) - 1)


def mix(seed: Tensor, stream: int | Tensor) -> Tensor:
    """Hash int64 seeds [...] and a stream number into new int64 seeds (SplitMix64's finaliser).

    A draw is a function of its seed alone, so an episode does not feel its neighbours.
    """
    x = seed + torch.as_tensor(stream + 1, device=seed.device) * _MIX[0]
    x = (x ^ _shift(x, 30)) * _MIX[1]
    x = (x ^ _shift(x, 27)) * _MIX[2]
    return x ^ _shift(x, 31)


def uniform(seed: Tensor, stream: int) -> Tensor:
    """A number in [0, 1), float64 [...], from int64 seeds [...] and a stream number."""
    return _shift(mix(seed, stream), 11).to(torch.float64) * 2.0**-53


def episode_seeds(seed: int, count: int) -> Tensor:
    """Seeds [count] of the episodes of a test with this seed."""
    return mix(torch.arange(count, dtype=torch.int64), seed) & U31


class SeededEnv(EnvBase):
    """A batch of environments, each with its own sequence of seeded episodes; ``reward`` [B, 1] and ``cost`` [B, K], a
    number for each of the task's costs.

    ``env.reset(seeds=...)`` plays the episodes of these seeds, B integers, with or without transforms around the
    environment; the sequences stand still. Without them every environment goes on in its own sequence, which follows
    from ``set_seed``, or is another one each time.

    Args:
        task: its settings.
        num_envs: B.
        device: of the tensors.

    Attributes:
        task: as given.
        real: of observations, rewards and costs: torch's default when the environment was made.
        kept: names of the tensors that are its state.

    Raises:
        ValueError: ``num_envs`` is less than one.
    """

    kept: tuple[str, ...] = ("_stream", "_episode")

    def __init__(self, task: Any, num_envs: int, device=None):
        if num_envs < 1:
            raise ValueError(f"num_envs must be >= 1, got {num_envs}.")
        super().__init__(device=device, batch_size=[num_envs])  # pyright: ignore[reportArgumentType]
        self.task = task  # a saferl.envs.task.Task, which asks this module for seeds
        self.real = torch.get_default_dtype()

    def _reals(self, values: dict[str, Any]) -> dict[str, Any]:
        """Numbers in the type of the specs, whatever they were computed in."""
        return {k: v.to(self.real) if v.is_floating_point() else v for k, v in values.items()}

    def _make_ends(self) -> None:
        """The specs of reward, cost and the ends of episodes."""
        batch = self.batch_size
        flag = Binary(n=1, shape=(*batch, 1), dtype=torch.bool)  # pyright: ignore
        scalar = Unbounded(shape=(*batch, 1))  # pyright: ignore[reportArgumentType]
        cost = Unbounded(shape=(*batch, len(self.task.costs)))  # pyright: ignore
        self.reward_spec = Composite(reward=scalar, cost=cost, shape=batch)
        self.full_done_spec = Composite(
            done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=batch
        )
        self.to(self.device) if self.device is not None else None

    def _set_seed(self, seed: int | None) -> None:
        # Copies of one constructor, as workers make them, must not play the same episodes unasked.
        seed = secrets.randbits(31) if seed is None else int(seed)
        index = torch.arange(self.batch_size[0], dtype=torch.int64, device=self.device)
        self._stream = mix(mix(torch.full_like(index, seed), 0) + index, 0)
        self._episode = torch.zeros_like(self._stream)

    def _next_seeds(self, reset: Tensor, seeds: Tensor | None = None) -> Tensor:
        """The given ``seeds`` [B]; without them the next of each sequence (31 bits), which goes on where ``reset`` [B] says."""
        if seeds is not None:
            return torch.as_tensor(seeds, dtype=torch.int64, device=self.device).reshape(
                self.batch_size
            )
        seeds = mix(self._stream, self._episode) & U31
        self._episode = self._episode + reset
        return seeds

    def _reset_mask(self, tensordict: TensorDictBase | None) -> Tensor:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            return torch.ones(self.batch_size, dtype=torch.bool, device=self.device)
        return mask.reshape(self.batch_size)

    def state_dict(self, *args, **kwargs) -> dict[str, Tensor]:
        return {name.lstrip("_"): getattr(self, name) for name in self.kept}

    def load_state_dict(self, state_dict: dict[str, Tensor], *args, **kwargs) -> None:
        for name in self.kept:
            value = state_dict[name.lstrip("_")]
            setattr(self, name, value.to(self.device or "cpu").clone())


class ReplayedEnv(SeededEnv):
    """A batch of environments that are stepped one by one, and whose episodes follow from seed and actions.

    An episode that has ended stands still until its reset, so that playing a batch to its last end costs
    nothing more. The state is the seeds and the actions of the running episodes, which are played again. A
    subclass calls :meth:`_make_ends`, then :meth:`_make_memory`, and defines :meth:`_start` and :meth:`_advance`,
    or, where several go on at once, :meth:`_start_all` and :meth:`_advance_all`; and :meth:`_stack`.

    Attributes:
        made_with: what the constructor of a copy is given besides task, number and device.
    """

    made_with: Mapping[str, Any] = MappingProxyType({})

    def _make_memory(self) -> None:
        count = self.batch_size[0]
        self._seeds = torch.zeros(count, dtype=torch.int64)
        self._actions: list[list[np.ndarray]] = [[] for _ in range(count)]
        self._last: list[dict[str, Any]] = [{} for _ in range(count)]
        self.is_closed = False  # TorchRL closes no environment that does not say so

    def _start(self, index: int, seed: int) -> dict[str, Any]:
        """What an environment shows at the start of its episode ``seed``, by key, without batch dimension."""
        raise NotImplementedError

    def _advance(self, index: int, action: np.ndarray) -> dict[str, Any]:
        """What it shows after an action [A], with reward, cost and ends."""
        raise NotImplementedError

    def _stack(self, ended: bool) -> TensorDictBase:
        """The last of each environment [B, ...], with reward, cost and ends after a step."""
        raise NotImplementedError

    def _start_all(self, seeds: dict[int, int]) -> dict[int, dict[str, Any]]:
        """What these environments show at the start of their episodes: :meth:`_start` of each."""
        return {index: self._start(index, seed) for index, seed in seeds.items()}

    def _advance_all(self, actions: dict[int, np.ndarray]) -> dict[int, dict[str, Any]]:
        """What these environments show after an action of each: :meth:`_advance` of each."""
        return {index: self._advance(index, action) for index, action in actions.items()}

    def _begin(self, rows: list[int]) -> None:
        for index in rows:
            self._actions[index] = []
        for index, shown in self._start_all({i: int(self._seeds[i]) for i in rows}).items():
            self._last[index] = shown

    def _go_on(self, actions: dict[int, np.ndarray]) -> None:
        going = {i: action for i, action in actions.items() if not self._last[i].get("done")}
        for index, action in going.items():
            self._actions[index].append(action)
        for index, shown in self._advance_all(going).items():
            self._last[index] = shown

    def _reset(
        self, tensordict: TensorDictBase | None = None, seeds: Tensor | None = None, **kwargs
    ) -> TensorDictBase:
        reset = self._reset_mask(tensordict)
        self._seeds = torch.where(
            reset, self._next_seeds(reset, seeds), self._seeds.to(reset.device)
        ).cpu()
        self._begin(reset.nonzero().flatten().tolist())
        return self._stack(ended=False)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actions = tensordict.get("action").cpu()
        if not actions.isfinite().all():  # what follows would look like a fault of the environment
            raise ValueError("the policy gave an action that is not finite.")
        self._go_on(dict(enumerate(actions.numpy().copy())))
        return self._stack(ended=True)

    def __reduce__(self) -> tuple:
        """A copy is made anew and plays the running episodes again: simulators can rarely be copied or pickled."""
        settings = {"device": self.device, **self.made_with}
        return _again, (type(self), self.task, self.batch_size[0], settings, self.state_dict())

    def __deepcopy__(self, memo: dict) -> ReplayedEnv:
        function, arguments = self.__reduce__()
        return function(*arguments)

    def state_dict(self, *args, **kwargs) -> dict[str, Tensor]:
        """Seeds, and the actions of the running episodes."""
        state = {**super().state_dict(), "seeds": self._seeds}
        none = np.zeros((0, self.action_spec.shape[-1]), np.float32)
        for index, actions in enumerate(self._actions):
            state[f"actions_{index}"] = torch.from_numpy(np.stack(actions) if actions else none)
        return state

    def load_state_dict(self, state_dict: dict[str, Tensor], *args, **kwargs) -> None:
        """Replay the running episodes up to where :meth:`state_dict` was taken."""
        super().load_state_dict(state_dict)
        self._seeds = state_dict["seeds"].cpu().clone()
        for index in range(self.batch_size[0]):
            self._begin([index])
            for action in state_dict[f"actions_{index}"].cpu().numpy():
                self._go_on({index: action.copy()})


def _again(kind: Any, task: Any, num_envs: int, settings: dict[str, Any], state: Any) -> Any:
    env = kind(task, num_envs, **settings)
    env.load_state_dict(state)
    return env
