"""Critics as TensorDictModules, and ensembles of them that read live parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.modules import ValueOperator

#: What may be made of the values of an ensemble's members, [n, *B, 1] -> [*B, 1].
REDUCTIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "max": lambda values: values.amax(0),
    "min": lambda values: values.amin(0),
    "mean": lambda values: values.mean(0),
}


class StateValue(nn.Module):
    """A linear value on top of an encoder, V(s), for on-policy algorithms.

    Args:
        encoder: maps its inputs to features [*B, width].
        width: size of these features.

    Returns values [*B, 1].

    Examples:
        >>> import torch
        >>> from saferl.modules import MLPPolicyEncoder, StateValue
        >>> value = StateValue(MLPPolicyEncoder(rows=3, width=32), width=32)
        >>> value(torch.randn(5, 9), torch.zeros(5, 3, 6)).shape
        torch.Size([5, 1])
    """

    def __init__(self, encoder: nn.Module, width: int):
        super().__init__()
        self.encoder = encoder
        self.head = nn.Linear(width, 1)

    def forward(self, *inputs: Tensor) -> Tensor:
        return self.head(self.encoder(*inputs))


def zero_output(network: nn.Module) -> nn.Module:
    """Sets the read-out weights of a value network to 0, so that its value begins at exactly 0.

    A cost critic that begins at random calls actions risky before it has seen a cost: a projector
    then corrects nearly every one of them, and a multiplier pushes the policy away from nothing.

    Args:
        network: a module whose read-outs are its linear layers with one output, such as
            :class:`MMAMValue` or :class:`MLPValue`; changed in place and returned.

    Raises:
        ValueError: the network has no such layer.

    Examples:
        >>> import torch
        >>> from saferl.modules import MLPValue, zero_output
        >>> value = zero_output(MLPValue(rows=3, width=32))
        >>> value(torch.randn(5, 9), torch.zeros(5, 3, 6), torch.ones(5, 2)).abs().max().item()
        0.0
    """
    readouts = [
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


class CriticEnsemble(TensorDictModuleBase):
    """Several critics with stacked parameters, evaluated at once and reduced to one value.

    The paper's risk is the larger of two cost critics, Q_c = max_i Q_c,i (with E13).

    Args:
        members: either a list of critics (TensorDictModules alike but for their weights), which the
            ensemble copies into stacked parameters of its own; or one critic as a template, with
            ``params``.
        params: stacked parameters [n, ...] of a template, such as a loss's
            ``loss.cost_critic_params``. The ensemble then is a view: it reads these very tensors at
            each call, and they are neither in its ``parameters()`` nor in its ``state_dict()``.
        reduce: ``"max"``, ``"min"`` or ``"mean"`` over the members.
        action_key: the entry that :meth:`bind` leaves open.

    Attributes:
        params: the live parameters and buffers of all members, with batch size [n].

    Reads the members' ``in_keys``. Writes their ``out_key`` [*B, 1].

    Raises:
        ValueError: if ``reduce`` is unknown, the list is empty, its members read or write different
            entries, or a list comes with ``params`` or a template without.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from saferl.modules import CriticEnsemble, MLPValue, value_operator
        >>> critics = [value_operator(MLPValue(rows=3), out_key="risk") for _ in range(2)]
        >>> ensemble = CriticEnsemble(critics, reduce="max")
        >>> td = TensorDict(
        ...     ego=torch.randn(5, 9), vehicles=torch.zeros(5, 3, 6), action=torch.zeros(5, 2)
        ... ).auto_batch_size_(1)
        >>> each = torch.stack([critic(td.copy())["risk"] for critic in critics])
        >>> torch.allclose(ensemble(td)["risk"], each.amax(0))
        True
    """

    params: TensorDictParams
    template: TensorDictModuleBase
    in_keys: list[NestedKey]
    out_keys: list[NestedKey]

    def __init__(
        self,
        members: Sequence[TensorDictModuleBase] | TensorDictModuleBase,
        params: TensorDictParams | None = None,
        *,
        reduce: str = "max",
        action_key: NestedKey = "action",
    ):
        super().__init__()
        if reduce not in REDUCTIONS:
            raise ValueError(f"reduce must be one of {sorted(REDUCTIONS)}, got {reduce!r}.")
        if isinstance(members, TensorDictModuleBase):
            if params is None:
                raise ValueError("A template critic needs its stacked params; else pass a list.")
            template = members
            # A view owns nothing, or a checkpoint would hold the loss's weights twice.
            self.__dict__["params"] = params
        else:
            members = list(members)
            if not members or params is not None:
                raise ValueError(
                    f"Expected a list of at least one critic without params, got {len(members)} "
                    f"critics and params={'None' if params is None else 'given'}."
                )
            template = members[0]
            for member in members[1:]:
                theirs, ours = ([*m.in_keys, *m.out_keys] for m in (member, template))
                if theirs != ours:
                    raise ValueError(
                        f"All critics must use the same keys, got {ours} and {theirs}."
                    )
            self.params = TensorDict.from_modules(*members, as_module=True, expand_identical=True)
        # Only the structure of the template is used: its own weights must not be listed.
        self.__dict__["template"] = template
        self.reduce = reduce
        self.action_key = unravel_key(action_key)
        self.in_keys = list(template.in_keys)
        self.out_keys = [template.out_keys[0]]

    def _member(self, params: TensorDictBase, tensordict: TensorDictBase) -> Tensor:
        with params.to_module(self.template, preserve_module_state=False):
            return self.template(tensordict.copy()).get(self.out_keys[0])

    def values(self, tensordict: TensorDictBase) -> Tensor:
        """The value of each member, [n, *B, 1]; writes nothing."""
        inputs = tensordict.select(*self.in_keys)
        return torch.vmap(self._member, (0, None))(self.params, inputs)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(self.out_keys[0], REDUCTIONS[self.reduce](self.values(tensordict)))

    @torch.no_grad()
    def bind(self, tensordict: TensorDictBase) -> Callable[[Tensor], Tensor]:
        """The reduced value as a function of the action alone, [*B, A] -> [*B, 1].

        All that does not depend on the action is computed here, once, if the network has a
        ``condition`` method (as :class:`MMAMValue` and :class:`MLPValue` do). The function can be
        differentiated with respect to the action, not the parameters, and is valid until these
        change.

        Reads the members' ``in_keys`` but for the action.
        """
        network = getattr(self.template, "module", None)
        condition = getattr(network, "condition", None)
        if self.in_keys[-1] != self.action_key or condition is None:
            scene = tensordict.select(*(key for key in self.in_keys if key != self.action_key))
            return lambda action: self(scene.copy().set(self.action_key, action)).get(
                self.out_keys[0]
            )
        scene = [tensordict.get(key) for key in self.in_keys[:-1]]
        members = []
        for params in self.params.data.unbind(0):
            with params.to_module(self.template, preserve_module_state=False):
                members.append(condition(*scene))
        reduce = REDUCTIONS[self.reduce]
        return lambda action: reduce(torch.stack([member(action) for member in members]))
