"""What a task says of itself, so that nothing else asks what kind of task it has."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from saferl.envs.ports import Feature, Port
from saferl.envs.seeding import episode_seeds


class Task:
    """Base of a task's settings, which are a frozen dataclass.

    As it stands here a task observes one vector, ``observation`` [size], and has neither drivers nor pictures.

    Attributes:
        task: what runs are called.
        size, action_dim: numbers of an observation and of an action.
        costs: names of the K numbers that ``cost`` [*B, K] holds.
        horizon: decisions of an episode at most; None where :meth:`complete` tells.
        drivers: scripted policies by name, each made from a seed.
        demonstrators: names of the drivers whose transitions a replay buffer may begin with.
        in_tests: what a test changes in these settings.
        pictures: whether :meth:`draw` draws.
        vector: the entry of an observation [size] that every network reads.
    """

    task: str
    size: Any
    action_dim: Any
    horizon: Any
    costs: Sequence[str] = ("cost",)
    drivers: ClassVar[Mapping[str, Callable[[int], TensorDictModuleBase]]] = {}
    demonstrators: ClassVar[Sequence[str]] = ()
    in_tests: ClassVar[Mapping[str, Any]] = {}
    pictures: ClassVar[bool] = False
    vector: ClassVar[str] = "observation"

    @property
    def observed(self) -> Mapping[str, tuple[int, ...]]:
        """What a network may read of a step: keys, and their shapes without batch dimensions."""
        return {"observation": (self.size,)}

    @property
    def features(self) -> Mapping[str, Mapping[str, Feature]]:
        """What is known of the numbers of what is observed and of ``action``, by key."""
        return {}

    @property
    def ports(self) -> dict[str, Port]:
        """What a policy may read, by key, and its ``action``."""
        shapes = {**self.observed, "action": (self.action_dim,)}
        return {
            key: Port(("batch", *shape), self.features.get(key, {}))
            for key, shape in shapes.items()
        }

    def from_state(self) -> Any:
        """A function from tensors of the state to the entries of the observation, with ``ports`` that say what it reads.

        Raises:
            ValueError: the task observes its state itself.
        """
        raise ValueError(
            f"observation=state is of the road, got task={self.task}: take observation=features."
        )

    @property
    def network(self) -> Mapping[str, Any]:
        """What a network may be built from, by the names of its arguments: sizes, feature scales."""
        return {"size": self.size, "action_dim": self.action_dim}

    def widened(self, count: int) -> Mapping[str, Any]:
        """:attr:`network` where so many numbers of size 1 stand behind :attr:`vector`."""
        return {**self.network, "size": self.size + count}

    @property
    def title(self) -> str:
        """What heads a table of a test."""
        return self.task

    def complete(self) -> Mapping[str, Any]:
        """Settings that are left open and follow from the environment itself."""
        return {}

    def as_test(self) -> Self:
        """The task under the conditions of a test, :attr:`in_tests`."""
        changes = {
            key: dataclasses.replace(getattr(self, key), **value)
            if isinstance(value, Mapping)
            else value
            for key, value in self.in_tests.items()
        }
        return dataclasses.replace(self, **changes)  # pyright: ignore[reportArgumentType]

    @property
    def scenarios(self) -> int | None:
        """How many different episodes there are; None: any number."""
        return None

    def check_episodes(self, name: str, count: int) -> None:
        """Check how many episodes of a test are asked for, by the setting ``name``.

        Raises:
            ValueError: fewer than one, or more than there are scenarios: the rest would be the first ones again.
        """
        if count < 1:
            raise ValueError(f"{name} must be >= 1, got {count}.")
        if self.scenarios is not None and count > self.scenarios:
            raise ValueError(
                f"{name} must be <= {self.scenarios}, the scenarios of tests (task.test_seeds), got {count}."
            )

    def episodes(self, seed: int, count: int) -> Tensor:
        """The seeds [count] of a test's episodes.

        Args:
            seed: of the test.
            count: of episodes.
        """
        return episode_seeds(seed, count)

    def check_policy_of(self, trained: Self) -> None:
        """Refuse a policy that was trained on other observations than these.

        Raises:
            ValueError: names the setting.
        """

    def driver(self, name: str, seed: int = 0) -> TensorDictModuleBase:
        """A scripted driver by its name; ``seed`` is for those who draw.

        Raises:
            ValueError: there is none of this name.
        """
        if name not in self.drivers:
            choices = ", ".join(self.drivers) or f"none: task={self.task} has no drivers"
            raise ValueError(f"policy must be among {choices}, got {name!r}.")
        return self.drivers[name](seed)

    def outcomes(self, last: TensorDictBase) -> Mapping[str, Tensor]:
        """How episodes ended, from what their last steps left, [n, ...]: 0 or 1 by name, float [n]."""
        return {}

    def figures(self, steps: Sequence[TensorDictBase], counts: Sequence[int]) -> list[dict]:
        """Columns of a test's rows, one dict for each of B episodes, beside those that every task has.

        Args:
            steps: transitions of every decision, each [B].
            counts: how many of them belong to each episode.
        """
        return [{} for _ in counts]

    def describe(self) -> dict[str, Any]:
        """What the file of a test says of its task."""
        return dataclasses.asdict(self)  # pyright: ignore[reportArgumentType]

    def draw(
        self,
        policy: TensorDictModuleBase,
        env: EnvBase,
        rows: Sequence[dict],
        out: Path,
        name: str = "",
        form: str = "gif",
    ) -> Iterator[Path]:
        """Play episodes of a test again, side by side, and draw them.

        Args:
            policy, env: as the test played it, but as many environments as episodes.
            rows: of the episodes, with their ``episode`` number and ``seed``.
            out: folder of the pictures.
            name: what to call the policy.
            form: ``gif`` or ``mp4`` for an animation beside each figure, ``png`` for the figure alone.

        Yields:
            The path of each figure, once it is there.
        """
        raise NotImplementedError
