"""saferl's projector around a policy that Stable-Baselines3 trained.

    pip install stable-baselines3
    python examples/projector_around_sb3.py [--steps 20000] [--updates 2000] [--episodes 200]

PPO of Stable-Baselines3 learns to go straight on highway-env. Two cost critics then learn from its driving what its
actions will cost, and a SafetyProjector corrects those that they call too risky: the policy itself stays as it is.
Printed are the same test episodes without and with the projector.
"""

from __future__ import annotations

import argparse

import gymnasium
import torch
from stable_baselines3 import PPO
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv

import saferl.envs  # registers the environments  # noqa: F401
from saferl.envs.intersection import BatchedIntersection, Scenario
from saferl.envs.transforms import SafetyProjector
from saferl.evaluation.play import evaluate
from saferl.evaluation.statistics import summarise, table
from saferl.modules import CriticEnsemble, MLPValue, value_operator, zero_output

GAMMA, LIMIT = 0.99, 0.05

parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=20_000, help="of PPO's training")
parser.add_argument("--updates", type=int, default=2000, help="of the cost critics")
parser.add_argument("--episodes", type=int, default=200, help="of each test")
options = parser.parse_args()
torch.manual_seed(0)
torch.set_num_threads(1)

road = gymnasium.make("saferl/Intersection-GS-v0")
rollout = min(2048, options.steps)
theirs = PPO("MultiInputPolicy", road, n_steps=rollout, seed=0, device="cpu")
theirs.learn(options.steps)


def act(ego: torch.Tensor, vehicles: torch.Tensor) -> torch.Tensor:
    """The mean action of their policy, in the box."""
    seen = {"ego": ego, "vehicles": vehicles}
    return theirs.policy.get_distribution(seen).mode().clamp(-1, 1)


policy = TensorDictModule(act, in_keys=["ego", "vehicles"], out_keys=["action"])

# What the policy's driving costs: transitions of it, with noise so that other actions are seen too.
scenario = Scenario(task="gs")
with torch.no_grad():
    data = BatchedIntersection(scenario, num_envs=128).rollout(
        60,
        lambda td: policy(td).set(
            "action", (td["action"] + 0.3 * torch.randn(128, 2)).clamp(-1, 1)
        ),
        break_when_any_done=False,
    )
    data = data.reshape(-1)
    data["next"] = policy(data["next"])

critics = [
    value_operator(
        zero_output(MLPValue(width=128, **scenario.form.scales)), out_key="state_action_cost_value"
    )
    for _ in range(2)
]
risk = CriticEnsemble(critics, reduce="max")
target = risk.params.clone()
optimizer = torch.optim.Adam(risk.params.values(True, True), lr=1e-3)
for _ in range(options.updates):
    batch = data[torch.randint(len(data), (256,))]
    with torch.no_grad():
        ahead = CriticEnsemble(critics[0], params=target, reduce="mean")(
            batch["next"].select("ego", "vehicles", "action")
        )["state_action_cost_value"]
        aim = batch["next", "cost"] + GAMMA * ~batch["next", "terminated"] * ahead
    loss = (risk.values(batch) - aim).square().sum(0).mean()
    loss.backward()
    optimizer.step()
    optimizer.zero_grad()
    target.data.lerp_(risk.params.data, 0.005)

for name, transforms in (("alone", []), ("with the projector", [SafetyProjector(risk, LIMIT)])):
    env = BatchedIntersection(scenario.as_test(), num_envs=min(100, options.episodes))
    env = TransformedEnv(env, *transforms) if transforms else env
    rows = evaluate(policy, env, options.episodes, seed=0, progress=False)
    print(table(summarise(rows), f"\nPPO of Stable-Baselines3, {name}"))
