"""Costs of other people's environments in the reward spec."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, GymEnv, RewardSum, SerialEnv, TransformedEnv
from torchrl.envs.libs.gym import default_info_dict_reader
from torchrl.envs.utils import check_env_specs
from walk import constant

from saferl.envs.transforms import CostToReward


class LikeSafetyGymnasium(EnvBase):
    """Writes its cost as TorchRL's Safety-Gymnasium wrapper does: a float64 observation of shape []."""

    def __init__(self):
        super().__init__(batch_size=[])
        self.observation_spec = Composite(
            observation=Unbounded((2,)), cost=Unbounded((), dtype=torch.float64)
        )
        self.action_spec = Bounded(-1.0, 1.0, (1,))
        self.reward_spec = Unbounded((1,))

    def _set_seed(self, seed):
        pass

    def _reset(self, tensordict=None, **kwargs):
        zero = torch.zeros((), dtype=torch.float64)
        return TensorDict({"observation": torch.zeros(2), "cost": zero}, [])

    def _step(self, tensordict):
        return TensorDict(
            {
                "observation": torch.ones(2),
                "cost": tensordict["action"].double().abs().sum(),
                "reward": torch.ones(1),
                "done": torch.zeros(1, dtype=torch.bool),
                "terminated": torch.zeros(1, dtype=torch.bool),
            },
            [],
        )


def walk():
    env = GymEnv("test/Walk-v0", disable_env_checker=True)
    return env.set_info_dict_reader(default_info_dict_reader(["cost"]))


@pytest.mark.parametrize("make", [LikeSafetyGymnasium, walk, lambda: SerialEnv(2, walk)])
def test_the_cost_is_a_reward(make):
    env = TransformedEnv(make(), CostToReward())
    env.append_transform(RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]))
    check_env_specs(env)
    data = env.rollout(3, constant(0.5))
    cost = data["next", "cost"]
    assert cost.shape == (*env.batch_size, 3, 1) and cost.dtype == torch.float32
    assert set(env.full_reward_spec.keys()) == {"reward", "cost"}
    assert "cost" not in env.full_observation_spec and "cost" not in data.exclude("next")
    torch.testing.assert_close(data["next", "episode_cost"], cost.cumsum(-2))
    np.testing.assert_allclose(cost.numpy(), 0.5)


def test_refuses():
    with pytest.raises(KeyError, match="no observation 'price', it has .*'cost'"):
        _ = TransformedEnv(LikeSafetyGymnasium(), CostToReward("price")).full_reward_spec
    with pytest.raises(ValueError, match=r"one number for each environment, got 'observation' of"):
        _ = TransformedEnv(LikeSafetyGymnasium(), CostToReward("observation")).full_reward_spec
