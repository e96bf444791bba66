"""Quality of the traffic: is it dangerous to the blind, passable for the careful, free of faults?

    python benchmarks/traffic.py [--env batched] [--episodes 1000] [--tasks lt gs rt] [--frequency 5]
        [--scenario nominal] [--json PATH]

For each task and driver, over the same scenes: collisions, success and time-outs of the ego, the
share of episodes in which surrounding vehicles overlap each other, and the share in which one still
stands before or in the box when the time is over although nothing but traffic rules holds it. The
drivers: ``blind`` follows its lane, ``cautious`` looks ahead, ``parked`` stands at its start.
Wanted: blind collisions >= 25%, cautious success >= 90%, parked collisions < 1%, overlaps < 1%,
stuck < 1%. Vehicles leave the road 100 m behind the box and nowhere else. On SUMO every episode is a process.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from saferl.envs.intersection import (
    SCENARIOS,
    BatchedIntersection,
    HighwayIntersection,
    IntersectionBase,
    Scenario,
    SumoIntersection,
)
from saferl.envs.intersection.batched import TensorIntersection
from saferl.envs.intersection.collision_cost import CollisionCost
from saferl.envs.intersection.drivers import CautiousDriver, Driver
from saferl.envs.intersection.geometry import LENGTH, separation
from saferl.envs.intersection.roads import lane_frames, lanes
from saferl.envs.intersection.sumo_net import MANNERS
from saferl.envs.intersection.traffic import Vehicles

ENVS = {"batched": BatchedIntersection, "highway": HighwayIntersection}
ENVS |= {f"sumo-{name}": partial(SumoIntersection, drivers=name) for name in MANNERS}
DRIVERS = {"blind": Driver(), "cautious": CautiousDriver(), "parked": None}


def overlapping(vehicles: Vehicles) -> np.ndarray:
    """Whether two of the surrounding vehicles [N, episodes] overlap, [episodes]."""
    place, _ = lane_frames(lanes(vehicles.route, vehicles.s), vehicles.s)
    hit = separation(place.at((slice(None), None)), place) <= 0
    hit &= vehicles.present[:, None] & vehicles.present
    return (hit.sum((0, 1)) > vehicles.present.sum(0)).numpy()


def stuck(vehicles: Vehicles, ego_route: torch.Tensor) -> np.ndarray:
    """Whether one that is not queueing behind the ego [episodes] stands short of the box's end."""
    lane, own = lanes(vehicles.route, vehicles.s), lanes(ego_route, vehicles.s)
    standing = vehicles.present & (vehicles.speed < 0.1)
    standing &= vehicles.s < lane.out + LENGTH / 2
    return (standing & (lane.approach != own.approach)).any(0).numpy()


def park(env: IntersectionBase) -> None:
    if isinstance(env, TensorIntersection):
        env._state["ego"][:, 2] = 0.0
        return
    for one in env.envs:
        one.ego.place(one.ego.state * torch.tensor([1, 1, 0, 0, 1, 0]))


def play(
    kind: Callable[..., IntersectionBase], scenario: Scenario, driver: str, episodes: int
) -> dict[str, float]:
    env = kind(scenario, num_envs=episodes, seed=0)
    td = env.reset()
    if driver == "parked":
        park(env)
    overlap, held = np.zeros(episodes, bool), np.zeros(episodes, bool)
    done, last = torch.zeros(episodes, 1, dtype=torch.bool), None
    for _ in range(scenario.horizon):
        if driver == "parked":
            td["action"] = torch.tensor([-1.0, 0.0]).repeat(episodes, 1)
        else:
            td = DRIVERS[driver](td)
        td = env.step(td)["next"]
        (_, now), alive = env.scene(), ~done.squeeze(-1).numpy()
        overlap |= overlapping(now) & alive
        held = np.where(alive, stuck(now, td["route"].squeeze(-1)), held)
        # What an episode ended with; a batched one is driven on, and ignored.
        last = td.clone() if last is None else torch.where(done, last, td)
        done = done | td["done"]
        if done.all():
            break
    env.close()
    return summary(last, overlap, held)


def summary(td: TensorDict, overlap: np.ndarray, held: np.ndarray) -> dict[str, float]:
    truncated = (td["truncated"] & ~td["terminated"]).squeeze(-1).numpy()
    return {
        "collision": td["collision"].float().mean().item(),
        "offroad": td["offroad"].float().mean().item(),
        "success": td["success"].float().mean().item(),
        "timeout": float(truncated.mean()),
        "overlap": float(overlap.mean()),
        "stuck": float((held & truncated).mean()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", choices=list(ENVS), default="batched")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--tasks", nargs="+", default=["lt", "gs", "rt"])
    parser.add_argument("--drivers", nargs="+", default=list(DRIVERS), choices=list(DRIVERS))
    parser.add_argument("--frequency", type=int, default=5, help="decisions per second")
    parser.add_argument("--scenario", choices=list(SCENARIOS), default="nominal")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    torch.set_num_threads(1)
    results = {}
    for task in options.tasks:
        for driver in options.drivers:
            scenario = Scenario(
                task=task, scenario=options.scenario, policy_frequency=options.frequency,
                cost=CollisionCost(steps=1),  # not looked at here
            )  # fmt: skip
            figures = play(ENVS[options.env], scenario, driver, options.episodes)
            results[f"{task}/{driver}"] = figures
            row = "  ".join(f"{name} {100 * value:5.1f}%" for name, value in figures.items())
            print(f"{task} {driver:8s}  {row}", flush=True)
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
