"""Exploration for off-policy losses beyond the noise of a policy."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.data import Bounded, TensorSpec
from torchrl.envs.utils import ExplorationType, exploration_type


class HeldActions(TensorDictModuleBase):
    """Now and then a random action that is held for a few decisions (Dabney et al., 2021).

    Where one decision changes little, as for a car that stands still, noise on single decisions never shows what
    another way of driving would bring; a policy that waits for ever then keeps critics that know nothing else.
    Append it to a policy that collects for an off-policy loss. Outside :attr:`ExplorationType.RANDOM` it does nothing.

    Args:
        spec: of the action, with bounds; random ones are uniform in them.
        share: of all decisions that are random ones.
        hold: decisions that a random action is held.
        action_key: the entry of the action.

    Reads and writes the action [*B, A], and ``held_action`` [*B, A] and ``held_steps`` [*B, 1] (int64), what is held and for how many
    more decisions, which a rollout keeps from one step to the next.

    Raises:
        ValueError: ``share`` is not in [0, 1], ``hold`` is below 1, or the action has no bounds.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from saferl.modules import HeldActions
        >>> explore = HeldActions(Bounded(-1.0, 1.0, (4, 2)), share=1.0, hold=5)
        >>> data = explore(TensorDict(action=torch.zeros(4, 2), batch_size=4))
        >>> first = data["action"].clone()
        >>> bool((explore(data.set("action", torch.zeros(4, 2)))["action"] == first).all())
        True
    """

    def __init__(
        self, spec: TensorSpec, share: float, hold: int = 5, action_key: NestedKey = "action"
    ):
        super().__init__()
        if not 0.0 <= share <= 1.0:
            raise ValueError(f"share must be in [0, 1], got {share}.")
        if hold < 1:
            raise ValueError(f"hold must be >= 1, got {hold}.")
        if not isinstance(spec, Bounded):
            raise ValueError(f"Random actions need bounds, got {type(spec).__name__}.")
        # `hold` random decisions are followed by (1 - start) / start others.
        self.start = share / (share + hold * (1.0 - share))
        self.spec, self.hold, self.action_key = spec, hold, action_key
        keys: list = [action_key]
        self.in_keys, self.out_keys = keys, [*keys, "held_action", "held_steps"]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if exploration_type() not in (ExplorationType.RANDOM, None):
            return tensordict
        action = tensordict.get(self.action_key)
        shape = (*action.shape[:-1], 1)
        left = tensordict.get("held_steps", None)
        left = torch.zeros(shape, dtype=torch.int64, device=action.device) if left is None else left
        begins = (left == 0) & (torch.rand(shape, device=action.device) < self.start)
        random = self.spec.rand(action.shape[: action.ndim - self.spec.ndim])
        held = torch.where(begins, random, tensordict.get("held_action", action))
        left = torch.where(begins, self.hold, left)
        tensordict.set("held_action", held).set("held_steps", (left - 1).clamp_min(0))
        return tensordict.set(self.action_key, torch.where(left > 0, held, action))
