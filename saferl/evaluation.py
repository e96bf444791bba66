"""Play test episodes with a policy and measure them."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from saferl.envs.intersection.base import episode_seeds
from saferl.envs.intersection.geometry import ROUTES
from saferl.metrics import summarise


@torch.no_grad()
def play(policy: TensorDictModuleBase, env: EnvBase, seeds: torch.Tensor) -> list[TensorDictBase]:
    """One episode of each environment, to its own end.

    Args:
        policy: any module that reads the observation and writes ``action``; its mean action is used.
        env: an intersection with batch size [B], with or without transforms.
        seeds: int64 [B], the episodes to play.

    Returns:
        The transitions of every decision [T, B], and until when each episode lasted: ``alive``
        [T, B] is True up to and including its last decision.
    """
    steps = []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        tensordict = env.reset(TensorDict({"seed": seeds}, batch_size=env.batch_size))
        alive = torch.ones(env.batch_size, dtype=torch.bool, device=env.device)
        while alive.any():
            tensordict = env.step(policy(tensordict))
            steps.append(tensordict.clone().set("alive", alive))
            alive = alive & ~tensordict["next", "done"].squeeze(-1)
            tensordict = env.step_mdp(tensordict)
    return steps


def episode_rows(steps: list[TensorDictBase], seeds: torch.Tensor) -> list[dict]:
    """Figures of each episode of :func:`play`: one dict an episode, in the order of ``seeds``."""
    alive = torch.stack([step["alive"] for step in steps]).float()

    def over_time(key: str) -> torch.Tensor:
        return torch.stack([step["next", key].float().squeeze(-1) for step in steps])

    length = alive.sum(0)
    ego = torch.stack([step["next", "ego"] for step in steps])
    last = (length.long() - 1)[None]

    def at_end(key: str) -> torch.Tensor:
        return over_time(key).gather(0, last).squeeze(0)

    first = steps[0]
    zero = torch.zeros_like(alive)
    projected = "action_executed" in first["next"].keys()
    moved, shift = zero, zero
    if projected:
        moved = over_time("intervened")
        shift = torch.stack(
            [(step["next", "action_executed"] - step["action"]).norm(dim=-1) for step in steps]
        )
    collision, offroad, success = at_end("collision"), at_end("offroad"), at_end("success")
    columns = {
        "collision": ((collision + offroad) > 0).float(),
        "success": success,
        "frozen": ((collision + offroad + success) == 0).float(),
        "hit_vehicle": collision,
        "left_road": offroad,
        "return": (over_time("reward") * alive).sum(0),
        "speed": (torch.hypot(ego[..., 3], ego[..., 4]) * alive).sum(0) / length,
        "cost_return": (over_time("cost") * alive).sum(0),
        "intervention_rate": (moved * alive).sum(0) / length,
        "correction": (shift * alive).sum(0) / (moved * alive).sum(0).clamp_min(1.0),
        "min_distance": torch.where(alive > 0, ego[..., 7], torch.inf).amin(0),
        "decisions": length,
    }
    columns = {key: value.tolist() for key, value in columns.items()}
    routes = first["route"].squeeze(-1).tolist()
    return [
        {
            "seed": seed,
            "route": ROUTES[route],
            **{key: column[i] for key, column in columns.items()},
        }
        for i, (seed, route) in enumerate(zip(seeds.tolist(), routes, strict=True))
    ]


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
    with tqdm(total=episodes, desc="evaluate", unit="episode", disable=not progress) as bar:
        for chunk in seeds.split(width):
            rows += episode_rows(play(policy, env, chunk.to(env.device)), chunk)
            bar.update(min(episodes, len(rows)) - bar.n)
    return [{"episode": i, **row} for i, row in enumerate(rows[:episodes])]


def write(rows: list[dict], out: Path, **about: str | int | float) -> dict:
    """Write ``episodes.csv`` and ``metrics.json`` into a folder; returns the metrics."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / "episodes.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    figures = summarise(rows)
    (out / "metrics.json").write_text(json.dumps({**figures, **about}, indent=2) + "\n")
    return figures
