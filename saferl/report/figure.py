"""The learning curves drawn."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import EngFormatter, PercentFormatter

from saferl.envs.intersection.scene import EGO, INK, OTHERS
from saferl.evaluation.statistics import WINDOW
from saferl.report.curves import OF_COSTS, Curve
from saferl.report.systems import LABELS

_TITLES = {
    "collision_rate": "collision rate",
    "frozen_rate": "frozen rate",
    "success_rate": "success rate",
    "return": "return",
    "cost_return": "cost of an episode",
    "lagrange_multiplier": "Lagrange multiplier",
    "intervention_rate": "interventions of the projector",
}
#: Each system keeps its colour, whoever stands beside it; the drivers, which learn nothing, need none.
_COLOURS = dict(zip(list(LABELS)[2:-1], OTHERS, strict=False)) | {"arsac": EGO}
_FREE = OTHERS[len(_COLOURS) - 1 :]


def _title(name: str) -> str:
    """What heads a panel; of several costs with the cost's name."""
    figure = next(key for key in (name, *OF_COSTS) if key in _TITLES and name.startswith(key))
    return f"{_TITLES[figure]}{name.removeprefix(figure).replace('_', ': ', 1)}"


def colours(names: list[str]) -> dict[str, str]:
    """A colour for each system, any two of them apart for all kinds of colour vision.

    >>> colours(["sac", "mine"])["sac"] == colours(["sac", "arsac"])["sac"]
    True
    """
    others = [name for name in names if name not in _COLOURS]
    free = {name: _FREE[index % len(_FREE)] for index, name in enumerate(others)}
    return {name: _COLOURS.get(name) or free[name] for name in names}


def draw(curves: Mapping[str, Mapping[str, Curve]], shaped: list[str], out: Path) -> list[Path]:
    """Write ``curves.png`` and ``curves.pdf``: a panel for each figure, a line and a band for each system.

    Args:
        curves: by figure and system.
        shaped: labels of systems whose return in training holds r_safe.
        out: folder.
    """
    order = [*LABELS, *(name for panel in curves.values() for name in panel)]
    names = sorted({name for panel in curves.values() for name in panel}, key=order.index)
    colour = colours(names)
    rows = -(-len(curves) // 3)
    figure, grid = plt.subplots(
        rows, 3, figsize=(11, 2.9 * rows + 0.8), layout="constrained", squeeze=False
    )
    for axes, (name, panel) in zip(grid.flat, curves.items(), strict=False):
        for system in names:
            if (curve := panel.get(system)) is not None:
                thick = 2.2 if system == "arsac" else 1.4
                above = 3 if system == "arsac" else 2
                axes.plot(
                    curve.frames, curve.mean, color=colour[system], lw=thick, zorder=above,
                    label=LABELS.get(system, system),
                )  # fmt: skip
                axes.fill_between(
                    curve.frames, curve.low, curve.high, color=colour[system], alpha=0.13, lw=0
                )
        title = _title(name)
        if name == "return" and shaped:
            title += f" (with r_safe: {', '.join(shaped)})"
        axes.set_title(title, fontsize=10, color=INK)
        # Bands of few seeds would squeeze the lines.
        means = [curve.mean for curve in panel.values()]
        low, high = min(map(np.min, means)), max(map(np.max, means))
        room = 0.15 * (high - low or 1.0)
        low, high = low - room, high + room
        if name.endswith("_rate"):
            axes.yaxis.set_major_formatter(PercentFormatter(1.0))
            high = min(high, 1.02)
            low = max(low, -0.02 * high)
        axes.set_ylim(low, high)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.grid(color="#e5e5e5", lw=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
        mean = f"of {WINDOW} episodes"
        if name.startswith("lagrange_multiplier") or name == "intervention_rate":
            mean = "since the last record"
        axes.set_ylabel(f"mean {mean}", fontsize=8)
        axes.set_xlabel("frames", fontsize=8)
    for axes in list(grid.flat)[len(curves) :]:
        axes.set_visible(False)
    handles = {line.get_label(): line for axes in grid.flat for line in axes.get_lines()}
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=min(5, len(handles) or 1),
        frameon=False, fontsize=9,
    )  # fmt: skip
    paths = [out / "curves.png", out / "curves.pdf"]
    for path in paths:
        figure.savefig(path, dpi=150)
    plt.close(figure)
    return paths
