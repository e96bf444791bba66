"""Small on-policy losses and a batch for them."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torchrl.objectives import ValueEstimators

from saferl.modules import (
    DualAscent,
    ExactPenalty,
    MLPPolicyEncoder,
    StateValue,
    Switch,
    tanh_gaussian_actor,
    value_operator,
)
from saferl.objectives import CPOLoss, CRPOLoss, FOCOPSLoss, P3OLoss, PPOLagLoss

GAMMA, LAMBDA, SIZE = 0.9, 0.8, 3
LOSSES = {
    "ppo_lag": PPOLagLoss,
    "cpo": CPOLoss,
    "crpo": CRPOLoss,
    "focops": FOCOPSLoss,
    "p3o": P3OLoss,
}
MULTIPLIERS = {
    "ppo_lag": lambda: DualAscent(init=0.7),
    "crpo": Switch,
    "focops": lambda: DualAscent(init=0.7),
    "p3o": ExactPenalty,
}


def encoder() -> MLPPolicyEncoder:
    return MLPPolicyEncoder(size=SIZE, width=8, depth=1)


def value(key: str, features: MLPPolicyEncoder | None = None):
    network = StateValue(features or encoder(), 8)
    return value_operator(network, in_keys=["observation"], out_key=key)


def build(kind: str = "ppo_lag", seed: int = 0, shared: bool = False, **settings):
    """A loss, and its actor as a module that acts; their networks may share an encoder."""
    torch.manual_seed(seed)
    features = encoder()
    actor = tanh_gaussian_actor(features, 8, 2, in_keys=["observation"]).double()
    values = (
        value(key, features if shared else None) for key in ("state_value", "state_cost_value")
    )
    parts = actor, *(each.double() for each in values)
    if kind in MULTIPLIERS:
        settings = {"lagrange": MULTIPLIERS[kind]()} | settings
    loss = LOSSES[kind](*parts, **settings)
    loss.make_value_estimator(ValueEstimators.GAE, gamma=GAMMA, lmbda=LAMBDA)
    return loss, actor


def batch_of(actor, envs: int = 4, steps: int = 7, seed: int = 1) -> TensorDict:
    """Transitions [B, T] in float64: an end by termination, one by truncation, and the rest cut off."""
    torch.manual_seed(seed)
    states = torch.randn(envs, steps + 1, SIZE, dtype=torch.float64)
    terminated = torch.zeros(envs, steps, 1, dtype=torch.bool)
    done = terminated.clone()
    terminated[0, 3] = done[0, 3] = done[1, 2] = True
    is_init = torch.zeros_like(done)
    is_init[:, 0] = True
    is_init[0, 4] = is_init[1, 3] = True
    following = {
        "observation": states[:, 1:],
        "reward": torch.randn(envs, steps, 1, dtype=torch.float64),
        "cost": torch.rand(envs, steps, 1, dtype=torch.float64),
        "done": done,
        "terminated": terminated,
    }
    data = {"observation": states[:, :-1], "is_init": is_init, "next": following}
    with torch.no_grad():
        return actor(TensorDict(data, [envs, steps]))
