# TorchRL's specs take tuples that their annotations do not name.
# pyright: reportArgumentType=false
"""What the backends of the intersection share: specs, seeds, replay."""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded

from saferl.envs.intersection.geometry import ROUTES
from saferl.envs.intersection.roads import lanes
from saferl.envs.intersection.scenario import Scenario
from saferl.envs.intersection.traffic import Vehicles, vehicle_states
from saferl.envs.seeding import ReplayedEnv, SeededEnv

OUTCOMES = ("collision", "offroad", "success")


class IntersectionBase(SeededEnv):
    """Specs and seeding of the intersection; subclasses drive it.

    Reads ``action`` [B, 2] in [-1, 1]: a_x / 5 m/s^2, delta_f / 0.6 rad. Writes ``ego`` [B, F] and
    ``vehicles`` [B, M, G] (:func:`observe`), ``route`` [B, 1] int64, the outcomes ``collision``,
    ``offroad``, ``success`` [B, 1] bool, ``reward`` [B, 1] and ``cost`` [B, K].
    """

    def __init__(self, task: Scenario, num_envs: int, seed: int | None, device=None):
        super().__init__(task, num_envs, device)
        self._make_specs()
        self.set_seed(seed)

    def _make_specs(self) -> None:
        batch, form = self.batch_size, self.task.form
        flag = Binary(n=1, shape=(*batch, 1), dtype=torch.bool)
        self.observation_spec = Composite(
            ego=Unbounded(shape=(*batch, len(form.ego))),
            vehicles=Unbounded(shape=(*batch, self.task.rows, len(form.vehicle))),
            route=Categorical(len(ROUTES), shape=(*batch, 1), dtype=torch.int64),
            **{name: flag.clone() for name in OUTCOMES},
            shape=batch,
        )
        self.action_spec = Bounded(-1.0, 1.0, shape=(*batch, 2))
        self._make_ends()

    def _output(self, values: dict[str, Tensor]) -> TensorDict:
        """Shape [B] tensors to the specs' [B, 1]."""
        out = {
            key: value if key in ("ego", "vehicles") else value.reshape(*self.batch_size, -1)
            for key, value in values.items()
        }
        return TensorDict(self._reals(out), batch_size=self.batch_size, device=self.device)

    def scene(self) -> tuple[Tensor, Vehicles]:
        """The true states of the egos [B, 6], and the surrounding vehicles [N, B], seen or not."""
        raise NotImplementedError

    def snapshot(self, index: int | slice) -> tuple[np.ndarray, np.ndarray]:
        """States of the ego [6] and of the others [N, 6] of one environment, float64; of a slice of K
        environments [K, 6] and [K, N, 6].

        Row k is vehicle k for the whole episode, and NaN while it is off the road.
        """
        ego, vehicles = self.scene()
        others = vehicle_states(vehicles, lanes(vehicles.route, vehicles.s))
        others = torch.where(vehicles.present.movedim(0, -1)[..., None], others, torch.nan)
        return ego[index].double().cpu().numpy(), others[index].double().cpu().numpy()

    def render(self, index: int) -> np.ndarray | None:
        """A picture [H, W, 3] uint8 of one environment, or None where a backend draws none."""
        return None


class ReplayedIntersection(ReplayedEnv, IntersectionBase):
    """An intersection whose state is the seeds and actions of its episodes; what it shows is kept by the specs' keys."""

    def _stack(self, ended: bool) -> TensorDict:
        keys = ("ego", "vehicles", "route", *OUTCOMES)
        if ended:
            keys += ("reward", "cost", "terminated", "truncated", "done")
        rows = {key: [torch.as_tensor(last[key]) for last in self._last] for key in keys}
        return self._output({k: torch.stack(v).to(self.device or "cpu") for k, v in rows.items()})
