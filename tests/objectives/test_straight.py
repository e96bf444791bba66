"""The straight PyTorch SAC-Lag that ours is timed against computes the same losses."""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor

from saferl.modules import (
    DualAscent,
    MLPPolicyEncoder,
    MLPValue,
    tanh_gaussian_actor,
    value_operator,
)
from saferl.objectives import SACLagLoss

ROWS, WIDTH, SIZE = 3, 16, 32


def scene(generator: torch.Generator) -> dict[str, torch.Tensor]:
    vehicles = torch.randn(SIZE, ROWS, 6, generator=generator) * 10
    vehicles[..., 0] = 1
    return {"ego": torch.randn(SIZE, 9, generator=generator), "vehicles": vehicles}


def test_the_baseline_has_our_losses(monkeypatch):
    """On the same weights and batch, with the mean action for every sample."""
    monkeypatch.setattr(sys, "path", [str(Path(__file__).parents[2] / "benchmarks"), *sys.path])
    from straight import StraightSACLag  # type: ignore

    zeros = lambda shape, dtype, device: torch.zeros(shape, dtype=dtype, device=device)  # noqa: E731
    monkeypatch.setattr("torch.distributions.normal._standard_normal", zeros)
    monkeypatch.setattr(torch, "randn_like", torch.zeros_like)
    torch.manual_seed(0)
    straight = StraightSACLag(width=WIDTH, rows=ROWS, tuned=True)
    extract = NormalParamExtractor()  # the baseline has CleanRL's form of the deviation

    def forward(observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean, deviation = extract(straight.actor.net(observation))
        return mean, deviation.log()

    straight.actor.forward = forward
    for target in straight.targets.parameters():
        target.data.add_(0.1)

    actor = tanh_gaussian_actor(MLPPolicyEncoder(rows=ROWS, width=WIDTH), WIDTH)
    names = ["state_action_value"] * 2 + ["state_action_cost_value"] * 2
    critics = [value_operator(MLPValue(rows=ROWS, width=WIDTH), out_key=key) for key in names]
    pairs = [(actor, straight.actor), *zip(critics, straight.critics, strict=True)]
    for ours, theirs in pairs:
        for mine, other in zip(ours.parameters(), theirs.parameters(), strict=True):
            mine.data.copy_(other.data)
    loss = SACLagLoss(
        actor, critics[:2], critics[2:], lagrange=DualAscent(init=1.0), cost_target="mean"
    )
    loss.make_value_estimator(gamma=straight.gamma)
    for name in ("target_qvalue_network_params", "target_cost_critic_params"):
        for key, leaf in getattr(loss, name).items(True, True):
            if "scale" not in key[-1]:  # the features' divisors are no weights
                leaf.data.add_(0.1)

    generator = torch.Generator().manual_seed(1)
    state, following = scene(generator), scene(generator)
    action = torch.rand(SIZE, 2, generator=generator) * 2 - 1
    reward, cost = (torch.rand(SIZE, 1, generator=generator) for _ in range(2))
    terminated = torch.rand(SIZE, 1, generator=generator) < 0.3
    end = {"reward": reward, "cost": cost, "done": terminated, "terminated": terminated}
    batch = TensorDict({**state, "action": action, "next": {**following, **end}}, [SIZE])
    flat = {**state, "action": action, "reward": reward, "cost": cost, "terminated": terminated}
    flat |= {f"next_{key}": value for key, value in following.items()}
    for group in straight.critic_optimizer.param_groups:
        group["lr"] = 0.0  # ours sees all losses at the same critics
    ours, theirs = loss(batch), straight.update(flat)
    names = ("loss_qvalue", "loss_cost", "loss_actor", "constraint_violation")
    torch.testing.assert_close(
        *([out[name] for name in names] for out in (ours, theirs)), rtol=1e-4, atol=1e-5
    )
    assert ours["constraint_violation"] > 0
