"""A tabular problem with a limit in each state, whose optimum is known."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded

from saferl.envs.seeding import SeededEnv, uniform
from saferl.envs.task import Task

#: By state: the cost of full action, and how strongly the reward pulls beyond the limit.
PRICES = (0.5, 0.7, 0.9, 1.1)
PULLS = (0.95, 1.0, 1.05, 1.0)


@dataclass(frozen=True)
class Table(Task):
    """Four states, drawn anew at each step; r = -(a - g_s)^2 and c = u_s (1 + a) / 2, a in [-1, 1].

    Q_c(s, a) = c(s, a) + gamma V, where V is the mean cost over the states / (1 - gamma). With the limit d on
    Q_c(s, a) in every state and pulls g_s beyond it, each state's cost is d (1 - gamma) at the optimum.
    """

    limit: float = 1.0
    gamma: float = 0.8
    horizon: int = 10
    size: int = 4
    action_dim: int = 1
    task: str = "table"

    @property
    def prices(self) -> torch.Tensor:
        return torch.tensor(PRICES)

    @property
    def best(self) -> torch.Tensor:
        """The optimal action of each state [4]."""
        return 2 * self.limit * (1 - self.gamma) / self.prices - 1

    @property
    def pulls(self) -> torch.Tensor:
        """g_s [4]: at the optimum the reward's slope is 0.95 to 1.05 times the cost's."""
        return self.best + torch.tensor(PULLS) * self.prices / 4

    def reward(self, action: torch.Tensor) -> torch.Tensor:
        return -((action - self.pulls) ** 2)

    def values(self, action: torch.Tensor) -> torch.Tensor:
        """Q_c(s, a_s) [4] of a deterministic policy."""
        cost = self.prices * (1 + action) / 2
        return cost + self.gamma * cost.mean() / (1 - self.gamma)


class TableEnv(SeededEnv):
    """:class:`Table` as a batch of tensors; ``observation`` is the state, one-hot."""

    kept = (*SeededEnv.kept, "_seeds", "_steps", "_where")

    def __init__(self, task: Table, num_envs: int = 1, seed: int = 0, device=None):
        super().__init__(task, num_envs, device)
        batch = self.batch_size
        self.observation_spec = Composite(observation=Unbounded(shape=(*batch, 4)), shape=batch)
        self.action_spec = Bounded(-1.0, 1.0, shape=(*batch, 1))
        self._make_ends()
        self._seeds = torch.zeros(batch, dtype=torch.int64)
        self._steps = torch.zeros_like(self._seeds)
        self.set_seed(seed)

    def _observe(self) -> torch.Tensor:
        self._where = (4 * uniform(self._seeds + (self._steps << 32), 0)).long()
        return torch.nn.functional.one_hot(self._where, 4).float()

    def _reset(self, tensordict=None, seeds=None, **kwargs):
        reset = self._reset_mask(tensordict)
        self._seeds = torch.where(reset, self._next_seeds(reset, seeds), self._seeds)
        self._steps = torch.where(reset, 0, self._steps)
        return TensorDict({"observation": self._observe()}, batch_size=self.batch_size)

    def _step(self, tensordict):
        action, task = tensordict["action"], self.task
        here = torch.nn.functional.one_hot(self._where, 4).bool()
        reward, cost = (
            value.expand(*self.batch_size, 4)[here].unsqueeze(-1)
            for value in (task.reward(action), task.prices * (1 + action) / 2)
        )
        self._steps = self._steps + 1
        done = (self._steps >= task.horizon)[:, None]
        return TensorDict(
            {
                "observation": self._observe(),
                "reward": reward,
                "cost": cost,
                "terminated": torch.zeros_like(done),
                "truncated": done,
                "done": done.clone(),
            },
            batch_size=self.batch_size,
        )
