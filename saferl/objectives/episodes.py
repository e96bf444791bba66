"""What an episode costs, from batches that cut episodes off."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class EpisodeCost(nn.Module):
    """Means over the episodes that ended lately, followed through as many batches as they take.

    Of the cost of an episode (undiscounted, in its unit) and of its decisions, from its start to its end by
    termination or truncation. An episode whose start was not seen does not count. The ``state_dict`` holds the
    episodes that go on, too.

    Args:
        memory (float, optional): the weight of a batch's episodes against those of the next one in which any
            ends, as the few of one batch are a noisy mean. Defaults to ``0.8``.

    Attributes:
        count: how many episodes the means are of, the earlier ones by their weights; a float64 scalar.
        running: float64 ``[*B, 3]``: of each episode that goes on its cost and decisions so far, and whether its
            start was seen.

    Raises:
        ValueError: ``memory`` lies outside [0, 1].

    Examples:
        >>> episodes = EpisodeCost()
        >>> first = torch.tensor([[True, False, False]])
        >>> done = torch.tensor([[False, False, True]])
        >>> episodes.update(torch.full((1, 3), 0.5), first, done)
        >>> [float(mean) for mean in episodes.mean]
        [1.5, 3.0]
    """

    ended: Tensor

    def __init__(self, memory: float = 0.8) -> None:
        super().__init__()
        if not 0 <= memory <= 1:
            raise ValueError(f"memory must be in [0, 1], got {memory}.")
        self.memory = memory
        # Of those that ended: both sums and their number.
        self.register_buffer("ended", torch.zeros(3, dtype=torch.float64))
        self.running = torch.zeros(0, 3, dtype=torch.float64)

    def get_extra_state(self) -> dict[str, Tensor]:
        return {"running": self.running}

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        self.running = state["running"]

    @property
    def count(self) -> Tensor:
        return self.ended[2]

    @property
    def mean(self) -> tuple[Tensor, Tensor]:
        """The cost of an episode and its decisions, scalars; NaN before the first end."""
        cost, decisions = self.ended[:2] / self.ended[2]
        return cost, decisions

    @torch.no_grad()
    def update(self, cost: Tensor, first: Tensor, done: Tensor) -> None:
        """Take a batch, the continuation of the one before where the shapes are equal.

        Args:
            cost: ``[*B, T]``, of each transition.
            first, done: bool ``[*B, T]``, whether a transition is an episode's first, and its last.
        """
        running = self.running.to(self.ended.device)
        if running.shape[:-1] != cost.shape[:-1]:
            running = self.ended.new_zeros(*cost.shape[:-1], 3)
        fresh = running.new_tensor([0.0, 0.0, 1.0])
        steps = []
        for now, start in zip(cost.unbind(-1), first.unbind(-1), strict=True):
            total, decisions, seen = torch.where(start[..., None], fresh, running).unbind(-1)
            running = torch.stack((total + now, decisions + 1.0, seen), -1)
            steps.append(running)
        self.running = running
        after = torch.stack(steps, -2)
        ended = after[done & (after[..., 2] > 0)]  # the last column is 1: it counts them
        if len(ended):
            self.ended.mul_(self.memory).add_(ended.sum(0))
