"""Every decision of test episodes: what was there, what was thought of it, what was done."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from saferl.envs.intersection import Scenario
from saferl.envs.intersection.dynamics import to_physical
from saferl.envs.intersection.geometry import rectangle_distance
from saferl.envs.intersection.observation import as_world
from saferl.evaluation.play import play
from saferl.modules import BoundCritics, MMAMPolicyEncoder

#: The name of the file in the folder of a test.
TRACE = "trace.npz"
#: Rows that networks are asked about at once.
_AT_ONCE = 8192
#: Of the rows.
COLUMNS = (
    "ego", "vehicles", "vehicle_route", "observed", "priority", "attention", "nearest", "gap", "proposed", "executed",
    "intervened", "members", "members_executed", "risk", "risk_executed", "cost_share", "reward", "cost",
)  # fmt: skip
_READ = ("ego", "vehicles", "action", "scene")
_TOLD = ("scene", "reward", "cost", "action_executed", "intervened")


@dataclass(frozen=True)
class Trace:
    """Episodes, row by row; SI units, numpy arrays.

    Attributes:
        about: ``policy``, ``task``, ``dt`` (s between two rows), ``risk_limit`` (of ``risk``; None without cost critics)
            and whatever the test says of itself.
        episodes: arrays [E]: ``episode`` (number in the test), ``seed``, ``route``, ``outcome`` (``success``,
            ``hit_vehicle``, ``left_road`` or ``frozen``), and ``first`` [E + 1]: rows ``first[i]`` to ``first[i + 1]`` are of
            episode i, one for each decision and one for where it ended, in which what belongs to a decision is NaN or False.
        rows: arrays [R, ...] by name:

            - ``ego`` [6]: x, y (m; east and south of the middle of the junction), v_x, v_y (m/s; ahead and to the right of the
              body), phi (rad, clockwise from the east), omega (rad/s).
            - ``vehicles`` [N, 6]: the same of each other car, NaN while it is not on the road; ``vehicle_route`` [N] int8,
              ``4 * arm + k`` (:mod:`saferl.envs.intersection.roads`).
            - ``observed`` [N] bool: in the observation. ``priority`` [N] bool: goes before the ego by the rules of the road.
            - ``attention`` [N]: of the policy's ego-attention, mean of its heads; the rest to 1 is on the ego itself; all NaN where the policy has none.
            - ``nearest`` int16 and ``gap`` (m): the car whose body is nearest, and how far; -1 and NaN where there is none.
            - ``proposed`` and ``executed`` [2]: acceleration (m/s^2) and steering angle (rad) before and after the projector;
              ``intervened`` bool.
            - ``members`` and ``members_executed`` [n]: what each cost critic says of the two; ``risk`` and ``risk_executed``:
              what is compared with the limit. All NaN where the policy has none.
            - ``cost_share`` [N]: what the predicted collision with each car adds to the cost.
            - ``reward`` and ``cost``: of the decision.

            Of K costs ``members``, ``risk``, ``cost`` and ``about``'s ``risk_limit`` have one more dimension [K];
            :meth:`worst` has not.
    """

    about: Mapping[str, Any]
    episodes: Mapping[str, np.ndarray]
    rows: Mapping[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.episodes["episode"])

    def episode(self, index: int) -> dict[str, np.ndarray]:
        """The rows of one episode, by its place in :attr:`episodes`."""
        first = self.episodes["first"]
        return {k: v[first[index] : first[index + 1]] for k, v in self.rows.items()}

    def worst(self) -> Trace:
        """The trace with one risk: of several that which exceeds its limit most in each row, as if all had the least limit, and
        the sum of all costs; of one cost the same trace."""
        if self.rows["cost"].ndim == self.rows["risk"].ndim == 1:
            return self
        about, rows, given = dict(self.about), dict(self.rows), self.about["risk_limit"]
        if rows["cost"].ndim > 1:
            rows["cost"] = rows["cost"].sum(-1)
        for end in ("", "_executed"):  # a policy may know of other costs than a test counts
            if rows[f"risk{end}"].ndim > 1:
                limit = np.broadcast_to(
                    0.0 if given is None else given, rows[f"risk{end}"].shape[1:]
                )
                about["risk_limit"] = None if given is None else float(limit.min())
                risk = rows[f"risk{end}"] + (limit.min() - limit)
                which = np.nan_to_num(risk, nan=-np.inf).argmax(-1)[:, None]
                rows[f"risk{end}"] = np.take_along_axis(risk, which, -1)[:, 0]
                members = rows[f"members{end}"] + (limit.min() - limit)
                rows[f"members{end}"] = np.take_along_axis(members, which[:, None], -1)[..., 0]
        return replace(
            self, about=about, rows={k: v.astype(self.rows[k].dtype) for k, v in rows.items()}
        )

    def save(self, folder: Path) -> Path:
        """Write ``trace.npz`` into a folder: ``about`` as JSON, the arrays by name."""
        path = folder / TRACE
        folder.mkdir(parents=True, exist_ok=True)
        arrays: Any = {f"episode_{k}": v for k, v in self.episodes.items()} | dict(self.rows)
        np.savez_compressed(path, about=np.array(json.dumps(dict(self.about))), **arrays)
        return path

    @classmethod
    def load(cls, path: Path) -> Trace:
        """Read what :meth:`save` wrote.

        Args:
            path: the file, or its folder.

        Raises:
            ValueError: it is no trace.
        """
        path = path / TRACE if path.is_dir() else path
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            about = json.loads(str(arrays.pop("about")))
            names = [name for name in arrays if name.startswith("episode_")]
            episodes = {name.removeprefix("episode_"): arrays.pop(name) for name in names}
            if len(episodes["first"]) != len(episodes["episode"]) + 1:
                raise ValueError("its episodes are not whole")
            if missing := [name for name in COLUMNS if name not in arrays]:
                raise ValueError(f"it has no {missing[0]}")
            if any(len(array) != episodes["first"][-1] for array in arrays.values()):
                raise ValueError("its rows are not whole")
        except FileNotFoundError:
            raise
        except Exception as error:  # zipfile and numpy raise of every kind
            raise ValueError(f"{path} is no trace, or damaged: {error}.") from error
        return cls(about, episodes, arrays)


@torch.no_grad()
def record(
    policy: TensorDictModuleBase,
    env: EnvBase,
    rows: Sequence[Mapping[str, Any]],
    /,
    critics: TensorDictModuleBase | None = None,
    limit: float | Sequence[float] | None = None,
    **about: Any,
) -> Trace:
    """Play episodes of a test again and keep every decision.

    Args:
        policy: as the test played it.
        env: an intersection with :class:`~saferl.envs.intersection.true_scene.TrueScene` around it, and with the test's projector.
        rows: of the episodes that are wanted, as :func:`saferl.evaluation.play.evaluate` gives them.
        critics: a :class:`~saferl.modules.CriticEnsemble` of costs, or None.
        limit: of the risk, which is said in ``about``.
        **about: what else is said there.
    """
    width = env.batch_size[0]
    task = cast(Scenario, env.task)
    parts: list[Any] = []
    counts: list[int] = []
    for begin in range(0, len(rows), width):
        wanted = [row["seed"] for row in rows[begin : begin + width]]
        seeds = torch.tensor(wanted + wanted[-1:] * (width - len(wanted)), device=env.device)
        steps = [_kept(step) for step in play(policy, env, seeds)]
        alive = torch.stack([step["alive"] for step in steps])[:, : len(wanted)]
        counts += alive.sum(0).tolist()
        whole: Any = torch.stack(steps)  # pyright: ignore[reportArgumentType]
        parts.append(whole[:, : len(wanted)].transpose(0, 1)[alive.T].cpu())
    data: Any = torch.cat(parts)
    count = torch.tensor(counts)
    first = torch.cat([torch.zeros(1, dtype=torch.int64), (count + 1).cumsum(0)])
    # Where the decisions go, and the states after the last ones.
    place = torch.arange(len(data)) + torch.repeat_interleave(torch.arange(len(count)), count)
    ends = count.cumsum(0) - 1

    scene = TensorDict({}, [int(first[-1])])
    for key, value in data["scene"].items():
        whole = value.new_empty((len(scene), *value.shape[1:]))
        whole[place], whole[first[1:] - 1] = value, data["next", "scene", key][ends]
        scene[key] = whole
    found: dict[str, Tensor] = {
        "ego": scene["ego"],
        "vehicles": scene["vehicles"],
        "priority": scene["priority"],
    }
    found |= {"vehicle_route": scene["route"].to(torch.int8)} | _nearest(scene)
    for key, value in _decisions(policy, task, data, critics).items():
        missing = False if value.dtype == torch.bool else torch.nan
        whole = torch.full((len(scene), *value.shape[1:]), missing, dtype=value.dtype)
        whole[place] = value
        found[key] = whole
    episodes = {
        "episode": np.array([row["episode"] for row in rows]),
        "seed": np.array([row["seed"] for row in rows]),
        "route": np.array([row["route"] for row in rows]),
        "outcome": np.array([outcome(row) for row in rows]),
        "first": first.numpy(),
    }
    about |= {"dt": 1.0 / task.policy_frequency, "task": task.task, "scenario": task.scenario}
    about |= {"risk_limit": limit if critics is not None else None}
    arrays = {key: value.numpy() for key, value in found.items()}
    return Trace(about, episodes, arrays)


def outcome(row: Mapping[str, Any]) -> str:
    """How an episode of ``episodes.csv`` ended."""
    return next((k for k in ("success", "hit_vehicle", "left_road") if int(row[k])), "frozen")


def _kept(step: TensorDictBase) -> TensorDictBase:
    kept: Any = step.select(*_READ, "alive")
    return kept.set("next", step.get("next").select(*_TOLD, strict=False))


def _nearest(scene: TensorDictBase) -> dict[str, Tensor]:
    poses = [scene[key][..., [0, 1, 4]] for key in ("ego", "vehicles")]
    gaps = rectangle_distance(poses[0][:, None], poses[1]).nan_to_num(torch.inf)
    if not gaps.shape[1]:
        gaps = torch.full((len(gaps), 1), torch.inf)
    gap, nearest = gaps.min(1)
    there = gap.isfinite()
    return {
        "gap": torch.where(there, gap, torch.nan),
        "nearest": torch.where(there, nearest, -1).to(torch.int16),
    }


def _decisions(
    policy: TensorDictModuleBase,
    task: Scenario,
    data: Any,
    critics: TensorDictModuleBase | None,
) -> dict[str, Tensor]:
    """What belongs to decisions [D, ...]."""
    action, after = data["action"].float(), data["next"]
    executed = after.get("action_executed", action).float()
    control = to_physical(executed)
    # Which car stands in which row of the observation: the one that is nearest to where the row says it is.
    own, table = as_world(data["ego"], data["vehicles"])
    there = table[..., 0] > 0.5
    ego, others = data["scene", "ego"], data["scene", "vehicles"]
    offset = (table[..., 1:3] + own[:, None, 1:3])[:, :, None] - others[:, None, :, :2]
    apart = offset.norm(dim=-1).nan_to_num(torch.inf)
    cars = others.shape[1]
    of_row = apart.argmin(-1) if cars else torch.zeros_like(there, dtype=torch.int64)
    of_row = torch.where(there, of_row, cars)  # one more car, which is dropped
    observed = torch.zeros(len(data), cars + 1, dtype=torch.bool).scatter(1, of_row, True)[:, :cars]
    found = {
        "proposed": to_physical(action),
        "executed": control,
        "intervened": after["intervened"].squeeze(-1)
        if "intervened" in after
        else torch.zeros(len(data), dtype=torch.bool),
        "observed": observed,
        "cost_share": task.cost.shares(
            ego, control, others.nan_to_num(0.0), data["scene", "within_view"]
        ),
        "reward": after["reward"].float().squeeze(-1),
        "cost": after["cost"].float().squeeze(-1),
    }
    looking = next((m for m in policy.modules() if isinstance(m, MMAMPolicyEncoder)), None)
    weights = torch.full((len(data), cars), torch.nan)
    if looking is not None:
        each = [
            looking.attention(part["ego"], part["vehicles"]).mean(-2)[:, 1:].cpu()
            for part in data.to(next(looking.parameters()).device).split(_AT_ONCE)
        ]
        weights = torch.zeros(len(data), cars + 1).scatter(1, of_row, torch.cat(each))[:, :cars]
    return found | {"attention": weights} | _risks(critics, data, action, executed)


def _risks(
    critics: TensorDictModuleBase | None, data: TensorDictBase, proposed: Tensor, executed: Tensor
) -> dict[str, Tensor]:
    names = {"": proposed, "_executed": executed}
    if critics is None:
        nothing = {"risk": torch.full((len(data),), torch.nan)}
        nothing["members"] = nothing["risk"][:, None]
        return {name + end: value for name, value in nothing.items() for end in names}
    parameter = next(critics.parameters(), None)
    device = torch.device("cpu") if parameter is None else parameter.device
    found: dict[str, list[Tensor]] = {}
    for rows in torch.arange(len(data)).split(_AT_ONCE):
        bound: BoundCritics = critics.bind(data[rows].to(device))  # pyright: ignore
        for end, action in names.items():
            mine = action[rows].to(device)
            members = bound.values(mine).unflatten(-1, (bound.costs, -1)).mean(-1)  # of quantiles
            members = members.transpose(0, 1).squeeze(-1)
            found.setdefault(f"members{end}", []).append(members.cpu())
            found.setdefault(f"risk{end}", []).append(bound(mine).squeeze(-1).cpu())
    return {name: torch.cat(values) for name, values in found.items()}
