# TorchRL's specs take tuples that their annotations do not name.
# pyright: reportArgumentType=false
"""Any gymnasium environment with a cost, as one of TorchRL's."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.wrappers import FlattenObservation, RescaleAction
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded

from saferl.envs.seeding import SeededEnv


@dataclass(frozen=True)
class GymTask:
    """A registered gymnasium environment, with continuous actions, whose ``info`` tells the cost of a step.

    Attributes:
        id: as of ``gymnasium.make``; ``module:Name-v0`` imports the module first.
        cost_key: the entry of ``info`` that is the cost; None: every cost is 0. A step that returns six
            values (observation, reward, cost, terminated, truncated, info), as Safety-Gymnasium's, says its
            cost itself.
        kwargs: of the environment.
        size, action_dim, horizon: numbers of an observation and of an action, and decisions of an episode at
            most. Taken from the environment where they are None.
        task: what runs are called.

    Raises:
        ValueError: there is no such environment.
    """

    id: str
    cost_key: str | None = "cost"
    kwargs: dict[str, Any] | None = None
    size: int | None = None
    action_dim: int | None = None
    horizon: int | None = None
    task: str = "gym"

    def make(self) -> gymnasium.Env:
        """One environment: flat observations, actions in [-1, 1].

        Raises:
            ValueError: it cannot be made, or its actions are not a finite box.
        """
        module, _, name = self.id.rpartition(":")
        try:
            if module:
                importlib.import_module(module)
            # Six values of a step would not pass the checker.
            env = gymnasium.make(name, disable_env_checker=True, **(self.kwargs or {}))
        except (gymnasium.error.Error, ImportError) as error:
            raise ValueError(f"task.id: {self.id} cannot be made: {error}") from error
        space = env.action_space
        if not (isinstance(space, Box) and len(space.shape) == 1 and space.is_bounded("both")):
            raise ValueError(
                f"task.id: {self.id} must have actions in a bounded box [A], got {space}."
            )
        return env

    def complete(self) -> dict[str, int]:
        """What is left open of ``size``, ``action_dim`` and ``horizon``, from the environment itself."""
        env = self.make()
        limit = self.horizon or (env.spec.max_episode_steps if env.spec else None)
        if limit is None:
            raise ValueError(f"task.horizon must be given: {self.id} has no time limit of its own.")
        found = {
            "size": gymnasium.spaces.flatdim(env.observation_space),
            "action_dim": env.action_space.shape[0],  # pyright: ignore[reportOptionalSubscript]
            "horizon": limit,
        }
        env.close()
        return found


class GymEnvs(SeededEnv):
    """``num_envs`` gymnasium environments, stepped one after the other in this process.

    An episode that has ended stands still until its reset. A run continues exactly after a resume where an
    episode follows from its seed and its actions, which are replayed.

    Args:
        scenario: which environment.
        num_envs: B.
        seed: of the sequences of episodes.
        device: of the tensors.

    Reads ``action`` [B, A] in [-1, 1], rescaled to the environment's box. Writes ``observation`` [B, size]
    float32, ``reward`` and ``cost`` [B, 1].

    Raises:
        ValueError: as :meth:`GymTask.make`.
        KeyError: a step's ``info`` has no ``cost_key``.

    >>> env = GymEnvs(GymTask("Pendulum-v1", cost_key=None), num_envs=2)
    >>> env.rollout(3)["next", "cost"].shape
    torch.Size([2, 3, 1])
    """

    def __init__(self, scenario: GymTask, num_envs: int = 1, seed: int = 0, device=None):
        super().__init__(num_envs, device)
        self.scenario = scenario
        self.envs = [self._make() for _ in range(num_envs)]
        batch, facts = self.batch_size, scenario.complete()
        self.horizon = facts["horizon"]
        self.observation_spec = Composite(
            observation=Unbounded(shape=(*batch, facts["size"])), shape=batch
        )
        self.action_spec = Bounded(-1.0, 1.0, shape=(*batch, facts["action_dim"]))
        self._make_ends()
        self._seeds = torch.zeros(num_envs, dtype=torch.int64)
        self._actions: list[list[np.ndarray]] = [[] for _ in range(num_envs)]
        self._last: list[dict[str, Any]] = [{} for _ in range(num_envs)]
        self.set_seed(seed)

    def _make(self) -> gymnasium.Env:
        env = self.scenario.make()
        space = env.action_space
        env = _Cost(env, self.scenario.cost_key)
        low, high = (np.full(space.shape, sign, np.float32) for sign in (-1.0, 1.0))  # pyright: ignore
        return FlattenObservation(RescaleAction(env, low, high))

    def _stack(self, keys: tuple[str, ...]) -> TensorDict:
        out = {key: np.stack([last[key] for last in self._last]) for key in keys}
        values = {
            key: torch.from_numpy(value).to(self.device or "cpu") for key, value in out.items()
        }
        return TensorDict(values, batch_size=self.batch_size, device=self.device)

    def _reset_one(self, index: int) -> None:
        self._actions[index] = []
        observation, _ = self.envs[index].reset(seed=int(self._seeds[index]))
        self._last[index] = {"observation": np.array(observation, np.float32)}

    def _step_one(self, index: int, action: np.ndarray) -> None:
        if self._last[index].get("done"):
            return
        self._actions[index].append(action)
        observation, reward, terminated, truncated, info = self.envs[index].step(action)
        truncated = truncated or len(self._actions[index]) >= self.horizon
        self._last[index] = {
            "observation": np.array(observation, np.float32),  # a copy: some reuse their array
            "reward": np.array([reward], np.float32),
            "cost": np.array([info[_COST]], np.float32),
            "terminated": np.array([terminated], bool),
            "truncated": np.array([truncated], bool),
            "done": np.array([terminated or truncated], bool),
        }

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDictBase:
        reset = self._reset_mask(tensordict)
        self._seeds = torch.where(
            reset, self._next_seeds(tensordict, reset), self._seeds.to(reset.device)
        ).cpu()
        for index in reset.nonzero().flatten().tolist():
            self._reset_one(index)
        return self._stack(("observation",))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        for index, action in enumerate(tensordict.get("action").cpu().numpy()):
            self._step_one(index, action.copy())
        return self._stack(("observation", "reward", "cost", "terminated", "truncated", "done"))

    def state_dict(self, *args, **kwargs) -> dict[str, Tensor]:
        """Seeds, and the actions of the running episodes."""
        state = {"stream": self._stream, "episode": self._episode, "seeds": self._seeds}
        size = self.action_spec.shape[-1]
        for index, actions in enumerate(self._actions):
            state[f"actions_{index}"] = torch.from_numpy(
                np.stack(actions) if actions else np.zeros((0, size), np.float32)
            )
        return state

    def load_state_dict(self, state_dict: dict[str, Tensor], *args, **kwargs) -> None:
        """Replay the running episodes up to where :meth:`state_dict` was taken."""
        self._stream = state_dict["stream"].to(self.device or "cpu").clone()
        self._episode = state_dict["episode"].to(self.device or "cpu").clone()
        self._seeds = state_dict["seeds"].cpu().clone()
        for index in range(len(self.envs)):
            self._reset_one(index)
            for action in state_dict[f"actions_{index}"].cpu().numpy():
                self._step_one(index, action.copy())

    def close(self, **kwargs) -> None:
        for env in self.envs:
            env.close()
        super().close(**kwargs)


_COST = "saferl_cost"


class _Cost(gymnasium.Wrapper):
    """Brings the cost of a step to one place in ``info``, wherever the environment says it."""

    def __init__(self, env: gymnasium.Env, key: str | None):
        super().__init__(env)
        self.key = key

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, *cost, terminated, truncated, info = self.env.step(action)
        if cost:
            (value,) = cost
        elif self.key is None:
            value = 0.0
        elif self.key in info:
            value = info[self.key]
        else:
            raise KeyError(
                f"task.cost_key: info has no {self.key!r}, it has {sorted(info)}; "
                "null makes every cost 0."
            )
        return observation, reward, terminated, truncated, {**info, _COST: float(value)}
