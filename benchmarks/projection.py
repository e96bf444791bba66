"""What a correction does to real transitions, for several lambda_a.

Takes the replay buffer and the cost critics of a trained run, and projects the policy's own proposals
in the states where they are risky (Q_c > risk_limit). For each lambda_a, printed over these states: how
often the limit is reached, how far the action moves, Q_c, and what the physics says that the critics do
not know: the cost of Algorithm 2 (rebuilt from the observation), and whether the ego, holding the action
for one second, leaves the road.

    python benchmarks/projection.py RUN --penalties 0.1 1 10 100 --json out.json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type

from saferl.algorithms.assemble import load_agent
from saferl.checkpoint.run import latest, run_config
from saferl.checkpoint.sealed import sealed
from saferl.checkpoint.state import BufferState
from saferl.envs.intersection import CollisionCost
from saferl.envs.intersection.dynamics import step_ego, to_physical
from saferl.envs.intersection.geometry import offroad
from saferl.envs.intersection.observation import as_world
from saferl.modules import project


def physics(ego: torch.Tensor, vehicles: torch.Tensor, action: torch.Tensor) -> tuple[float, float]:
    """Mean Algorithm 2 cost, and share that leaves the road within 1 s under a held action."""
    ego, vehicles = as_world(ego, vehicles)
    state, control = ego[:, 1:7], to_physical(action)
    cos, sin = torch.cos(state[:, 4]), torch.sin(state[:, 4])
    own = torch.stack(
        [state[:, 2] * cos - state[:, 3] * sin, state[:, 2] * sin + state[:, 3] * cos], -1
    )
    velocity = vehicles[..., 3:5] + own[:, None]
    phi = vehicles[..., 5]
    speed = velocity[..., 0] * torch.cos(phi) + velocity[..., 1] * torch.sin(phi)
    zero = torch.zeros_like(speed)
    position = vehicles[..., 1:3] + state[:, None, :2]
    others = torch.stack([position[..., 0], position[..., 1], speed, zero, phi, zero], -1)
    cost = CollisionCost()(state, control, others, vehicles[..., 0] > 0.5)
    left = torch.zeros(len(state), dtype=torch.bool)
    for _ in range(15):
        state = step_ego(state, control, 1 / 15)
        left |= offroad(state)
    return cost.mean().item(), left.float().mean().item()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--penalties", type=float, nargs="+", default=[0.1, 1.0, 10.0, 100.0])
    parser.add_argument("--samples", type=int, default=20_000)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    cfg = run_config(args.run)
    cfg.device = "cpu"
    agent = load_agent(cfg, args.run, "run")
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(cfg.learning.buffer_size))
    sealed(buffer=BufferState(buffer)).load(latest(args.run))
    index = torch.randperm(len(buffer))[: args.samples]
    data = buffer[index].select("ego", "vehicles")
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        data = agent.actor(data)
        risk = agent.loss.cost_value(data.copy())["state_action_cost_value"].squeeze(-1)
    risky = data[risk > cfg.risk_limit]
    print(
        f"{len(risky)} of {len(data)} states are risky (Q_c > {cfg.risk_limit}) under the mean action."
    )
    if not len(risky):
        return
    scene = TensorDict({key: risky[key] for key in ("ego", "vehicles", "action")}, risky.batch_size)
    cost, left = physics(scene["ego"], scene["vehicles"], scene["action"])
    rows = {"none": {"feasible": 0.0, "moved": 0.0, "acceleration": 0.0, "steering": 0.0,
                     "risk": risk[risk > cfg.risk_limit].mean().item(), "cost": cost, "leaves_road": left}}  # fmt: skip
    bound = agent.loss.cost_value.bind(scene)
    for penalty in args.penalties:
        result = project(bound, scene["action"], cfg.risk_limit, penalty=penalty)
        shift = (result.action - scene["action"]).detach()
        cost, left = physics(scene["ego"], scene["vehicles"], result.action)
        rows[f"{penalty:g}"] = {
            "feasible": result.feasible.float().mean().item(),
            "moved": shift.norm(dim=-1).mean().item(),
            "acceleration": shift[:, 0].mean().item(),
            "steering": shift[:, 1].abs().mean().item(),
            "risk": result.risk_after.mean().item(),
            "cost": cost,
            "leaves_road": left,
        }
    names = list(next(iter(rows.values())))
    print(f"{'lambda_a':<10}" + "".join(f"{name:>14}" for name in names))
    for key, row in rows.items():
        print(f"{key:<10}" + "".join(f"{row[name]:>14.4f}" for name in names))
    if args.json:
        args.json.write_text(json.dumps({"states": len(risky), "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
