# TorchRL's specs take tuples that their annotations do not name.
# pyright: reportArgumentType=false
"""Any gymnasium environment with a cost, as one of TorchRL's."""

from __future__ import annotations

import importlib
import sysconfig
import traceback
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.wrappers import FlattenObservation, RescaleAction
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded

from saferl.envs.seeding import ReplayedEnv
from saferl.envs.task import Task


@dataclass(frozen=True)
class GymTask(Task):
    """A registered gymnasium environment, with continuous actions, whose ``info`` tells the cost of a step.

    Attributes:
        id: as of ``gymnasium.make``; ``module:Name-v0`` imports the module first.
        cost_key: the entry of ``info`` that is the cost; None: every cost is 0. A step that returns six
            values (observation, reward, cost, terminated, truncated, info), as Safety-Gymnasium's, says its
            cost itself.
        costs: of several costs the entries of ``info``, in place of ``cost_key``; a step of six values tells K numbers in
            this order. None: there is one cost.
        kwargs: of the environment.
        size, action_dim: numbers of an observation and of an action: the environment's own.
        horizon: decisions of an episode at most, in place of the environment's own limit; None: that one.
        seeds: (first, count) of the numbers of scenarios that training resets with; None: any number of 31 bits.
        test_seeds: likewise of tests, which play them one after the other; None: as many, after those of training.
        task: what runs are called.

    Raises:
        ValueError: a setting cannot be meant.
    """

    id: str
    cost_key: str | None = "cost"
    costs: tuple[str, ...] | None = None
    kwargs: dict[str, Any] | None = None
    size: int | None = None
    action_dim: int | None = None
    horizon: int | None = None
    seeds: tuple[int, int] | None = None
    test_seeds: tuple[int, int] | None = None
    task: str = "gym"

    def __post_init__(self):
        costs = (self.cost_key or "cost",) if self.costs is None else tuple(self.costs)
        object.__setattr__(self, "costs", costs)
        if not 0 < len(set(costs)) == len(costs):
            raise ValueError(f"task.costs must be null or different names, got {list(costs)}.")
        for name in ("seeds", "test_seeds"):
            numbers = getattr(self, name)
            if numbers is not None:
                first, count = numbers
                if first < 0 or count < 1 or first + count > 2**31:
                    raise ValueError(
                        f"task.{name} must be [first, count] with first >= 0 and count >= 1, all below 2**31, got "
                        f"{list(numbers)}."
                    )
        if self.test_seeds is not None and self.seeds is None:
            raise ValueError("task.test_seeds needs task.seeds, got null.")
        if self.horizon is not None and self.horizon < 1:
            raise ValueError(f"task.horizon must be null or >= 1, got {self.horizon}.")

    @property
    def in_tests(self) -> Mapping[str, Any]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Other scenarios than in training."""
        if self.seeds is None:
            return {}
        first, count = self.seeds
        return {"seeds": self.test_seeds or (first + count, count)}

    @property
    def scenarios(self) -> int | None:
        return None if self.seeds is None else self.seeds[1]

    def episodes(self, seed: int, count: int) -> Tensor:
        if self.seeds is None:
            return super().episodes(seed, count)
        first, several = self.seeds
        return first + torch.arange(count) % several

    def make(self) -> gymnasium.Env:
        """One environment as it is, but for its time limit, which :class:`GymEnvs` keeps.

        Raises:
            ValueError: it cannot be made, or its actions are not a bounded box of real numbers.
        """
        module, _, name = self.id.rpartition(":")
        try:
            if module:
                importlib.import_module(module)
            # Neither gymnasium's checker nor its time limit passes six values of a step on.
            env = gymnasium.make(
                name, max_episode_steps=-1, disable_env_checker=True, **(self.kwargs or {})
            )
        except (gymnasium.error.Error, ImportError, TypeError) as error:
            raise ValueError(f"task.id: {self.id} cannot be made: {error}") from error
        space = env.action_space
        real = isinstance(space, Box) and np.issubdtype(space.dtype, np.floating)
        if not (real and len(space.shape) == 1 and space.is_bounded("both")):  # pyright: ignore
            raise ValueError(
                f"task.id: {self.id} must have actions in a bounded box [A] of floats, got {space}."
            )
        return _Placed(env, self.id)

    def complete(self) -> Mapping[str, int]:
        """What is left open of ``size``, ``action_dim`` and ``horizon``, from the environment itself, of
        which one step is tried.

        Raises:
            ValueError: what is not open differs from it; or a step tells no cost, or no finite number.
        """
        env = _Cost(self.make(), self)
        limit = gymnasium.spec(self.id.rpartition(":")[2]).max_episode_steps
        horizon = limit if self.horizon is None else self.horizon
        if horizon is None:
            raise ValueError(f"task.horizon must be given: {self.id} has no time limit of its own.")
        found: dict[str, int] = {
            "size": gymnasium.spaces.flatdim(env.observation_space),
            "action_dim": env.action_space.shape[0],  # pyright: ignore[reportOptionalSubscript]
        }
        env.action_space.seed(0)
        with closing(env):
            env.reset(seed=0)
            env.step(env.action_space.sample())
        for key, value in found.items():
            if getattr(self, key) not in (None, value):
                raise ValueError(f"task.{key} is {value} in {self.id}, got {getattr(self, key)}.")
        return {**found, "horizon": horizon}


class GymEnvs(ReplayedEnv):
    """``num_envs`` gymnasium environments, stepped one after the other in this process.

    A run continues exactly after a resume where an episode follows from its seed and its actions.

    Args:
        task: which environment.
        num_envs: B.
        seed: of the sequences of episodes; None: others each time.
        device: of the tensors.

    Reads ``action`` [B, A] in [-1, 1], rescaled to the environment's box. Writes ``observation`` [B, size], flat, pixels in [0, 1],
    ``reward`` [B, 1] and ``cost`` [B, K].

    Raises:
        ValueError: as :meth:`GymTask.make`; or, in an episode, a cost that ``info`` has not, or an observation,
            reward or cost that is no finite number.

    >>> env = GymEnvs(GymTask("Pendulum-v1", cost_key=None), num_envs=2)
    >>> env.rollout(3)["next", "cost"].shape
    torch.Size([2, 3, 1])
    """

    def __init__(self, task: GymTask, num_envs: int = 1, seed: int | None = None, device=None):
        super().__init__(task, num_envs, device)
        batch, facts = self.batch_size, task.complete()
        self.horizon = facts["horizon"]
        self.observation_spec = Composite(
            observation=Unbounded(shape=(*batch, facts["size"])), shape=batch
        )
        self.action_spec = Bounded(-1.0, 1.0, shape=(*batch, facts["action_dim"]))
        self._make_ends()
        self._make_memory()
        self.envs: list[
            gymnasium.Env
        ] = []  # those that are there can be closed where the next one fails
        for _ in range(num_envs):
            self.envs.append(self._make())
        # Bytes are pixels.
        self._unit = 255.0 if self.envs[0].observation_space.dtype == np.uint8 else 1.0
        self.set_seed(seed)

    def _make(self) -> gymnasium.Env:
        env = self.task.make()
        ones = np.ones(env.action_space.shape, np.float32)  # pyright: ignore
        env = _Cost(env, self.task)
        return FlattenObservation(RescaleAction(env, -ones, ones))

    def _stack(self, ended: bool) -> TensorDict:
        keys = ("observation",)
        if ended:
            keys += ("reward", "cost", "terminated", "truncated", "done")
        values = {key: np.stack([last[key] for last in self._last]) for key in keys}
        tensors = {key: torch.from_numpy(value) for key, value in values.items()}
        return TensorDict(self._reals(tensors), self.batch_size).to(self.device or "cpu")

    def _numbers(self, **values: Any) -> dict[str, np.ndarray]:
        """Copies as float32, as some environments reuse their arrays."""
        found = {key: np.array(value, np.float32) for key, value in values.items()}
        for key, value in found.items():
            if not np.isfinite(value).all():
                raise ValueError(f"task.id: {self.task.id} gave {key}={value}.")
        return found

    def _next_seeds(self, reset: Tensor, seeds: Tensor | None = None) -> Tensor:
        found = super()._next_seeds(reset, seeds)
        if seeds is not None or self.task.seeds is None:
            return found
        first, count = self.task.seeds
        return first + found % count

    def _start(self, index: int, seed: int) -> dict[str, Any]:
        observation, _ = self.envs[index].reset(seed=seed)
        return self._numbers(observation=observation / self._unit)

    def _advance(self, index: int, action: np.ndarray) -> dict[str, Any]:
        observation, reward, terminated, truncated, info = self.envs[index].step(action)
        truncated = truncated or len(self._actions[index]) >= self.horizon
        ends = {"terminated": terminated, "truncated": truncated, "done": terminated or truncated}
        observation = observation / self._unit
        numbers = self._numbers(observation=observation, reward=[reward], cost=info[_COST])
        return {**numbers, **{key: np.array([end], bool) for key, end in ends.items()}}

    def close(self, **kwargs) -> None:
        for env in self.envs:
            env.close()
        super().close(**kwargs)


class _Placed(gymnasium.Wrapper):
    """Says where an environment failed, whose author alone can mend it."""

    def __init__(self, env: gymnasium.Env, name: str):
        super().__init__(env)
        self.name = name

    def _fault(self, what: str, error: Exception) -> ValueError:
        frames = traceback.extract_tb(error.__traceback__)
        libraries = (sysconfig.get_path("stdlib"), sysconfig.get_path("purelib"))
        own = [frame for frame in frames[1:] if not frame.filename.startswith(libraries)]
        place = (own or frames)[-1]
        return ValueError(
            f"task.id: {self.name} failed in {what}: {type(error).__name__}: {error} "
            f"({place.filename}, line {place.lineno}, in {place.name})"
        )

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        try:
            return self.env.reset(**options)
        except Exception as error:
            raise self._fault("reset", error) from error

    def step(self, action: Any) -> tuple[Any, ...]:
        try:
            return self.env.step(action)
        except Exception as error:
            raise self._fault("step", error) from error


_COST = "saferl_cost"


class _Cost(gymnasium.Wrapper):
    """Brings the costs of a step to one place in ``info``, wherever the environment says them."""

    def __init__(self, env: gymnasium.Env, task: GymTask):
        super().__init__(env)
        self.names: Sequence[str] = task.costs  # pyright: ignore[reportAttributeAccessIssue]
        self.free = task.cost_key is None and tuple(self.names) == ("cost",)
        self.setting = "task.cost_key" if self.names == (task.cost_key,) else "task.costs"

    def _numbers(self, value: Any, count: int) -> list[float]:
        numbers = np.asarray(value)
        if numbers.size != count or numbers.dtype.kind not in "biuf":
            must = "a cost must be one number" if count == 1 else f"costs must be {count} numbers"
            raise ValueError(f"{self.setting}: {must}, got {value!r}.")
        return [float(number) for number in numbers.reshape(-1)]

    def _told(self, info: dict[str, Any]) -> list[float]:
        if self.free:
            return [0.0] * len(self.names)
        for name in self.names:
            if name not in info:
                raise ValueError(
                    f"{self.setting}: info has no {name!r}, it has {sorted(info)}; "
                    f"name its costs by task.cost_key=KEY or task.costs=[KEY,...]; task.cost_key=null makes every cost 0."
                )
        return [number for name in self.names for number in self._numbers(info[name], 1)]

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, *own, terminated, truncated, info = self.env.step(action)
        costs = self._numbers(own[0], len(self.names)) if own else self._told(info)
        return observation, reward, terminated, truncated, {**info, _COST: costs}
