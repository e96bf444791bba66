"""Costs of other people's environments, brought to where saferl expects them."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform


class CostToReward(Transform):
    """Makes a cost that an environment tells among its observations or infos a second reward.

    TorchRL's Safety-Gymnasium wrapper writes ``cost`` as a float64 observation of shape [], and
    ``default_info_dict_reader(["cost"])`` does so for any gymnasium environment. After this transform
    ``("next", "cost")`` is float32 [*B, 1] and stands in ``full_reward_spec``, so that collectors,
    ``RewardSum`` and the losses here treat it as a reward.

    Args:
        in_key: where the cost is; it leaves the observation.
        out_key: where it goes.

    Raises:
        KeyError: the environment has no ``in_key``.
        ValueError: it is not one number for each environment.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl.envs.libs.gym import default_info_dict_reader
        >>> from saferl.envs.transforms import CostToReward
        >>> def make(name):
        ...     env = GymEnv(name)
        ...     env.set_info_dict_reader(default_info_dict_reader(["cost"]))
        ...     return TransformedEnv(env, CostToReward())
    """

    def __init__(self, in_key: NestedKey = "cost", out_key: NestedKey = "cost"):
        super().__init__()
        self.in_key, self.out_key = unravel_key(in_key), unravel_key(out_key)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        cost = next_tensordict.pop(self.in_key)
        shape = (*next_tensordict.batch_size, 1)
        return next_tensordict.set(self.out_key, cost.to(torch.float32).reshape(shape))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset.exclude(self.in_key)

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        output_spec = output_spec.clone()
        observation, reward = output_spec["full_observation_spec"], output_spec["full_reward_spec"]
        if self.in_key not in observation.keys(True, True):
            raise KeyError(
                f"CostToReward: the environment has no observation {self.in_key!r}, it has "
                f"{sorted(map(str, observation.keys(True, True)))}. TorchRL's default_info_dict_reader "
                "makes an entry of a gymnasium environment's info one."
            )
        spec = observation[self.in_key]
        if spec.shape.numel() != observation.shape.numel():
            raise ValueError(
                f"CostToReward needs one number for each environment, got {self.in_key!r} of shape "
                f"{list(spec.shape)}."
            )
        del observation[self.in_key]
        reward[self.out_key] = Unbounded(
            shape=torch.Size((*observation.shape, 1)), device=spec.device, dtype=torch.float32
        )
        return output_spec
