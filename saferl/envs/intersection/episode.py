"""What happened in an episode, recorded for pictures of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from saferl.envs.intersection.geometry import (
    LENGTH,
    ROUTES,
    WIDTH,
    corners,
    on_pavement,
    overlap,
)
from saferl.envs.intersection.reward import Reward

#: Routes as they are told to people.
WORDS = {
    "lt": "left turn",
    "gs_inner": "straight on in the inner lane",
    "gs_outer": "straight on in the outer lane",
    "rt": "right turn",
}
#: Which end is which outcome; of two the later one counts.
OUTCOMES = {"success": "success", "offroad": "left_road", "collision": "hit_vehicle"}


@dataclass
class Episode:
    """What happened in one episode, decision by decision.

    Attributes:
        seed, route: which episode.
        dt: seconds between decisions.
        outcome: ``success``, ``hit_vehicle``, ``left_road`` or ``frozen``, as in ``episodes.csv``.
        number: of the episode in its test, if it is of one.
        policy: who drives.
        reference: speed that the reward asks for, m/s.
        ego: states [6], one more than decisions. others: states [N, 6] likewise, row k of vehicle k
            and NaN while it is not on the road.
        corrected: whether the projector changed the action of each decision.
    """

    seed: int
    route: str
    dt: float
    outcome: str = "frozen"
    number: int | None = None
    policy: str = ""
    reference: float = Reward.speed
    ego: list[np.ndarray] = field(default_factory=list)
    others: list[np.ndarray] = field(default_factory=list)
    corrected: list[bool] = field(default_factory=list)

    @property
    def time(self) -> np.ndarray:
        """Time of each state [decisions + 1], s."""
        return np.arange(len(self.ego)) * self.dt

    @property
    def speed(self) -> np.ndarray:
        """Speed of the ego [decisions + 1], m/s."""
        ego = np.stack(self.ego)
        return np.hypot(ego[:, 2], ego[:, 3])

    @cached_property
    def crash(self) -> tuple[np.ndarray, int | None] | None:
        """Where it ended in a crash [2], m, and the number of the vehicle that was hit, if one was."""
        pose = torch.from_numpy(self.ego[-1])[[0, 1, 4]]
        outline = corners(pose, LENGTH, WIDTH)
        if self.outcome == "left_road":
            return outline[~on_pavement(outline)].mean(0).numpy(), None
        if self.outcome != "hit_vehicle":
            return None
        others = torch.from_numpy(self.others[-1])[:, [0, 1, 4]]
        apart = (others - pose)[:, :2].norm(dim=-1)
        hit = apart.isfinite() & overlap(pose, others, scale=1.01)
        number = int(torch.where(hit, apart, torch.inf).argmin())
        # The middle of what both cars cover, on a grid of small squares of the ego.
        left, _, right, back = outline
        part = torch.linspace(0, 1, 31, dtype=pose.dtype)[:, None]
        grid = (back + part * (left - back))[:, None] + part * (right - back)
        squares = torch.cat([grid.flatten(0, 1), pose[2:].expand(31 * 31, 1)], -1)
        both = overlap(squares, others[number], size_a=(0.2, 0.2))
        return squares[both, :2].mean(0).numpy(), number

    @property
    def event(self) -> str:
        """What happened when, in words."""
        end = f"at {self.time[-1]:.1f} s"
        if self.crash is None:
            return f"arrives {end}" if self.outcome == "success" else f"still on the road {end}"
        number = self.crash[1]
        return f"leaves the road {end}" if number is None else f"hits car {number} {end}"

    @property
    def title(self) -> str:
        """What a picture is headed with."""
        name = f"Seed {self.seed}" if self.number is None else f"Episode {self.number}"
        return f"{name}: {self.event}"

    @property
    def about(self) -> str:
        """Who drives where, in words."""
        who = [self.policy] if self.policy else []
        return ", ".join([*who, WORDS[self.route], f"seed {self.seed}"])


@torch.no_grad()
def record(
    policy: TensorDictModuleBase, env: EnvBase, seeds: Sequence[int], name: str = ""
) -> list[Episode]:
    """Play these episodes side by side with the policy's mean action.

    Args:
        policy: reads observations, writes ``action``.
        env: on either backend, of the batch size [B].
        seeds: B of them.
        name: what to call the policy.

    Raises:
        ValueError: another number of seeds.
    """
    if env.batch_size != torch.Size([len(seeds)]):
        raise ValueError(
            f"record needs num_envs={len(seeds)}, got batch size {tuple(env.batch_size)}."
        )
    base: Any = env.base_env if isinstance(env, TransformedEnv) else env
    tensordict = env.reset(seeds=torch.tensor(seeds, device=env.device))
    dt, reference = 1.0 / base.task.policy_frequency, base.task.reward.speed
    episodes = [
        Episode(seed, ROUTES[route], dt, policy=name, reference=reference)
        for seed, route in zip(seeds, tensordict["route"].flatten().tolist(), strict=True)
    ]
    going = dict(enumerate(episodes))

    def look() -> None:
        ego, others = base.snapshot(slice(None))
        for index, episode in going.items():
            episode.ego.append(ego[index])
            episode.others.append(others[index])

    look()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        while going:
            tensordict = env.step(policy(tensordict))
            look()
            after = tensordict["next"]
            corrected = after.get("intervened", torch.zeros_like(after["done"]))
            for index, episode in [*going.items()]:
                episode.corrected.append(bool(corrected[index]))
                if after["done"][index]:
                    for key, outcome in OUTCOMES.items():
                        if after[key][index]:
                            episode.outcome = outcome
                    del going[index]
            tensordict = env.step_mdp(tensordict)
    return episodes
