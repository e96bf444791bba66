"""Critics whose values no rewards and costs could add up to."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

log = logging.getLogger(__name__)

#: The networks of losses that value, and what of: the reward or the cost.
CRITICS = {
    "qvalue_network": "reward",
    "critic_network": "reward",
    "cost_critic": "cost",
    "risk_critic": "cost",
}
#: How far outside of it a critic may err while it learns.
TOLERANCE = 3.0
#: Of how many states a look is.
_STATES = 256


class Watchdog:
    """Says which critic left its range first, and when.

    A discounted sum of numbers in [low, high] lies in [low, high] / (1 - gamma), with 0 between both where episodes
    end; low and high are the smallest and largest that were collected. Nothing is read back from a GPU but in a look.

    Args:
        loss: has some of the networks ``qvalue_network``, ``critic_network``, ``cost_critic``, ``risk_critic``.
        gamma: their discount; with 1 there is no range.
        reward_scale: of the rewards that the loss sees.
        values: what a network of the loss, by its name, says of transitions [B]
            (:func:`saferl.objectives.values.critic_values`).
    """

    def __init__(
        self,
        loss: LossModule,
        gamma: float,
        reward_scale: float,
        values: Callable[[LossModule, str, TensorDictBase], Tensor],
    ):
        self.loss, self.gamma, self.reward_scale = loss, gamma, reward_scale
        self.values = values
        self.seen: dict[str, Tensor] = {}
        self.left: dict[str, int] = {}

    def state_dict(self) -> dict[str, Any]:
        """What was seen so far, and which critics left their ranges."""
        return {"seen": dict(self.seen), "left": dict(self.left)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.seen, self.left = dict(state["seen"]), dict(state["left"])

    def take(self, data: TensorDictBase) -> None:
        """Take the rewards and costs of collected data [*B]."""
        for name in ("reward", "cost"):
            value = data.get(("next", name), None)
            if value is not None:
                ends = torch.stack([value.amin().clamp(max=0.0), value.amax().clamp(min=0.0)])
                old = self.seen.get(name, ends).to(ends)
                self.seen[name] = torch.stack(
                    [torch.minimum(old[0], ends[0]), torch.maximum(old[1], ends[1])]
                )

    @torch.no_grad()
    def look(self, data: TensorDictBase, frames: int) -> None:
        """Hold what critics say of some collected transitions [*B] against their range."""
        if self.gamma >= 1.0:
            return
        data = data.reshape(-1)[:_STATES]
        for name, kind in CRITICS.items():
            if name in self.left or kind not in self.seen or not hasattr(self.loss, name):
                continue
            scale = self.reward_scale if kind == "reward" else 1.0
            low, high = (float(end) * scale / (1.0 - self.gamma) for end in self.seen[kind])
            slack = (TOLERANCE - 1.0) * max(high - low, 1.0) + self._bonus(name)
            values = self.values(self.loss, name, data)
            least, most = float(values.amin()), float(values.amax())
            if not (low - slack <= least and most <= high + slack):
                self.left[name] = frames
                log.warning(
                    "%s has left its range at frame %d: it values from %.4g to %.4g, where what was collected adds up to %.4g "
                    "to %.4g. It may diverge; smaller learning rates (learning.lr.critic) may help.",
                    name,
                    frames,
                    least,
                    most,
                    low,
                    high,
                )

    def first(self) -> str:
        """Of the critics that left their ranges the first; empty while there is none."""
        if not self.left:
            return ""
        name, frame = min(self.left.items(), key=lambda item: item[1])
        return f" {name} had left its range at frame {frame}."

    def _bonus(self, name: str) -> float:
        """What a loss may add to a reward's value: CaT's bonus, or that for entropy, ten nats for each dimension."""
        if name == "critic_network":
            return abs(getattr(self.loss, "bonus", 0.0)) / (1.0 - self.gamma)
        log_alpha = getattr(self.loss, "log_alpha", None)
        if name != "qvalue_network" or log_alpha is None:
            return 0.0
        target: Any = getattr(self.loss, "target_entropy", 1.0)
        return math.exp(float(log_alpha)) * 10.0 * max(abs(float(target)), 1.0) / (1.0 - self.gamma)
