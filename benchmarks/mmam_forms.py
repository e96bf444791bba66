"""Which form of MMAM learns better where the paper leaves it open.

    python benchmarks/mmam_forms.py [--seeds 0 1 2] [--updates 6000] [--width 64] [--json PATH]

Scripted drivers, half of them cautious and half blind, drive all three tasks with noise on their
actions; every form learns from the same transitions in the same order, and is judged on environments
that it has not seen:

- the policy's encoder (``keys``): what would the cautious driver do here? Mean squared error on
  actions in [-1, 1].
- the value (``branch``): which reward, and which cost, followed? Mean squared errors of the two discounted
  sums, in variances of what followed.

Prints the errors of each seed, and the mean difference between forms with Student's 95% interval.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from cost_critics import followed
from side_by_side import write
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from saferl.envs.intersection import BatchedIntersection, Scenario
from saferl.envs.intersection.drivers import CautiousDriver, Driver
from saferl.metrics import mean_interval
from saferl.modules import MMAMPolicyEncoder, MMAMValue

ENVS, DECISIONS, NOISE, GAMMA, BATCH = 256, 400, 0.2, 0.99, 256
RATES = (1e-3, 1e-4)  # first and last


@torch.no_grad()
def drive(seed: int) -> TensorDict:
    """Transitions [B, T] with ``expert`` [*, 2] and ``sums`` [*, 2], and whether the sums are ``seen``."""
    env = BatchedIntersection(Scenario(task="mixed", observation="world"), ENVS, seed=seed)
    cautious, blind = CautiousDriver(), Driver()
    generator = torch.Generator().manual_seed(seed)
    is_blind = (torch.arange(ENVS) % 2 == 1).unsqueeze(-1)

    def policy(td):
        expert = cautious(td)["action"].clone()
        action = torch.where(is_blind, blind(td)["action"], expert)
        action = action + NOISE * torch.randn(action.shape, generator=generator)
        return td.set("expert", expert).set("action", action.clamp(-1, 1))

    data = env.rollout(DECISIONS, policy, break_when_any_done=False)
    rewards = data.clone(False).set(("next", "cost"), data["next", "reward"])
    (rewards, seen), (costs, _) = followed(rewards, GAMMA), followed(data, GAMMA)
    data = data.select("ego", "vehicles", "action", "expert")
    return data.set("sums", torch.stack([rewards, costs], -1)).set("seen", seen)


class Policy(nn.Module):
    def __init__(self, width: int, keys: str):
        super().__init__()
        self.encoder, self.head = MMAMPolicyEncoder(width, keys=keys), nn.Linear(width, 2)

    def forward(self, td: TensorDict) -> Tensor:
        return self.head(self.encoder(td["ego"], td["vehicles"])).tanh()


class Value(nn.Module):
    def __init__(self, width: int, branch: str):
        super().__init__()
        self.value = MMAMValue(width, branch=branch)

    def forward(self, td: TensorDict) -> Tensor:
        return self.value(td["ego"], td["vehicles"], td["action"])


def error(
    build: Callable[[], nn.Module],
    train: TensorDict,
    test: TensorDict,
    label: str,
    options,
    seed: int,
) -> float:
    """Mean squared error on ``test`` of a network trained on ``train``."""
    torch.manual_seed(seed)
    network = build()
    optimizer = torch.optim.Adam(network.parameters(), RATES[0], fused=True)
    schedule = torch.optim.lr_scheduler.LinearLR(
        optimizer, 1.0, RATES[1] / RATES[0], options.updates
    )
    order = torch.Generator().manual_seed(seed)
    for _ in range(options.updates):
        batch = train[torch.randint(len(train), (BATCH,), generator=order)]
        F.mse_loss(network(batch), batch[label]).backward()
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
    with torch.no_grad():
        return (
            sum(
                F.mse_loss(network(part), part[label], reduction="sum").item()
                for part in test.split(4096)
            )
            / test[label].numel()
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--updates", type=int, default=6000)
    parser.add_argument("--width", type=int, default=64)
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    torch.set_num_threads(1)

    trials = {
        "cautious driver's action": ("keys", ("attended", "embedded"), "expert"),
        "reward that follows": ("branch", ("vehicle", "scene"), "reward"),
        "cost that follows": ("branch", ("vehicle", "scene"), "cost"),
    }
    errors: dict[str, dict[str, list[float]]] = {
        name: {form: [] for form in forms} for name, (_, forms, _) in trials.items()
    }
    for seed in options.seeds:
        data = drive(seed)
        for number, name in enumerate(("reward", "cost")):
            sums = data["sums"][..., number : number + 1]
            known = sums[data["seen"]]
            data[name] = (sums - known.mean()) / known.std()
        held_out = ENVS // 5
        parts = data[held_out:][data["seen"][held_out:]], data[:held_out][data["seen"][:held_out]]
        for name, (_, forms, label) in trials.items():
            network = Policy if label == "expert" else Value
            for form in forms:
                build = partial(network, options.width, form)
                errors[name][form].append(error(build, *parts, label, options, seed))
        print(f"seed {seed}: {len(parts[0])} transitions, {len(parts[1])} held out", flush=True)

    for name, (key, forms, _) in trials.items():
        for form in forms:
            values = " ".join(f"{value:.4f}" for value in errors[name][form])
            print(f"{name:26s} {key}={form:10s} {values}")
        first, second = (errors[name][form] for form in forms)
        ratios = [b / a - 1 for a, b in zip(first, second, strict=True)]
        low, high = mean_interval(ratios)
        print(
            f"{'':26s} {forms[1]} over {forms[0]}: {sum(ratios) / len(ratios):+.1%} "
            f"[{low:+.1%}, {high:+.1%}]"
        )
    write(options.json, errors)


if __name__ == "__main__":
    main()
