"""An environment that says what it executed."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torchrl.data import (
    Binary,
    Bounded,
    Composite,
    Unbounded,
)
from torchrl.envs import EnvBase


class EchoEnv(EnvBase):
    """Writes the action it executed into `felt`; each episode takes `horizon` + its index steps."""

    def __init__(self, batch_size=(), horizon=3):
        super().__init__(batch_size=batch_size)
        batch = self.batch_size
        self.horizon = horizon + torch.arange(batch.numel()).reshape(*batch, 1)
        self.observation_spec = Composite(
            observation=Unbounded((*batch, 2)),
            felt=Unbounded((*batch, 2)),
            time=Unbounded((*batch, 1), dtype=torch.int64),
            shape=batch,
        )
        self.action_spec = Bounded(-1.0, 1.0, (*batch, 2))
        self.reward_spec = Unbounded((*batch, 1))
        self.done_spec = Composite(
            {
                key: Binary(1, (*batch, 1), dtype=torch.bool)
                for key in ("done", "terminated", "truncated")
            },
            shape=batch,
        )
        self.generator = torch.Generator().manual_seed(0)

    def _reset(self, tensordict=None, **kwargs):
        observation = torch.rand(*self.batch_size, 2, generator=self.generator)
        felt, time = torch.zeros_like(observation), torch.zeros(*self.batch_size, 1).long()
        return TensorDict(observation=observation, felt=felt, time=time, batch_size=self.batch_size)

    def _step(self, tensordict):
        action = tensordict["action"]
        time = tensordict["time"] + 1
        over = time >= self.horizon
        return TensorDict(
            observation=torch.rand(*self.batch_size, 2, generator=self.generator),
            felt=action.clone(),
            time=time,
            reward=action.sum(-1, keepdim=True),
            done=over,
            terminated=torch.zeros_like(over),
            truncated=over.clone(),
            batch_size=self.batch_size,
        )

    def _set_seed(self, seed):
        self.generator.manual_seed(seed)
