"""Folders of runs whose every episode is known."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf
from small import compose

from saferl.envs.intersection.geometry import ROUTES

EPISODES = 8  # two of each route


def make(
    run: Path,
    algo: str = "arsac",
    seed: int = 0,
    collisions: Sequence[int] = (),
    speed: float = 8.0,
    options: Sequence[str] = (),
) -> Path:
    """A finished run of :data:`EPISODES` episodes, routes in turns, of which those numbered in ``collisions`` crash and the others
    arrive; a return is 100 or -100; the curve falls from 1 to 0 in three records."""
    cfg = compose(
        "task=mixed", f"algo={algo}", f"seed={seed}", f"evaluation.episodes={EPISODES}", "frames=30000", *options
    )  # fmt: skip
    OmegaConf.resolve(cfg)
    (run / "evaluation").mkdir(parents=True)
    OmegaConf.save(cfg, run / "config.yaml")
    rows = [
        {
            "episode": number,
            "route": ROUTES[number % 4],
            "collision": int(number in collisions),
            "success": int(number not in collisions),
            "frozen": 0,
            "speed": speed,
            "return": -100.0 if number in collisions else 100.0,
        }
        for number in range(EPISODES)
    ]
    table(run / "evaluation/episodes.csv", rows)
    (run / "evaluation/metrics.json").write_text(json.dumps({"episodes": EPISODES}))
    frames = (10000, 20000, 30000)
    keys = ("collision_rate", "frozen_rate", "success_rate", "return", "cost_return")
    curve = zip(frames, (1.0, 0.5, 0.0), strict=True)
    table(run / "metrics.csv", [{"frames": f, **dict.fromkeys(keys, value)} for f, value in curve])
    timing = {"updates": 900, "collect": 60.0, "learn": 120.0}
    table(run / "timing.csv", [{"frames": f, **timing} for f in frames])
    return run


def table(path: Path, rows: Sequence[dict]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def drawn(seeds: int, episodes: int, rng: np.random.Generator, between: float, mean: float):
    """Tests of a system whose seeds differ by ``between`` around ``mean`` and whose episodes by 1: one task, one figure."""
    return [[mean + between * rng.normal() + rng.normal(size=(episodes, 1))] for _ in range(seeds)]
