"""Critics as TensorDictModules."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import ValueOperator


class StateValue(nn.Module):
    """A linear value on top of an encoder, V(s), for on-policy algorithms.

    Args:
        encoder: maps its inputs to features [*B, width].
        width: size of these features.
        outputs: K, numbers of a value; more than one of several costs.

    Returns values [*B, K].

    Examples:
        >>> import torch
        >>> from saferl.modules import MLPPolicyEncoder, StateValue
        >>> value = StateValue(MLPPolicyEncoder(rows=3, width=32), width=32)
        >>> value(torch.randn(5, 9), torch.zeros(5, 3, 6)).shape
        torch.Size([5, 1])
    """

    def __init__(self, encoder: nn.Module, width: int, outputs: int = 1):
        super().__init__()
        self.encoder = encoder
        self.head = nn.Linear(width, outputs)

    def forward(self, *inputs: Tensor) -> Tensor:
        return self.head(self.encoder(*inputs))


def zero_output(network: nn.Module) -> nn.Module:
    """Sets the read-out weights of a value network to 0, so that its value begins at exactly 0.

    A cost critic that begins at random calls actions risky before it has seen a cost: a projector
    then corrects nearly every one of them, and a multiplier pushes the policy away from nothing.

    Args:
        network: a module that lists its read-outs as ``readouts``, as :class:`MMAMValue` and
            :class:`MLPValue` do, or whose read-outs are its linear layers with one output; changed in
            place and returned.

    Raises:
        ValueError: the network has no such layer.

    Examples:
        >>> import torch
        >>> from saferl.modules import MLPValue, zero_output
        >>> value = zero_output(MLPValue(rows=3, width=32))
        >>> value(torch.randn(5, 9), torch.zeros(5, 3, 6), torch.ones(5, 2)).abs().max().item()
        0.0
    """
    readouts = getattr(network, "readouts", None) or [
        module
        for module in network.modules()
        if isinstance(module, nn.Linear) and module.out_features == 1
    ]
    if not readouts:
        raise ValueError(f"{type(network).__name__} has no linear layer with one output.")
    for layer in readouts:
        for parameter in layer.parameters():
            nn.init.zeros_(parameter)
    return network


def value_operator(
    network: nn.Module,
    in_keys: Sequence[NestedKey] = ("ego", "vehicles", "action"),
    out_key: NestedKey = "state_action_value",
) -> ValueOperator:
    """Wraps a value network so that it reads ``in_keys`` and writes ``out_key`` [*B, 1].

    Args:
        network: maps the entries ``in_keys`` to values [*B, 1].
        in_keys: entries that the network takes, in its order.
        out_key: ``"state_action_value"`` for a return, ``"state_action_cost_value"`` for a cost.

    Examples:
        >>> from saferl.modules import MMAMValue, value_operator
        >>> value_operator(MMAMValue(width=32), out_key="state_action_cost_value").out_keys
        ['state_action_cost_value']
    """
    return ValueOperator(network, in_keys=list(in_keys), out_keys=[out_key])
