"""Return against cost over fixed multipliers, and where a learned one stands among them."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from saferl.evaluation.compare import TESTED, finished


class MultiplierProfile(Callback):
    """Hydra's callback that draws the profile of all runs of a sweep, and says what it shows."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        folder = Path(config.hydra.sweep.dir)
        found = points(folder)
        if len(found) > 1:
            print(tell(found))
            print(draw(found, folder))


@dataclass(frozen=True)
class Point:
    """The closing test of a run.

    Attributes:
        lagrange: ``fixed``, or what the multiplier is moved by.
        multiplier: lambda at the end, reward per cost.
        cost, gain: mean cost and return of an episode, and the ends of their 95% intervals.
        limit: on the mean cost; None where there is none.
        start: lambda at the start.
        seed: of the run.
    """

    lagrange: str
    multiplier: float
    cost: tuple[float, float, float]
    gain: tuple[float, float, float]
    limit: float | None
    start: float
    seed: int

    @property
    def fixed(self) -> bool:
        return self.lagrange == "fixed"


def points(folder: Path) -> list[Point]:
    """Every finished run below a folder that has a multiplier of one constraint, in the order of the multipliers."""
    found = []
    for test in folder.glob(f"**/{TESTED}"):
        for config, figures in finished([test.parents[1]]):
            lagrange = config["lagrange"]
            start = lagrange["multiplier"].get("init")
            if not isinstance(start, float | int) or "cost_return" not in figures:
                continue
            moved = lagrange["signal"]["_target_"] is not None
            kind = lagrange["multiplier"]["_target_"].rpartition(".")[2] if moved else "fixed"
            last = _last_multiplier(test.parents[1] / "metrics.csv") if moved else start
            cost, gain = (_interval(figures[key]) for key in ("cost_return", "return"))
            limit, seed = config["cost_limit"], config["seed"]
            found.append(Point(kind, last, cost, gain, limit, start, seed))
    return sorted(found, key=lambda point: (not point.fixed, point.multiplier))


def _interval(figure: Mapping[str, float | None]) -> tuple[float, float, float]:
    """The mean and the ends of its interval; of one episode there is none."""
    mean, *ends = (figure[name] for name in ("mean", "low", "high"))
    low, high = (mean if end is None else end for end in ends)
    return mean, low, high  # pyright: ignore[reportReturnType]


def _last_multiplier(path: Path) -> float:
    with path.open(newline="") as file:
        return [float(row["lagrange_multiplier"]) for row in csv.DictReader(file)][-1]


def profile(found: Sequence[Point]) -> np.ndarray:
    """Multiplier, mean cost and mean return of the fixed ones [n, 3], seeds taken together, costs ascending."""
    groups: dict[float, list[Point]] = {}
    for point in found:
        if point.fixed:
            groups.setdefault(point.multiplier, []).append(point)
    rows = [
        (multiplier, np.mean([p.cost[0] for p in group]), np.mean([p.gain[0] for p in group]))
        for multiplier, group in groups.items()
    ]
    return np.array(sorted(rows, key=lambda row: row[1])).reshape(-1, 3)


def tell(found: Sequence[Point]) -> str:
    """What a profile says: where the limit lies on it, and how far from it each learned multiplier ended.

    Between two of its points lines are drawn: of the return over the cost, of log lambda over the cost.
    """
    curve, lines = profile(found), []
    multiplier, cost, gain = curve.T

    def at(price: float) -> tuple[float, float]:
        logs = np.log(np.maximum(multiplier, 1e-12))
        return float(np.exp(np.interp(price, cost, logs))), float(np.interp(price, cost, gain))

    def within(price: float) -> bool:
        return len(curve) > 1 and cost[0] <= price <= cost[-1]

    for limit in dict.fromkeys(point.limit for point in found if point.limit is not None):
        where = "lies beyond all fixed multipliers"
        if within(limit):
            where = "is met by a multiplier of {:.3g}, with a return of {:.4g}".format(*at(limit))
        lines.append(f"cost_limit={limit:g} {where}.")
    for point in (point for point in found if not point.fixed):
        line = (
            f"{point.lagrange} from {point.start:g} (seed {point.seed}) ends at {point.multiplier:.3g}: cost "
            f"{point.cost[0]:.4g}, return {point.gain[0]:.4g}"
        )
        if within(point.cost[0]):
            price, earned = at(point.cost[0])
            line += f"; at this cost a fixed one is {price:.3g} and earns {earned:.4g}"
        lines.append(f"{line}.")
    return "\n".join(lines)


def draw(found: Sequence[Point], out: Path) -> Path:
    """Write ``profile.csv``, a row for each run, and ``profile.png``; returns the figure's path."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from saferl.envs.intersection.scene import EGO, INK, OTHERS

    with (out / "profile.csv").open("w", newline="") as file:
        rows = [asdict(point) for point in found]
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    curve = profile(found)
    axes.plot(curve[:, 1], curve[:, 2], color=OTHERS[0], lw=1.2, zorder=1)
    for kind, colour, marker in (("fixed", OTHERS[0], "o"), ("learned", EGO, "*")):
        chosen = [point for point in found if point.fixed == (kind == "fixed")]
        ends = np.array([[*point.cost, *point.gain] for point in chosen]).reshape(-1, 6)
        cost, low, high, gain, worst, best = ends.T
        axes.errorbar(
            cost, gain, [gain - worst, best - gain], [cost - low, high - cost], fmt=marker, color=colour,
            ms=13 if kind == "learned" else 6, mec="white", elinewidth=0.7, zorder=3 if kind == "learned" else 2,
            label=f"{kind} multiplier",
        )  # fmt: skip
    for multiplier, cost, gain in curve:
        axes.annotate(f"{multiplier:g}", (cost, gain), (4, -12), textcoords="offset points", fontsize=8, color=INK)  # fmt: skip
    for limit in dict.fromkeys(point.limit for point in found if point.limit is not None):
        axes.axvline(limit, color=INK, lw=0.9, ls="--", zorder=0, label=f"limit {limit:g}")
    axes.set_xlabel("mean cost of a test episode")
    axes.set_ylabel("mean return")
    axes.grid(color="#e5e5e5", lw=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=9)
    path = out / "profile.png"
    figure.savefig(path, dpi=150)
    plt.close(figure)
    return path
