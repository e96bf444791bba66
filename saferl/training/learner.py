"""One update of everything that learns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule, SoftUpdate

from saferl.modules.compiled import Compiled

#: Names of the parameter groups that step together, one after the other.
ORDERS = {
    "joint": [("critic", "actor", "alpha")],
    "sequential": [("critic",), ("actor",), ("alpha",)],
}


class Learner:
    """One gradient step on every term of a loss, and the target networks' soft update.

    Args:
        loss: any TorchRL LossModule.
        optimizer: over the loss's parameters; a group may hold ``schedule``, its (first, last)
            learning rate, linear in the fraction of the budget that is spent.
        target_updater: soft update of the loss's targets; None where it has none.
        after_update: called with the loss's output after each step (a multiplier, for example).
        order: ``"joint"``: every term at the same parameters, then one step of all, as TorchRL's
            losses do. ``"sequential"`` (paper, Algorithm 1): critics, actor and temperature in turn,
            each at the parameters that the one before left, which evaluates the loss three times.
        compile: whether losses and gradients are compiled, as one graph for each stage of ``order``.

    Raises:
        ValueError: ``order`` is unknown, or a group has another name.

    The groups of the optimizer are called ``"critic"``, ``"actor"`` and ``"alpha"``, as far as there are any.
    """

    def __init__(
        self,
        loss: LossModule,
        optimizer: torch.optim.Optimizer,
        target_updater: SoftUpdate | None = None,
        after_update: list[Callable[[TensorDictBase], None]] | None = None,
        order: str = "joint",
        compile: bool = False,
    ):
        if order not in ORDERS:
            raise ValueError(f"order must be one of {', '.join(ORDERS)}, got {order!r}.")
        there = {group.get("name") for group in optimizer.param_groups}
        if not there or there - set(chain(*ORDERS["joint"])):
            raise ValueError(
                f"The groups of an optimizer must be called {', '.join(*ORDERS['joint'])}, got "
                f"{', '.join(map(str, there))}."
            )
        self.stages = [names for names in ORDERS[order] if there & set(names)]
        self.loss, self.optimizer, self.target_updater = loss, optimizer, target_updater
        self.after_update = after_update or []
        self.gradients: dict[tuple[str, ...], Callable] = {}
        for names in self.stages:
            gradients = partial(self._gradients, names)
            self.gradients[names] = (
                Compiled(gradients, f"the update of {', '.join(names)}") if compile else gradients
            )

    def schedule(self, spent: float) -> None:
        """Set the learning rates for a fraction of the budget."""
        for group in self.optimizer.param_groups:
            first, last = group.get("schedule", (group["lr"], group["lr"]))
            group["lr"] = first + (last - first) * spent

    def _parameters(self, names: tuple[str, ...]) -> list[torch.nn.Parameter]:
        groups = (g["params"] for g in self.optimizer.param_groups if g["name"] in names)
        return list(chain(*groups))

    def _gradients(
        self, names: tuple[str, ...], batch: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase, Sequence[Tensor | None]]:
        """The loss's output, what it wrote into the batch, and the gradients of the named groups."""
        given, batch = list(batch.keys(True, True)), batch.copy()
        losses = self.loss(batch)
        terms = [value for key, value in losses.items() if key.startswith("loss_")]
        gradients = torch.autograd.grad(
            torch.stack(terms).sum(), self._parameters(names), allow_unused=True
        )
        # A fused Adam reads a transposed gradient in the wrong order without a word (torch 2.13).
        gradients = [None if slope is None else slope.contiguous() for slope in gradients]
        return losses.detach(), batch.exclude(*given).detach(), gradients

    def update(self, batch: TensorDictBase) -> TensorDict:
        """Returns the loss terms and metrics, detached scalars; priorities come into the batch."""
        for names in self.stages:
            losses, written, gradients = self.gradients[names](batch)
            for parameter, gradient in zip(self._parameters(names), gradients, strict=True):
                parameter.grad = gradient  # without one a parameter stays where it is
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)
        batch.update(written)
        if self.target_updater is not None:
            self.target_updater.step()
        for hook in self.after_update:
            hook(losses)
        return losses
