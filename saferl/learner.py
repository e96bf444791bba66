"""One update of everything that learns."""

from __future__ import annotations

import logging
from collections.abc import Callable
from itertools import chain

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.objectives import LossModule, SoftUpdate

log = logging.getLogger(__name__)

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
        compile: what makes the loss faster, such as :func:`saferl.modules.compiled`; None: nothing.

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
        compile: Callable[[LossModule], Callable] | None = None,
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
        self._forward = loss
        if compile is not None:
            log.info("Compiling the loss at its first update: this takes about a minute.")
            self._forward = compile(loss)

    def schedule(self, spent: float) -> None:
        """Set the learning rates for a fraction of the budget."""
        for group in self.optimizer.param_groups:
            first, last = group.get("schedule", (group["lr"], group["lr"]))
            group["lr"] = first + (last - first) * spent

    def update(self, batch: TensorDictBase) -> TensorDict:
        """Returns the loss terms and metrics, detached scalars."""
        for names in self.stages:
            groups = [g["params"] for g in self.optimizer.param_groups if g["name"] in names]
            losses = self._forward(batch)
            terms = [value for key, value in losses.items() if key.startswith("loss_")]
            # Parameters without a gradient stay where they are.
            torch.stack(terms).sum().backward(inputs=list(chain(*groups)))
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)
        if self.target_updater is not None:
            self.target_updater.step()
        for hook in self.after_update:
            hook(losses)
        return losses.detach()
