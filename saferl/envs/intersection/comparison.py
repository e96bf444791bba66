"""Several policies in the same traffic, side by side: the paper's figure of compared slices."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from saferl.envs.intersection.episode import WORDS, Episode
from saferl.envs.intersection.geometry import HALF_BOX
from saferl.envs.intersection.scene import (
    draw_compass,
    draw_reference,
    draw_road,
    draw_star,
    draw_ways,
    write_times,
)

#: Of the first policy, the second, ...; and of everybody else's cars.
POLICIES = (
    "#d55e00", "#009e73", "#882255", "#332288", "#b8860b", "#1a1a1a", "#cc79a7", "#8c4d47",
)  # fmt: skip
TRAFFIC = "#56a0d3"
VIEW = 30.0  # m shown to either side of the middle
_COLUMNS = 5
# Inches: heading, side of a panel, words above it, the plot.
_HEAD, _PANEL, _WORDS, _PLOT = 0.3, 2.7, 0.5, 2.6


def save_comparison(episodes: Mapping[str, Episode], path: Path) -> Path:
    """Trajectories of each policy in a panel of its own, and their speeds inside the box in one plot below.

    The cars stand where they were at the same seconds in every panel.

    Args:
        episodes: by the names of the policies, all of one seed.
        path: its ending says how: ``.png``, ``.pdf``, ``.svg``.

    Raises:
        ValueError: no episode, or episodes of several seeds.
    """
    if not episodes:
        raise ValueError("save_comparison needs at least one episode, got none.")
    first = next(iter(episodes.values()))
    for name, episode in episodes.items():
        if (episode.seed, episode.route) != (first.seed, first.route):
            raise ValueError(
                f"episodes must be of one seed and route, got {first.seed}, {first.route} and "
                f"{episode.seed}, {episode.route} ({name})."
            )
    columns = min(len(episodes), _COLUMNS)
    rows = -(-len(episodes) // columns)
    heights = (_HEAD, rows * (_PANEL + _WORDS), _PLOT)
    figure = plt.figure(figsize=(max(columns, 3) * _PANEL, sum(heights)), layout="constrained")
    head, above, below = np.asarray(figure.subfigures(3, 1, height_ratios=heights))
    panels = above.subplots(rows, columns, squeeze=False).flatten()
    for index, axes in enumerate(panels):
        if index < len(episodes):
            name = [*episodes][index]
            _panel(axes, name, episodes[name], POLICIES[index % len(POLICIES)])
        else:
            axes.set_visible(False)
    draw_compass(panels[0], fontsize=7)
    number = f"seed {first.seed}" if first.number is None else f"episode {first.number}"
    heading = f"{WORDS[first.route].capitalize()}, {number}: each second, pale before the end"
    head.text(0.01, 0.5, heading, va="center", fontsize=10, weight="bold")
    draw_speeds(below.subplots(), episodes)
    figure.savefig(path, dpi=150)
    plt.close(figure)
    return path


def _panel(axes: Axes, name: str, episode: Episode, colour: str) -> None:
    draw_road(axes, (-VIEW, VIEW), (-VIEW, VIEW))
    draw_reference(axes, episode.route)
    draw_ways(axes, episode, colour, TRAFFIC)
    write_times(axes, np.stack(episode.ego), episode.dt, colour, fontsize=6)
    if episode.crash is not None:
        draw_star(axes, *episode.crash[0], size=110)
    axes.set_title(f"{name}\n", fontsize=10, weight="bold", color=colour, loc="left")
    axes.text(0, 1.02, episode.event, transform=axes.transAxes, fontsize=8)


def draw_speeds(axes: Axes, episodes: Mapping[str, Episode]) -> None:
    """The speed of each ego from where it enters the box to where it leaves it."""
    for index, (name, episode) in enumerate(episodes.items()):
        colour = POLICIES[index % len(POLICIES)]
        inside = np.abs(np.stack(episode.ego)[:, :2]).max(1) <= HALF_BOX
        if not inside.any():
            axes.plot([], [], color=colour, lw=2, label=f"{name}: never in the box")
            continue
        time = episode.time[inside] - episode.time[inside][0]
        axes.plot(time, episode.speed[inside], color=colour, lw=2, label=name)
        if episode.crash is not None and inside[-1]:
            draw_star(axes, time[-1], episode.speed[-1], size=110)
    reference = next(iter(episodes.values())).reference
    axes.axhline(reference, color="#8a8a8a", lw=1, ls="--", label=f"{reference:g} m/s", zorder=1)
    axes.set(xlabel="time since entering the box (s)", ylabel="speed (m/s)")
    axes.set_xlim(left=0)
    axes.set_ylim(0, max(12.0, axes.get_ylim()[1]))
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
