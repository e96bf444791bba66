"""A policy with its projector as one graph of tensor operations, for any number of states at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch._higher_order_ops.while_loop import while_loop
from torch.export import Dim, ExportedProgram
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils._pytree import tree_flatten, tree_unflatten
from torchrl.envs.utils import ExplorationType, set_exploration_type

from saferl.algorithms.policy import SafePolicy
from saferl.envs.ports import Port
from saferl.envs.transforms import SafetyProjector
from saferl.modules import CriticEnsemble
from saferl.modules.projection import Descent, descend, evaluate, thresholds

#: Sizes of the open dimensions while a graph is written down: no layer has them, and one that met them would be tied to them.
_SIZES = (61, 59)


def _examples(ports: Mapping[str, Port]) -> tuple[dict[str, Tensor], dict[str, dict[int, Any]]]:
    """Tensors of the ports' shapes, and which of their dimensions are open."""
    names = list(dict.fromkeys(n for p in ports.values() for n in p.shape if isinstance(n, str)))
    sizes = dict(zip(names, _SIZES, strict=False))
    dims = {name: Dim(name, min=1 if name == "batch" else 0) for name in names}
    tensors, shapes = {}, {}
    for key, port in ports.items():
        shape = [sizes[n] if isinstance(n, str) else n for n in port.shape]
        tensors[key] = torch.zeros(shape, dtype=port.dtype)
        shapes[key] = {i: dims[n] for i, n in enumerate(port.shape) if isinstance(n, str)}
    return tensors, shapes


def _written(function: Callable, inputs: list[Tensor]) -> nn.Module:
    """A function as a list of tensor operations, its gradients among them."""
    # Another object for each argument, or the graph would read one of two that are the same twice.
    own = [each.clone() for each in inputs]
    return make_fx(function, tracing_mode="symbolic", _allow_non_fake_inputs=True)(*own)


def _settings(policy: SafePolicy) -> dict[str, Any]:
    """Of its projector; none without one.

    Raises:
        ValueError: it is no :class:`SafetyProjector` on a :class:`CriticEnsemble`.
    """
    projector: Any = policy.projector
    if projector is None:
        return {}
    if not (isinstance(projector, SafetyProjector) and isinstance(projector.risk, CriticEnsemble)):
        raise ValueError(
            "Of projectors a SafetyProjector on a CriticEnsemble can be a graph, "
            f"got {type(projector).__name__}: take project=false, or format=torch."
        )
    own, box = projector.settings, policy.box
    return {
        "limit": projector.limit,
        "steps": own["steps"] * projector.enabled,
        "step": (own["step_size"], own["penalty"], box["low"], box["high"]),
        "keep": own["keep"],
    }


class _Graph(nn.Module):
    """A policy without TensorDicts and without a tape: all gradients are operations.

    Args:
        policy: whose actions these are.
        inputs: examples of what it reads.
        observe: makes this of what the graph reads.
    """

    limit: Tensor
    shift: Tensor

    def __init__(self, policy: SafePolicy, inputs: list[Tensor], observe: Callable | None):
        super().__init__()
        self.observe, self.keys, self.how = observe, list(policy.in_keys), _settings(policy)
        risk: Any = policy.projector and policy.projector.risk
        limit, shift = thresholds(self.how.get("limit", torch.inf), inputs[0])
        self.register_buffer("limit", limit)
        self.register_buffer("shift", shift)
        scene: list[Any] = []

        def look(*inputs: Tensor) -> tuple[Tensor, ...]:
            """The action; with a projector its risk, the risk's gradient and what the critics know of the states."""
            seen = TensorDict(dict(zip(self.keys, inputs, strict=True)))
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                action = policy.actor(seen)["action"]
            if risk is None:
                return (action,)
            # Not stacked: a vmapped product would be tied to the number of states.
            bound = risk.bind(seen, vmap=False).detach()
            leaves, scene[:] = tree_flatten(bound)[0], [tree_flatten(bound)[1]]
            # A loop takes no two views of one tensor, as two members' weights are.
            return action, *evaluate(bound, action, shift), *(leaf.clone() for leaf in leaves)

        def step(number: Tensor, *rest: Tensor) -> tuple[Tensor, ...]:
            at, (start, *leaves) = Descent(*rest[:7]), rest[7:]
            critics = tree_unflatten(leaves, scene[0])
            at = descend(critics, at, start, limit, shift, 1, *self.how["step"])
            return number + 1, *at

        self.look, self.step = _written(look, inputs), None
        if risk is not None:
            action, value, slope, *leaves = self.look(*inputs)
            begin = Descent.begin(action, slope, value, limit, shift)
            self.step = _written(step, [torch.tensor(0), *begin, action, *leaves])

    def forward(self, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
        seen = inputs if self.observe is None else self.observe(**inputs)
        # A caller's strides need not be those of the example; export drops a contiguous() of what is so.
        own = [seen[key].clone(memory_format=torch.contiguous_format) for key in self.keys]
        start, *rest = self.look(*own)
        if self.step is None:
            return {"action": start}
        before, slope, *scene = rest
        steps, one = self.how["steps"], self.step

        def goes_on(number: Tensor, *at: Tensor) -> Tensor:
            return (number < steps) & Descent(*at).active.any()

        def step(number: Tensor, *at: Tensor) -> tuple[Tensor, ...]:
            return one(number, *at, start, *scene)

        begin = Descent.begin(start, slope, before, self.limit, self.shift)
        first = torch.zeros((), dtype=torch.int64)
        at = Descent(*while_loop(goes_on, step, (first, *(part.clone() for part in begin)))[1:])
        action, after, feasible = at.end(self.limit, self.shift, self.how["keep"])
        told = {
            "projection_steps": at.steps.to(before),
            "intervened": (action != start).any(-1),
            "feasible": feasible,
        }
        report = {"action": action, "action_proposed": start}
        report |= {"risk_before": before, "risk_after": after}
        return report | {name: value.unsqueeze(-1) for name, value in told.items()}


@torch.no_grad()
def policy_graph(
    policy: SafePolicy,
    ports: Mapping[str, Port],
    observe: Callable[..., dict[str, Tensor]] | None = None,
) -> ExportedProgram:
    """A policy as one graph: tensors in, tensors out, any number of states.

    The risk's gradient (E9) is differentiated while the graph is written down, so that it needs no tape where it runs. The
    projector is a loop that ends when no state of the batch moves any more, as the policy's own does; its results are the
    policy's up to rounding. An action that is not finite is returned, not refused.

    Args:
        policy: with its projector or without.
        ports: of what the graph reads, by the names of its arguments; of ``policy.in_keys`` where ``observe`` is None.
        observe: from these to what the policy reads, see ``Task.from_state``; None: they are that.

    Returns:
        A program whose result is a mapping of what :class:`SafePolicy` writes.

    Raises:
        ValueError: its projector is no :class:`SafetyProjector` on a :class:`CriticEnsemble`.
    """
    given, shapes = _examples(ports)
    seen = given if observe is None else observe(**given)
    graph = _Graph(policy, [seen[key] for key in policy.in_keys], observe)
    return torch.export.export(graph, (given,), dynamic_shapes=(shapes,), strict=False)
