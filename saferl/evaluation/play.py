"""Play test episodes with a policy and measure them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from saferl.envs.task import Task
from saferl.envs.transforms import Shield
from saferl.evaluation.progress import bar
from saferl.evaluation.rows import episode_rows


@torch.no_grad()
def play(
    policy: TensorDictModuleBase,
    env: EnvBase,
    seeds: Tensor,
    ended: Callable[[int], object] = lambda count: None,
) -> list[TensorDictBase]:
    """One episode of each environment, to its own end.

    Args:
        policy: any module that reads the observation and writes ``action``; its mean action is used.
        env: a :class:`~saferl.envs.seeding.SeededEnv` with batch size [B], with or without transforms.
        seeds: int64 [B], the episodes to play.
        ended: told after each decision how many episodes ended with it.

    Returns:
        The transitions of every decision, each [B]; ``alive`` [B] (bool) is True up to and including
        the last decision of an episode.

    Raises:
        ValueError: an action is not finite.
    """
    steps = []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        tensordict = env.reset(seeds=seeds)
        alive = torch.ones(env.batch_size, dtype=torch.bool, device=env.device)
        while alive.any():
            tensordict = policy(tensordict)
            if not tensordict["action"].isfinite().all():
                raise ValueError("the policy gave an action that is not finite.")
            tensordict = env.step(tensordict)
            steps.append(tensordict.clone().set("alive", alive))
            done = tensordict["next", "done"].squeeze(-1)
            ended(int((alive & done).sum()))
            alive = alive & ~done
            tensordict = env.step_mdp(tensordict)
    return steps


def envs_at_once(episodes: int, most: int) -> int:
    """The fewest environments that play so many episodes in no more rounds than ``most`` would.

    >>> envs_at_once(101, most=100), envs_at_once(500, most=100), envs_at_once(3, most=100)
    (51, 100, 3)
    """
    rounds = math.ceil(episodes / most)
    return math.ceil(episodes / rounds)


def evaluate(
    policy: TensorDictModuleBase, env: EnvBase, episodes: int, seed: int, progress: bool = True
) -> list[dict]:
    """Play ``episodes`` episodes; returns one row of figures an episode.

    An episode is a function of its own seed, which follows from ``seed`` and its number (:meth:`Task.episodes`), so
    that the number of environments changes nothing but the speed.

    Raises:
        ValueError: fewer than one episode, or more than there are scenarios: the rest would be the first again.
    """
    width, task = env.batch_size[0], cast(Task, env.task)
    task.check_episodes("episodes", episodes)
    seeds = task.episodes(seed, -(-episodes // width) * width)
    fallbacks = next((part.names for part in env.modules() if isinstance(part, Shield)), ())
    rows: list[dict] = []
    with bar(total=episodes, desc="test", unit="episode", disable=not progress) as shown:

        def ended(count: int) -> None:  # the last chunk may hold more episodes than are wanted
            shown.update(min(count, episodes - shown.n))

        for chunk in seeds.split(width):
            steps = play(policy, env, chunk.to(env.device), ended)
            rows += episode_rows(steps, chunk, task, fallbacks)
    return [{"episode": i, **row} for i, row in enumerate(rows[:episodes])]
