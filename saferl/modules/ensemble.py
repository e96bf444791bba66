"""Ensembles of critics that read live parameters, and what they know of given states."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torch.utils._pytree import register_pytree_node, tree_map_only

#: What may be made of the values of an ensemble's members, [n, *B, N] -> [*B, N].
REDUCTIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "max": lambda values: values.amax(0),
    "min": lambda values: values.amin(0),
    "mean": lambda values: values.mean(0),
}


Reduction = str | Callable[[Tensor], Tensor]

#: Numbers in a member up to which stacked members are faster on a CPU, too: MMAM of width 32.
_SMALL = 2**15


def reduction(reduce: Reduction) -> Callable[[Tensor], Tensor]:
    """The function that a reduction is, or names.

    Raises:
        ValueError: it is neither.
    """
    if callable(reduce):
        return reduce
    if reduce not in REDUCTIONS:
        raise ValueError(
            f"reduce must be one of {', '.join(REDUCTIONS)}, or a function, got {reduce!r}."
        )
    return REDUCTIONS[reduce]


@dataclass(frozen=True)
class _Whole:
    """A critic that is not split, as a function of its parameters with the states, and of the action; equal
    to another of the same critic, so that compiled code knows it again."""

    critic: TensorDictModuleBase
    action_key: NestedKey
    __name__ = "a critic"  # what vmap calls it: to make a repr cannot be compiled

    def __call__(self, scene: tuple[TensorDictBase, TensorDictBase], action: Tensor) -> Tensor:
        params, states = scene
        with params.to_module(self.critic, preserve_module_state=False):
            seen = self.critic(states.copy().set(self.action_key, action))
        return seen.get(self.critic.out_keys[0])


@dataclass(frozen=True)
class BoundCritics:
    """Critics with stacked parameters in given states: values as functions of the action alone.

    A network with ``encode(*inputs)`` and a function ``value(encoded, action)`` that needs nothing
    else, as :class:`MMAMValue` and :class:`MLPValue` have, is split: what no action changes is
    computed once, by :meth:`of`, for any number of actions. Other critics are evaluated whole.

    Attributes:
        value: a member's value [*B, 1] from its scene and actions [*B, A].
        scenes: what the members know of the states, with the weights that meet the action: a list
            of one scene for each, or, ``stacked``, one scene of tensors [n, ...], evaluated at once.
        stacked: which of the two.
        reduce: what a call makes of the members' values of each cost, [n, *B, K, N]: ``"max"``, ``"min"``, ``"mean"``, or
            a function to [*B, K, 1]. N is 1, or the number of quantiles.
        costs: K, of which the members' N K outputs are, one after the other.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from saferl.modules import BoundCritics, MLPValue, value_operator
        >>> critics = [value_operator(MLPValue(rows=3)) for _ in range(2)]
        >>> params = TensorDict.from_modules(*critics, as_module=True, expand_identical=True)
        >>> states = TensorDict(ego=torch.randn(5, 9), vehicles=torch.zeros(5, 3, 6), batch_size=5)
        >>> bound = BoundCritics.of(critics[0], params, states)
        >>> bound.values(torch.zeros(5, 2)).shape, bound(torch.zeros(5, 2)).shape
        (torch.Size([2, 5, 1]), torch.Size([5, 1]))
    """

    value: Callable[[Any, Tensor], Tensor]
    scenes: Any
    stacked: bool = False
    reduce: Reduction = "max"
    costs: int = 1

    @classmethod
    def of(
        cls,
        critic: TensorDictModuleBase,
        params: TensorDictBase,
        tensordict: TensorDictBase,
        *,
        action_key: NestedKey = "action",
        reduce: Reduction = "max",
        costs: int = 1,
        vmap: bool | None = None,
    ) -> BoundCritics:
        """Binds critics to the states in ``tensordict``, of which the action is not read.

        Args:
            critic: one of them, whose structure alone is used.
            params: the parameters and buffers of all members, with batch size [n].
            tensordict: holds what the critics read.
            action_key: the entry that is the action.
            reduce, costs: see the class.
            vmap: whether to stack the members; by default on a GPU, which they fill together, and where each
                is small. A core of a CPU is full with one large member.
        """
        states = tensordict.select(*(key for key in critic.in_keys if key != action_key))
        network = getattr(critic, "module", None)
        split = critic.in_keys[-1] == action_key and getattr(network, "encode", None) is not None

        def encode(params: TensorDictBase, states: TensorDictBase) -> Any:
            if not split:
                return [params, states]
            with params.to_module(critic, preserve_module_state=False):
                return network.encode(*map(states.get, critic.in_keys[:-1]))  # pyright: ignore

        if vmap is None:
            size = sum(value.numel() for value in params.values(True, True))
            on_cpu = tensordict.device is None or tensordict.device.type == "cpu"
            vmap = not on_cpu or size <= _SMALL * params.batch_size[0]
        if vmap:
            states = states.expand(params.batch_size[0], *states.batch_size)
            scenes = torch.vmap(encode)(params, states) if split else [params, states]
        else:
            scenes = [encode(member, states) for member in params.unbind(0)]
        value = network.value if split else _Whole(critic, action_key)  # pyright: ignore
        return cls(value, scenes, vmap, reduce, costs)

    def values(self, action: Tensor) -> Tensor:
        """The outputs of each member, [n, *B, K N], for actions [*B, A]."""
        if not self.stacked:
            return torch.stack([self.value(scene, action) for scene in self.scenes])
        value = torch.vmap(self.value, (0, None), randomness="different")
        return value(self.scenes, action)

    def __call__(self, action: Tensor) -> Tensor:
        """The members' values reduced to one of each cost, [*B, K]."""
        values = self.values(action).unflatten(-1, (self.costs, -1))
        reduced = reduction(self.reduce)(values)
        if reduced.shape != (*values.shape[1:-1], 1):
            raise ValueError(
                f"reduce must make one number of the members' values, [n, *B, N] -> [*B, 1], got "
                f"{tuple(reduced.shape)} of {tuple(values.shape)}."
            )
        return reduced.squeeze(-1)

    def detach(self) -> BoundCritics:
        """The same, differentiable with respect to the action alone."""
        return replace(
            self, scenes=tree_map_only((Tensor, TensorDictBase), lambda x: x.detach(), self.scenes)
        )


# Compiled code tells apart what the critics know of the states and how they use it.
register_pytree_node(
    BoundCritics,
    lambda bound: ([bound.scenes], (bound.value, bound.stacked, bound.reduce, bound.costs)),
    lambda scenes, rest: BoundCritics(rest[0], *scenes, *rest[1:]),
)


class CriticEnsemble(TensorDictModuleBase):
    """Several critics with stacked parameters, evaluated at once and reduced to one value.

    The paper's risk is the larger of two cost critics, Q_c = max_i Q_c,i (with E13).

    Args:
        members: either a list of critics (TensorDictModules alike but for their weights), which the
            ensemble copies into stacked parameters of its own; or one critic as a template, with
            ``params``.
        params: stacked parameters [n, ...] of a template, such as a loss's
            ``loss.cost_critic_params``. The ensemble then is a view: it reads these very tensors at
            each call, and they are neither in its ``parameters()`` nor in its ``state_dict()``. It stays in its
            process: in another it would read a copy for ever.
        reduce: ``"max"``, ``"min"`` or ``"mean"`` over the members, or a function of their values
            [n, *B, N] to [*B, 1], such as :class:`saferl.modules.MeanStd`.
        action_key: the entry that :meth:`bind` leaves open.
        costs: K, how many costs the members value. Each is reduced by itself.

    Attributes:
        params: the live parameters and buffers of all members, with batch size [n].

    Reads the members' ``in_keys``. Writes their ``out_key`` [*B, K].

    Raises:
        ValueError: if ``reduce`` is unknown, the list is empty, its members read or write different
            entries, or a list comes with ``params`` or a template without.
        RuntimeError: a view is pickled, or used in another process than the one that made it.

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
    home: int | None = None  # the process of a view

    def __init__(
        self,
        members: Sequence[TensorDictModuleBase] | TensorDictModuleBase,
        params: TensorDictParams | None = None,
        *,
        reduce: Reduction = "max",
        action_key: NestedKey = "action",
        costs: int = 1,
    ):
        super().__init__()
        reduction(reduce)
        if isinstance(members, TensorDictModuleBase):
            if params is None:
                raise ValueError("A template critic needs its stacked params; else pass a list.")
            template = members
            # A view owns nothing, or a checkpoint would hold the loss's weights twice.
            self.__dict__.update(params=params, home=os.getpid())
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
            # Of a single member expanded parameters would be no leaves, which no optimizer sees.
            several = len(members) > 1
            self.params = TensorDict.from_modules(
                *members, as_module=True, expand_identical=several
            )
        # Only the structure of the template is used: its own weights must not be listed.
        self.__dict__["template"] = template
        self.reduce, self.costs = reduce, costs
        self.action_key = unravel_key(action_key)
        self.in_keys = list(template.in_keys)
        self.out_keys = [template.out_keys[0]]

    def __copy__(self) -> CriticEnsemble:
        copy = type(self).__new__(type(self))
        copy.__dict__.update(self.__dict__)
        return copy

    def __deepcopy__(self, memo: dict[int, Any]) -> CriticEnsemble:
        copy = memo[id(self)] = type(self).__new__(type(self))
        copy.__dict__.update(deepcopy(self.__dict__, memo))
        return copy

    def __reduce_ex__(self, protocol: Any) -> Any:
        self._stay_at_home(None)
        return super().__reduce_ex__(protocol)

    def _stay_at_home(self, process: int | None) -> None:
        if self.home not in (None, process):
            raise RuntimeError(
                "A CriticEnsemble of a loss's own parameters reads them where they are trained; in another process it would "
                "read a copy for ever. Put the SafetyProjector around the workers' environment (ParallelEnv), or give "
                "the ensemble a list of critics, whose copies stay as they are."
            )

    def bind(self, tensordict: TensorDictBase, vmap: bool | None = None) -> BoundCritics:
        """The reduced value in these states as a function of the action alone, [*B, A] -> [*B, K].

        Reads the members' ``in_keys`` but for the action. It is valid until the parameters change.
        ``vmap``: see :meth:`BoundCritics.of`.
        """
        self._stay_at_home(os.getpid())
        return BoundCritics.of(
            self.template,
            self.params,
            tensordict,
            reduce=self.reduce,
            costs=self.costs,
            action_key=self.action_key,
            vmap=vmap,
        )

    def values(self, tensordict: TensorDictBase) -> Tensor:
        """The outputs of each member, [n, *B, K N]; writes nothing."""
        return self.bind(tensordict).values(tensordict.get(self.action_key))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(
            self.out_keys[0], self.bind(tensordict)(tensordict.get(self.action_key))
        )
