"""A budget of safety as part of the state."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from saferl.envs.transforms.correction import Switched
from saferl.modules.limits import as_limit

#: What sums of shares in float32 may be off by: a budget that is spent to the last is not exceeded.
_ROUNDING = 1e-5


class Saute(Switched, Transform):
    r"""Observes what is left of an episode's budget, and pays no reward beyond it (Sauté RL).

    .. math::

        z_0 = 1, \quad z_{t+1} = z_t - c_t / d, \quad
        \tilde r_t = \begin{cases} r_t & \text{if } z_{t+1} \ge 0 \\ -n & \text{else} \end{cases}

    Sootla et al., `arXiv 2202.06558 <https://arxiv.org/abs/2202.06558>`_, (5) and (6), undiscounted, as ``cost_limit`` is. A
    policy that observes :math:`z` knows what it may still spend. The best one, for n large enough, keeps the limit in every
    episode (almost surely), which is more than a limit on their mean asks for, and earns less. Any algorithm without a
    constraint learns it. Of several costs every budget counts.

    Args:
        cost_limit: d, on the cost of an episode, undiscounted; of K costs a list [K].
        penalty: n, what a step costs once a budget is spent: more than the worst reward.
        in_key: the observation that the budget is put behind.
        out_key: where both go, together.
        budget_key: where the budget goes, alone.
        cost_key, reward_key: under ``"next"``.

    Attributes:
        count: K, how many numbers are put behind the observation.
        enabled: whether rewards are replaced; not in a test, which reports what was earned.

    Reads ``in_key`` [*B, n] and, under ``next``, ``cost`` [*B, K] and ``reward`` [*B, 1]. Writes ``budget`` [*B, K], the
    share of each limit that is left, below 0 where it is exceeded; ``budgeted`` [*B, n + K]; while enabled ``reward``.

    Raises:
        ValueError: a limit is not positive, or they are not as many as the environment's costs; ``penalty`` is negative or not
            finite.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from saferl.envs import Cart, CartEnv
        >>> from saferl.envs.transforms import Saute
        >>> env = TransformedEnv(CartEnv(Cart(), num_envs=2), Saute(cost_limit=0.2))
        >>> steps = env.rollout(3)
        >>> steps["budgeted"].shape, steps["budget"][:, 0].flatten().tolist()
        (torch.Size([2, 3, 3]), [1.0, 1.0])
    """

    def __init__(
        self,
        cost_limit: float | Sequence[float],
        penalty: float = 1.0,
        *,
        in_key: NestedKey = "observation",
        out_key: NestedKey = "budgeted",
        budget_key: NestedKey = "budget",
        cost_key: NestedKey = "cost",
        reward_key: NestedKey = "reward",
    ):
        super().__init__()
        limit = as_limit("cost_limit", cost_limit).reshape(-1)
        if not (limit > 0).all():
            raise ValueError(
                f"cost_limit must be > 0, as costs are counted in shares of it, got {cost_limit}."
            )
        if not 0 <= penalty < math.inf:
            raise ValueError(f"penalty must be >= 0, got {penalty}.")
        self.register_buffer("limit", limit)
        self.count, self.penalty = limit.numel(), float(penalty)
        self.in_key, self.out_key, self.budget_key, self.cost_key, self.reward_key = map(
            unravel_key, (in_key, out_key, budget_key, cost_key, reward_key)
        )

    limit: Tensor

    def _write(self, tensordict: TensorDictBase, budget: Tensor) -> TensorDictBase:
        both = torch.cat([tensordict.get(self.in_key), budget], -1)
        return tensordict.set(self.budget_key, budget).set(self.out_key, both)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        cost = next_tensordict.get(self.cost_key)
        budget = tensordict.get(self.budget_key) - cost / self.limit.to(cost)
        if self.enabled:
            reward = next_tensordict.get(self.reward_key)
            within = (budget >= -_ROUNDING).all(-1, keepdim=True)
            next_tensordict.set(self.reward_key, torch.where(within, reward, -self.penalty))
        return self._write(next_tensordict, budget)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        observed = tensordict_reset.get(self.in_key)
        full = observed.new_ones(*observed.shape[:-1], self.count)
        reset, left = tensordict.get("_reset", None), tensordict.get(self.budget_key, None)
        if reset is not None and left is not None:  # the others go on
            full = torch.where(reset.reshape(*observed.shape[:-1], 1), full, left)
        return self._write(tensordict_reset, full)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        env = self.parent
        if env is None:
            raise RuntimeError("Saute must be appended to an environment.")
        there = env.full_reward_spec[self.cost_key].shape[-1]
        if there != self.count:
            raise ValueError(
                f"cost_limit must be {there} numbers, one for each cost of the environment, got {self.count}."
            )
        spec, observed = observation_spec.clone(), observation_spec[self.in_key]
        for key, size in ((self.budget_key, 0), (self.out_key, observed.shape[-1])):
            shape = torch.Size((*observed.shape[:-1], size + self.count))
            spec[key] = Unbounded(shape, device=observed.device, dtype=observed.dtype)
        return spec
