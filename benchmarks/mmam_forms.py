"""Which form of MMAM's policy learns better where the paper leaves it open: where the second hop looks.

    python benchmarks/mmam_forms.py [--seeds 0 1 2] [--updates 6000] [--width 64] [--json PATH]

Scripted drivers, half of them cautious and half blind, drive all three tasks with noise on their
actions; every form learns what the cautious driver would do from the same transitions in the same order, and is
judged by its mean squared error on actions in [-1, 1] on environments that it has not seen.

Prints the errors of each seed, and the mean difference between the forms with Student's 95% interval.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from side_by_side import write
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from saferl.envs.intersection import BatchedIntersection, Scenario
from saferl.envs.intersection.drivers import CautiousDriver, Driver
from saferl.evaluation.statistics import mean_interval, span
from saferl.modules import MMAMPolicyEncoder

ENVS, DECISIONS, NOISE, BATCH = 256, 400, 0.2, 256
FORMS = ("attended", "embedded")
RATES = (1e-3, 1e-4)  # first and last


@torch.no_grad()
def drive(seed: int) -> TensorDict:
    """What was seen [B, T], with ``expert`` [*, 2], what the cautious driver would have done."""
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
    return data.select("ego", "vehicles", "expert")


class Policy(nn.Module):
    def __init__(self, width: int, keys: str):
        super().__init__()
        self.encoder, self.head = MMAMPolicyEncoder(width, keys=keys), nn.Linear(width, 2)

    def forward(self, td: TensorDict) -> Tensor:
        return self.head(self.encoder(td["ego"], td["vehicles"])).tanh()


def error(keys: str, train: TensorDict, test: TensorDict, options, seed: int) -> float:
    """Mean squared error on ``test`` of a network trained on ``train``."""
    torch.manual_seed(seed)
    network = Policy(options.width, keys)
    optimizer = torch.optim.Adam(network.parameters(), RATES[0], fused=True)
    schedule = torch.optim.lr_scheduler.LinearLR(
        optimizer, 1.0, RATES[1] / RATES[0], options.updates
    )
    order = torch.Generator().manual_seed(seed)
    for _ in range(options.updates):
        batch = train[torch.randint(len(train), (BATCH,), generator=order)]
        F.mse_loss(network(batch), batch["expert"]).backward()
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
    with torch.no_grad():
        sums = [F.mse_loss(network(p), p["expert"], reduction="sum") for p in test.split(4096)]
    return sum(each.item() for each in sums) / test["expert"].numel()


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

    errors: dict[str, list[float]] = {keys: [] for keys in FORMS}
    for seed in options.seeds:
        data, held_out = drive(seed), ENVS // 5
        parts = data[held_out:].reshape(-1), data[:held_out].reshape(-1)
        for keys in FORMS:
            errors[keys].append(error(keys, *parts, options, seed))
        print(f"seed {seed}: {len(parts[0])} states, {len(parts[1])} held out", flush=True)

    for keys, values in errors.items():
        print(f"keys={keys:10s} {' '.join(f'{value:.4f}' for value in values)}")
    ratios = [b / a - 1 for a, b in zip(*errors.values(), strict=True)]
    interval = span(*mean_interval(ratios), "+.1%")
    print(f"{FORMS[1]} over {FORMS[0]}: {sum(ratios) / len(ratios):+.1%} {interval}")
    write(options.json, errors)


if __name__ == "__main__":
    main()
