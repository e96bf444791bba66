"""Why test episodes ended in a crash: with whom, whose turn it was, who warned when, and what would have helped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from saferl.envs.intersection import BatchedIntersection, Scenario
from saferl.envs.intersection.batched import State
from saferl.envs.intersection.drivers import Brake, CautiousDriver
from saferl.envs.intersection.dynamics import ACTION_SCALE
from saferl.envs.intersection.episode import WORDS
from saferl.envs.intersection.foresight import Simulator, safe_for
from saferl.evaluation.trace import Trace

#: Seconds before a crash from which another driver takes over.
MOMENTS = tuple(0.5 * k for k in range(1, 11))
#: How long before a crash a warning is looked for, and how long after its time nobody may have crashed, s.
BEFORE, AFTER = 5.0, 5.0
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
        cautious driver who sees all cars, would have come without a crash for 10 s, in the batched simulator. None where there is
        none. A replay that does not end in the same decision by itself, as of an episode with SUMO's drivers, has neither.
    """
    trace = trace.worst()
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
    length = torch.tensor([len(each) for each in actions])
    until = length[:, None] - (torch.tensor(MOMENTS) / dt).round().long()
    scenes, crashed = _scenes(scenario, [row["seed"] for row in crashes], actions, until)
    prediction, horizon = Simulator(patience=AFTER), BEFORE + AFTER
    lasts = torch.stack(
        [safe_for(prediction, scenario, scenes, d, horizon) for d in (Brake(), CautiousDriver())]
    )
    helps = lasts.isinf().reshape(2, *until.shape) & (until >= 0) & (crashed == length)[:, None]
    return [
        {
            name: next((t for t, good in zip(MOMENTS, saved, strict=True) if good), None)
            for name, saved in zip(("braking", "cautious"), each, strict=True)
        }
        for each in helps.movedim(1, 0).tolist()
    ]


def _scenes(
    scenario: Scenario, seeds: Sequence[int], actions: Sequence[np.ndarray], until: Tensor
) -> tuple[State, Tensor]:
    """Play recorded actions again: the scenes before the decisions ``until`` [C, M], [C * M] crash by crash, and the
    decision in which each of C episodes now crashes [C], counted from 1; 0 where none does."""
    length = torch.tensor([len(each) for each in actions])
    env = BatchedIntersection(scenario, num_envs=len(seeds))
    tensordict = env.reset(seeds=torch.tensor(seeds))
    scenes = {
        key: value[:, None].repeat(1, until.shape[1], *[1] * (value.ndim - 1))
        for key, value in env.state.items()
    }
    crashed = torch.zeros_like(length)
    for number in range(int(length.max())):
        crash, moment = (until == number).nonzero(as_tuple=True)
        for key, value in env.state.items():
            scenes[key][crash, moment] = value[crash]
        action = np.stack([each[min(number, len(each) - 1)] for each in actions])
        after = env.step(tensordict.set("action", torch.from_numpy(action)))["next"]
        ends = (after["collision"] | after["offroad"]).squeeze(-1)
        crashed = torch.where((crashed == 0) & ends, number + 1, crashed)
    return {key: value.flatten(0, 1) for key, value in scenes.items()}, crashed


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
