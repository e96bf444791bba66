"""Play test episodes with a policy and measure them."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from saferl.envs.intersection import Scenario
from saferl.envs.intersection.geometry import ROUTES
from saferl.envs.intersection.observation import reading
from saferl.envs.seeding import episode_seeds
from saferl.metrics import summarise

#: What a test changes in the task that a policy was trained on: every start before the box, parked
#: cars left to themselves, and the reward without r_safe, which is the same for every algorithm.
TEST: dict[str, Any] = {
    "route_starts": 0.0,
    "standstill": None,
    "reward": {"risk_shaping": False},
}


def as_test(scenario: Any, policy_frequency: int = 10) -> Any:
    """The conditions of a test: :data:`TEST`, and another rate of decisions; a task that is no
    :class:`Scenario` as it is.

    >>> as_test(Scenario(route_starts=0.5)).route_starts
    0.0
    """
    if not isinstance(scenario, Scenario):
        return scenario
    reward = dataclasses.replace(scenario.reward, **TEST["reward"])
    changes = TEST | {"policy_frequency": policy_frequency, "reward": reward}
    return dataclasses.replace(scenario, **changes)


def start(env: EnvBase, seeds: Tensor) -> TensorDictBase:
    """Reset an environment, with or without transforms, to the episodes of these seeds.

    TorchRL's ``TransformedEnv.reset`` keeps every key but the environment's state from it, so a
    ``seed`` must reach the environment itself.

    Args:
        env: batch size [B].
        seeds: int64 [B].
    """
    request = TensorDict({"seed": seeds}, batch_size=env.batch_size)
    if not isinstance(env, TransformedEnv):
        return env.reset(request)
    return env.transform._reset(request.empty(), env.base_env.reset(request))


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
        env: a :class:`SeededEnv` with batch size [B], with or without transforms.
        seeds: int64 [B], the episodes to play.
        ended: told after each decision how many episodes ended with it.

    Returns:
        The transitions of every decision, each [B]; ``alive`` [B] (bool) is True up to and including
        the last decision of an episode.
    """
    steps = []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        tensordict = start(env, seeds)
        alive = torch.ones(env.batch_size, dtype=torch.bool, device=env.device)
        while alive.any():
            tensordict = env.step(policy(tensordict))
            steps.append(tensordict.clone().set("alive", alive))
            done = tensordict["next", "done"].squeeze(-1)
            ended(int((alive & done).sum()))
            alive = alive & ~done
            tensordict = env.step_mdp(tensordict)
    return steps


def episode_rows(steps: list[TensorDictBase], seeds: Tensor) -> list[dict]:
    """Figures of each episode of :func:`play`: one dict an episode, in the order of ``seeds``.

    ``collision`` counts leaving the road too; ``hit_vehicle`` and ``left_road`` tell them apart.
    ``speed`` (m/s), ``min_distance`` (m, to another vehicle) and ``cost_return`` are over the whole
    episode, ``intervention_rate`` is the share of decisions that a projector changed, and
    ``correction`` the mean size of such a change.
    """

    after = steps[0]["next"]

    def over_time(key: str, dtype: torch.dtype = torch.float64) -> Tensor:
        return torch.stack([step["next", key].to(dtype).squeeze(-1) for step in steps]).cpu()

    alive = torch.stack([step["alive"] for step in steps]).cpu()
    values = {"return": over_time("reward"), "cost_return": over_time("cost")}
    shift = torch.zeros_like(values["cost_return"])
    if "action_executed" in after:
        shift = torch.stack(
            [
                torch.linalg.vector_norm(step["next", "action_executed"] - step["action"], dim=-1)
                for step in steps
            ]
        ).cpu()
    # A projector of one's own need not say where it intervened.
    moved = over_time("intervened") if "intervened" in after else (shift > 0).to(shift)
    values |= {"intervention_rate": moved, "correction": shift}
    if "ego" in after:
        ego = over_time("ego")
        values["speed"] = torch.hypot(reading(ego, "v_x"), reading(ego, "v_y"))
        ends = {key: over_time(key, torch.bool) for key in ("collision", "offroad", "success")}
        routes = steps[0].get("route").flatten().tolist()
    rows = []
    for index, (seed, count) in enumerate(zip(seeds.tolist(), alive.sum(0).tolist(), strict=True)):
        # Exact sums: they do not depend on how long the episodes beside this one lasted.
        total = {key: math.fsum(value[:count, index].tolist()) for key, value in values.items()}
        row = {"seed": seed}
        if "ego" in after:
            hit, left, success = (bool(end[count - 1, index]) for end in ends.values())
            row |= {
                "route": ROUTES[routes[index]],
                "collision": int(hit or left),
                "success": int(success),
                "frozen": int(not (hit or left or success)),
                "hit_vehicle": int(hit),
                "left_road": int(left),
                "speed": total["speed"] / count,
                "min_distance": reading(ego, "d_veh")[:count, index].min().item(),
            }
        row |= {
            "return": total["return"],
            "cost_return": total["cost_return"],
            "intervention_rate": total["intervention_rate"] / count,
            "correction": total["correction"] / max(total["intervention_rate"], 1.0),
            "decisions": count,
        }
        rows.append(row)
    return rows


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

    An episode is a function of its own seed, which follows from ``seed`` and its number, so that the
    number of environments changes nothing but the speed.

    Raises:
        ValueError: fewer than one episode.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be >= 1, got {episodes}.")
    width = env.batch_size[0]
    seeds = episode_seeds(seed, -(-episodes // width) * width)
    rows: list[dict] = []
    with tqdm(
        total=episodes,
        desc="test",
        unit="episode",
        dynamic_ncols=True,
        mininterval=1.0,
        disable=not progress,
    ) as bar:

        def ended(count: int) -> None:  # the last chunk may hold more episodes than are wanted
            bar.update(min(count, episodes - bar.n))

        for chunk in seeds.split(width):
            rows += episode_rows(play(policy, env, chunk.to(env.device), ended), chunk)
    return [{"episode": i, **row} for i, row in enumerate(rows[:episodes])]


def write(rows: list[dict], out: Path, /, **about: Any) -> dict:
    """Write ``episodes.csv`` and ``metrics.json`` into a folder; returns the metrics."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / "episodes.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    figures = summarise(rows)
    (out / "metrics.json").write_text(
        json.dumps({**figures, **about}, indent=2, allow_nan=False) + "\n"
    )
    return figures
