# TorchRL's specs take tuples that their annotations do not name.
# pyright: reportArgumentType=false
"""The true scene beside what is observed of it, for traces and pictures."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import Transform

from saferl.envs.intersection.observation import observe
from saferl.envs.intersection.roads import lanes
from saferl.envs.intersection.traffic import vehicle_states
from saferl.envs.intersection.yielding import has_priority

_LATE = 600.0  # s, after everybody who has entered: who is about to comes last


class TrueScene(Transform):
    """Adds the true scene to what an intersection shows; what a policy reads stays as it is.

    Writes ``scene``, with ``ego`` [B, 6] (x, y, v_x, v_y, phi, omega), ``vehicles`` [B, N, 6] (the same, NaN while a
    vehicle is not on the road; row k is vehicle k for the whole episode), ``route`` [B, N] int64 (``4 * arm + k``, see
    :mod:`saferl.envs.intersection.roads`; another one when it enters again), ``priority`` [B, N] bool, which vehicles go before
    the ego by the rules of the road, and ``within_view`` [B, N] bool, which the cost counts. float32, SI units.

    >>> from torchrl.envs import TransformedEnv
    >>> from saferl.envs.intersection import BatchedIntersection, Scenario
    >>> env = TransformedEnv(BatchedIntersection(Scenario(task="lt"), num_envs=2), TrueScene())
    >>> env.rollout(3)["next", "scene", "vehicles"].shape
    torch.Size([2, 3, 10, 6])
    """

    def _look(self, tensordict: TensorDictBase) -> TensorDictBase:
        base: Any = self.parent
        ego, vehicles = base.base_env.scene()
        route = tensordict.get("route").reshape(-1).to(vehicles.s.device)
        lane, own = lanes(vehicles.route, vehicles.s), lanes(route, vehicles.s)
        states, there = vehicle_states(vehicles, lane), vehicles.present.movedim(0, -1)
        _, _, seen = observe(ego, states, there, route, base.base_env.task.rows)
        first = has_priority(vehicles, lane, own, ego, torch.full_like(ego[:, 0], _LATE))
        scene = TensorDict(
            {
                "ego": ego.float(),
                "vehicles": torch.where(there[..., None], states, torch.nan).float(),
                "route": vehicles.route.movedim(0, -1),
                "priority": first.movedim(0, -1),
                "within_view": seen,
            },
            tensordict.batch_size,
        )
        return tensordict.set("scene", scene.to(tensordict.device) if tensordict.device else scene)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._look(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._look(next_tensordict)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        base: Any = self.parent
        count, shape = base.base_env.task.traffic.vehicles[1], observation_spec.shape
        observation_spec["scene"] = Composite(
            ego=Unbounded(shape=(*shape, 6)),
            vehicles=Unbounded(shape=(*shape, count, 6)),
            route=Categorical(16, shape=(*shape, count), dtype=torch.int64),
            priority=Binary(n=count, shape=(*shape, count), dtype=torch.bool),
            within_view=Binary(n=count, shape=(*shape, count), dtype=torch.bool),
            shape=shape,
        )
        return observation_spec
