"""What the critics inside a loss say."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from saferl.modules.ensemble import BoundCritics


def critic_values(loss: LossModule, name: str, tensordict: TensorDictBase) -> Tensor:
    """The values of a critic of a loss, of all its members.

    Args:
        loss: one of ours, or TorchRL's SAC and PPO.
        name: ``qvalue_network``, ``critic_network``, ``cost_critic`` or ``risk_critic``.
        tensordict: transitions [B], with the action where the critic reads one.

    Returns:
        [B, 1], or [n, B, K] of n members with K outputs.
    """
    network, params = getattr(loss, name), getattr(loss, f"{name}_params")
    if len(params.batch_size):  # members side by side
        action: Any = getattr(loss.tensor_keys, "action")  # noqa: B009
        members = BoundCritics.of(network, params, tensordict, action_key=action)
        return members.values(tensordict.get(action))
    with params.to_module(network, preserve_module_state=False):
        out = network(tensordict.select(*network.in_keys))
    return out.get(network.out_keys[-1])
