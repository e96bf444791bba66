"""A constrained loss in a plain TorchRL loop: a cart under a budget of effort.

    python examples/cost_loss.py [--updates 6000]

Everything but SACLagLoss, its cost critic and its multiplier is TorchRL's. The return and the cost of the mean
policy are printed beside those of the best policy, which this problem lets us compute.
"""

from __future__ import annotations

import argparse

import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SoftUpdate

from saferl.envs import Cart, CartEnv
from saferl.modules import (
    DualAscent,
    MLPPolicyEncoder,
    MLPValue,
    tanh_gaussian_actor,
    value_operator,
)
from saferl.objectives import SACLagLoss

LIMIT, GAMMA, WIDTH = 0.2, 0.9, 32

parser = argparse.ArgumentParser()
parser.add_argument("--updates", type=int, default=6000)
updates = parser.parse_args().updates
torch.manual_seed(0)
torch.set_num_threads(1)


def critic(key: str):
    network = MLPValue(size=2, width=WIDTH, depth=2, action_dim=1)
    return value_operator(network, in_keys=["observation", "action"], out_key=key)


actor = tanh_gaussian_actor(MLPPolicyEncoder(size=2, width=WIDTH), WIDTH, 1, ["observation"])
loss = SACLagLoss(
    actor,
    critic("state_action_value"),
    critic("state_action_cost_value"),
    lagrange=DualAscent(init=0.0, lr=0.02, signed=True),
    cost_target="mean",
    alpha_init=0.02,
    target_entropy=-3.0,
)
loss.make_value_estimator(gamma=GAMMA)
targets = SoftUpdate(loss, tau=0.01)
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
env = TransformedEnv(CartEnv(Cart(), num_envs=64), RewardSum(["cost"], ["episode_cost"]))
collector = Collector(env, actor, frames_per_batch=64, total_frames=-1, init_random_frames=2048)
buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100_000), batch_size=256)

for number, data in enumerate(collector):
    buffer.extend(data.reshape(-1))
    if number < 32:
        continue
    output = loss(buffer.sample())
    sum(value for key, value in output.items() if key.startswith("loss_")).backward()
    optimizer.step()
    optimizer.zero_grad()
    targets.step()
    ended = data["next"][data["next", "done"].squeeze(-1)]  # fresh episodes, each used once
    loss.lagrange.update(loss.lagrange.penalty(ended["episode_cost"] - LIMIT))
    if number == 31 + updates:
        break

with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
    test = CartEnv(Cart(), num_envs=2000, seed=1).rollout(20, actor)
reward, cost = (float(test["next", key].sum(1).mean()) for key in ("reward", "cost"))
best = Cart().sums(Cart().optimum(LIMIT, GAMMA, 1.0, 20), 1.0, 20)
print(f"return {reward:.3f} (best {best[0]:.3f}), cost {cost:.3f} (limit {LIMIT})")
