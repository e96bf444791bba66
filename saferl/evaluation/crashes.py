"""Why test episodes ended in a crash: with whom, whose turn it was, who warned when, and what would have helped."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from saferl.envs.intersection import BatchedIntersection, Scenario
from saferl.envs.intersection.drivers import CautiousDriver, Driver
from saferl.envs.intersection.dynamics import ACTION_SCALE
from saferl.envs.intersection.episode import WORDS
from saferl.evaluation.play import play
from saferl.evaluation.trace import Trace

#: Seconds before a crash from which another driver takes over.
MOMENTS = tuple(0.5 * k for k in range(1, 11))
#: How long before a crash a warning is looked for, and how long after it nobody may have crashed, s.
BEFORE, AFTER = 5.0, 5.0
_AT_ONCE = 630  # episodes
#: Of :func:`explain`.
COLUMNS: tuple[str, ...] = (
    "episode", "seed", "task", "what", "car", "time", "speed", "car_speed", "priority", "warning", "corrected", "braking",
    "cautious",
)  # fmt: skip
_FROM = ("from behind", "from the left", "oncoming", "from the right")
_WAY = ("turning left", "straight on", "straight on", "turning right")


def way(route: int) -> str:
    """The route of a car in words, as the ego sees it.

    >>> way(4 * 3 + 1), way(4 * 2)
    ('from the right, straight on', 'oncoming, turning left')
    """
    return f"{_FROM[route // 4]}, {_WAY[route % 4]}"


class _TakesOver(TensorDictModuleBase):
    """Plays recorded actions [B, T, 2] up to the decisions ``until`` [B], then drives by itself: braking along the lane, or as
    the cautious driver where ``cautious`` [B]."""

    def __init__(self, actions: Tensor, until: Tensor, cautious: Tensor):
        super().__init__()
        self.in_keys, self.out_keys = ["ego", "vehicles", "route"], ["action"]
        self.actions, self.until, self.cautious = actions, until, cautious
        self.brake, self.careful, self.time = Driver(speed=0.0), CautiousDriver(), 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = self.actions[:, min(self.time, self.actions.shape[1] - 1)].clone()
        over = self.time >= self.until
        for driver, rows in (
            (self.brake, over & ~self.cautious),
            (self.careful, over & self.cautious),
        ):
            if rows.any():
                action[rows] = driver(tensordict.select(*self.in_keys)[rows])["action"]
        self.time += 1
        return tensordict.set("action", action)


def _crash(
    scenario: Scenario, seeds: Tensor, actions: Tensor, until: Tensor, cautious: Tensor
) -> Tensor:
    """The decision in which a crash comes in each episode [B] where another driver takes over at ``until``, counted from 1,
    and 0 where none comes as far as is looked."""
    longest = actions.shape[1] / scenario.policy_frequency + AFTER
    scenario = dataclasses.replace(scenario, duration=min(scenario.duration, longest))
    ends = []
    for rows in torch.arange(len(seeds)).split(_AT_ONCE):
        env = BatchedIntersection(scenario, num_envs=len(rows))
        policy = _TakesOver(actions[rows], until[rows], cautious[rows])
        steps = play(policy, env, seeds[rows])
        crashed = torch.stack(
            [step["next", "collision"] | step["next", "offroad"] for step in steps]
        )
        alive = torch.stack([step["alive"] for step in steps])
        ends.append(torch.where((crashed.squeeze(-1) & alive).any(0), alive.sum(0), 0))
    return torch.cat(ends)


def explain(trace: Trace, scenario: Scenario) -> list[dict[str, Any]]:
    """A row for each crash of a trace.

    Args:
        trace: of a test.
        scenario: of the test.

    Returns:
        ``episode``, ``seed``, ``task`` (of the ego, in words), ``what`` (the car's way in words, or "off the road"), ``car`` (its
        number), ``time`` (s), ``speed`` and ``car_speed`` (m/s), ``priority`` ("car" or "ego", by the rules of the road);
        ``warning``: how many seconds before the crash, at most 5, the risk of what the policy proposed was first above
        the limit; ``corrected``: the share of the decisions from then on that the projector changed; ``braking`` and
        ``cautious``: how many seconds before the crash, at most 5, the last moment lay from which braking along the lane, or the
        cautious driver, would have come without a crash to 5 s after the last of these crashes, in the batched simulator. None where there is none. A replay that does not end
        in the same decision by itself, as of an episode with SUMO's drivers, has neither.
    """
    dt, limit = trace.about["dt"], trace.about.get("risk_limit")
    kinds = trace.episodes["outcome"]
    crashes = [i for i, kind in enumerate(kinds) if kind in ("hit_vehicle", "left_road")]
    found, actions = [], []
    for index in crashes:
        rows = trace.episode(index)
        last = len(rows["ego"]) - 1
        ego, car = rows["ego"][last], int(rows["nearest"][last])
        hit = kinds[index] == "hit_vehicle" and car >= 0
        row = {
            "episode": int(trace.episodes["episode"][index]),
            "seed": int(trace.episodes["seed"][index]),
            "task": WORDS[str(trace.episodes["route"][index])],
            "what": way(int(rows["vehicle_route"][last, car])) if hit else "off the road",
            "car": car if hit else None,
            "time": round(last * dt, 3),
            "speed": round(float(np.hypot(ego[2], ego[3])), 3),
            "car_speed": round(float(rows["vehicles"][last, car, 2]), 3) if hit else None,
            "priority": ("car" if rows["priority"][last, car] else "ego") if hit else None,
            "warning": None,
            "corrected": None,
        }
        begin = max(0, last - round(BEFORE / dt))
        if limit is not None:
            above = np.flatnonzero(rows["risk"][begin:last] > limit)
            if len(above):
                row["warning"] = round((last - begin - above[0]) * dt, 3)
                corrected = rows["intervened"][begin + above[0] : last].mean()
                row["corrected"] = round(float(corrected), 3)
        found.append(row)
        actions.append(rows["executed"][:last] / np.array(ACTION_SCALE, dtype=np.float32))
    for row, saved in zip(found, _saved(scenario, found, actions, dt), strict=True):
        row |= saved
    return found


def _saved(
    scenario: Scenario,
    crashes: Sequence[Mapping[str, Any]],
    actions: Sequence[np.ndarray],
    dt: float,
) -> list[dict[str, float | None]]:
    """``braking`` and ``cautious`` of each crash."""
    if not crashes:
        return []
    longest = max(map(len, actions))
    played = torch.zeros(len(crashes), longest, 2)
    for index, each in enumerate(actions):
        played[index, : len(each)] = torch.from_numpy(each)
    length = torch.tensor([len(each) for each in actions])
    # First nobody takes over, then each driver at each moment.
    back = torch.tensor([0.0, *MOMENTS, *MOMENTS])
    until = length[:, None] - (back / dt).round().long()
    until[:, 0] = longest + 1
    cautious = torch.arange(len(back)) > len(MOMENTS)
    variants = len(back)
    seeds = torch.tensor([row["seed"] for row in crashes])
    crash = _crash(
        scenario,
        seeds.repeat_interleave(variants),
        played.repeat_interleave(variants, 0),
        until.flatten(),
        cautious.repeat(len(crashes)),
    ).reshape(len(crashes), variants)
    possible = (until >= 0) & (crash[:, :1] == length[:, None])
    results = []
    for alive in ((crash == 0) & possible).tolist():
        by = {"braking": alive[1 : len(MOMENTS) + 1], "cautious": alive[len(MOMENTS) + 1 :]}
        results.append(
            {
                name: next((t for t, good in zip(MOMENTS, saved, strict=True) if good), None)
                for name, saved in by.items()
            }
        )
    return results


def table(crashes: Sequence[Mapping[str, Any]], episodes: int) -> str:
    """The crashes of a test counted: a line for each way of the ego and of what it met."""
    if not crashes:
        return f"No crash in {episodes} episodes."
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in crashes:
        groups.setdefault((row["task"], row["what"]), []).append(row)
    lines = [
        f"{len(crashes)} crashes in {episodes} episodes; seconds before the crash are medians",
        f"{'ego':<30} {'met':<30} {'crashes':>7} {'ego first':>9} {'warned':>13} {'braking helps':>14} {'cautious helps':>14}",
    ]

    def median(rows: Sequence[Mapping[str, Any]], key: str) -> str:
        values = [row[key] for row in rows if row[key] is not None]
        return f"{len(values)}, {np.median(values):.1f} s" if values else "0"

    every = (("all", ""), list(crashes))
    for (task, what), rows in [
        *sorted(groups.items(), key=lambda item: (-len(item[1]), item[0])),
        *([every] if len(groups) > 1 else []),
    ]:
        first = sum(row["priority"] == "ego" for row in rows)
        lines.append(
            f"{task:<30} {what:<30} {len(rows):>7} {first:>9} {median(rows, 'warning'):>13} "
            f"{median(rows, 'braking'):>14} {median(rows, 'cautious'):>14}"
        )
    return "\n".join(lines)
