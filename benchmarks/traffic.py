"""Quality of the traffic: is it dangerous to the blind, passable for the careful, free of faults?

    python benchmarks/traffic.py [--episodes 100] [--tasks lt gs rt] [--frequency 5] [--json PATH]

For each task and driver, over the same scenes: collisions, success and time-outs of the ego, the
share of episodes in which surrounding vehicles overlap each other, and the share in which one still
stands before or in the box when the time is over although nothing but traffic rules holds it. The
drivers: ``blind`` follows its lane, ``cautious`` looks ahead, ``parked`` stands at its start.
Wanted: blind collisions >= 25%, cautious success >= 90%, parked collisions < 1%, overlaps < 1%,
stuck 0%.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from saferl.envs.intersection.base import Scenario
from saferl.envs.intersection.cost import CollisionCost
from saferl.envs.intersection.drivers import CautiousDriver, Driver
from saferl.envs.intersection.geometry import LENGTH
from saferl.envs.intersection.highway_torchrl import HighwayIntersection
from saferl.envs.intersection.network import rectangles_overlap

DRIVERS = {"blind": Driver(), "cautious": CautiousDriver(), "parked": None}


def overlapping(pose: np.ndarray) -> bool:
    hit = rectangles_overlap(pose[:, None], pose)
    return bool(hit.sum() > len(pose))


def stuck(env) -> bool:
    """Whether a vehicle that is not queueing behind the ego still stands short of the box's end."""
    road = env.road
    ego_lane = road.table.approach[env.ego.route_id]
    standing = (road.speed < 0.1) & (road.s < road.table.out[road.route] + LENGTH / 2)
    return bool((standing & (road.table.approach[road.route] != ego_lane)).any())


def play(task: str, driver: str, episodes: int, frequency: int, vehicles: int) -> dict[str, float]:
    cost = CollisionCost(steps=1)  # not looked at here
    scenario = Scenario(task=task, policy_frequency=frequency, vehicles=vehicles, cost=cost)
    env = HighwayIntersection(scenario, num_envs=episodes, seed=0)
    td = env.reset()
    if driver == "parked":
        for one in env.envs:
            one.ego.place(one.ego.state * torch.tensor([1, 1, 0, 0, 1, 0]))
    overlap = np.zeros(episodes, bool)
    for _ in range(scenario.horizon):
        if driver == "parked":
            td["action"] = torch.tensor([-1.0, 0.0]).repeat(episodes, 1)
        else:
            td = DRIVERS[driver](td)
        td = env.step(td)["next"]
        overlap |= [overlapping(one.road.pose) for one in env.envs]
        if td["done"].all():
            break
    return summary(td, env, overlap)


def summary(td: TensorDict, env: HighwayIntersection, overlap: np.ndarray) -> dict[str, float]:
    truncated = (td["truncated"] & ~td["terminated"]).squeeze(-1).numpy()
    held = np.array([stuck(one) for one in env.envs]) & truncated
    return {
        "collision": td["collision"].float().mean().item(),
        "offroad": td["offroad"].float().mean().item(),
        "success": td["success"].float().mean().item(),
        "timeout": float(truncated.mean()),
        "overlap": float(overlap.mean()),
        "stuck": float(held.mean()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--tasks", nargs="+", default=["lt", "gs", "rt"])
    parser.add_argument("--drivers", nargs="+", default=list(DRIVERS), choices=list(DRIVERS))
    parser.add_argument("--frequency", type=int, default=5, help="decisions per second")
    parser.add_argument("--vehicles", type=int, default=10)
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    torch.set_num_threads(1)
    results = {}
    for task in options.tasks:
        for driver in options.drivers:
            figures = play(task, driver, options.episodes, options.frequency, options.vehicles)
            results[f"{task}/{driver}"] = figures
            row = "  ".join(f"{name} {100 * value:5.1f}%" for name, value in figures.items())
            print(f"{task} {driver:8s}  {row}", flush=True)
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
