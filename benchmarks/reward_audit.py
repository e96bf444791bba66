"""Reward audit: what each way of driving earns, before anything learns.

Scripted drivers on an empty road; returns discounted at 0.99 over 125 decisions, those that are still
on the road at the end bootstrapped as if their last reward went on for ever. A reward that can be
learned safely orders them: crossing > waiting, then crossing > parking > crashing.

    python benchmarks/reward_audit.py
"""

from __future__ import annotations

import argparse

import torch
from tensordict import TensorDictBase

from saferl.envs.intersection import BatchedIntersection, Reward, Scenario
from saferl.envs.intersection.drivers import Driver
from saferl.envs.intersection.geometry import project, reference_lines

GAMMA = 0.99
TASKS = ("lt", "gs", "rt")


class StopsAt(Driver):
    """Follows the lane, stops at arc length ``stop`` of it, and goes on after ``wait`` decisions."""

    def __init__(self, stop: float, wait: float = float("inf")):
        super().__init__()
        self.stop, self.wait, self.steps = stop, wait, 0

    def target_speed(self, ego, vehicles, line, s):
        self.steps += 1
        room = (self.stop - s).clamp_min(0.0)
        free = super().target_speed(ego, vehicles, line, s)
        if self.steps > self.wait:
            return free
        return torch.minimum(free, torch.sqrt(2 * 2.5 * room))


class LeavesRoad(Driver):
    """Follows the lane up to arc length ``start``, then steers off the pavement."""

    def __init__(self, start: float):
        super().__init__()
        self.start = start

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = super().forward(tensordict)
        ego, route = tensordict["ego"], tensordict["route"].squeeze(-1)
        _, s, _ = project(ego[..., 1:3], reference_lines(route, ego)[..., 0, :, :])
        action = tensordict["action"].clone()
        action[..., 1] = torch.where(s > self.start, 0.3, action[..., 1])
        return tensordict.set("action", action)


class ParksAtStart(Driver):
    def target_speed(self, ego, vehicles, line, s):
        return torch.zeros_like(s)


def drivers() -> dict[str, Driver]:
    return {
        "cross at 9 m/s": Driver(),
        "cross at 5 m/s": Driver(5.0),
        "wait 8 s at the line, cross": StopsAt(96.0, wait=60),
        "park in the box": StopsAt(110.0),
        "park at the line": StopsAt(96.0),
        "park at the start": ParksAtStart(),
        "leave the road in the box": LeavesRoad(100.0),
        "leave the road at the start": LeavesRoad(0.0),
    }


def discounted(scenario: Scenario, driver: Driver, episodes: int) -> tuple[float, float]:
    """Mean discounted return, and the share of episodes that end before the limit."""
    env = BatchedIntersection(scenario, episodes, seed=1)
    data = env.rollout(scenario.horizon, driver, break_when_any_done=False, auto_reset=True)
    reward, done = data["next", "reward"].squeeze(-1), data["next", "terminated"].squeeze(-1)
    alive = torch.cat([torch.zeros_like(done[:, :1]), done[:, :-1]], 1).cumsum(1) == 0
    weights = GAMMA ** torch.arange(reward.shape[1]).to(reward)
    total = (reward * alive * weights).sum(1)
    ended = done.any(1)
    total += torch.where(ended, 0.0, GAMMA**scenario.horizon * reward[:, -1] / (1 - GAMMA))
    return total.mean().item(), ended.float().mean().item()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=64)
    parser.add_argument("--scale", type=float, nargs="+", default=[Reward.destination_scale])
    args = parser.parse_args()
    torch.set_num_threads(1)
    for scale in args.scale:
        for reading in ("normalised", "raw"):
            print(
                f"\n{reading}, destination_scale={scale:g}\n{'':<30}"
                + "".join(f"{t:>9}" for t in TASKS)
            )
            reward = Reward(reading=reading, destination_scale=scale)
            for name in drivers():
                values = [
                    discounted(
                        Scenario(task=task, vehicles=0, rows=1, reward=reward, observation="world"),
                        drivers()[name],
                        args.episodes,
                    )[0]
                    for task in TASKS
                ]
                print(f"{name:<30}" + "".join(f"{v:>9.1f}" for v in values))


if __name__ == "__main__":
    main()
