"""Figures of episodes: trajectories with the ego's speed."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from saferl.envs.intersection.animation import save_animation
from saferl.envs.intersection.episode import Episode, record
from saferl.envs.intersection.geometry import HALF_BOX, LENGTH
from saferl.envs.intersection.scene import (
    EGO,
    INK,
    ROAD,
    colour_of,
    draw_compass,
    draw_reference,
    draw_road,
    draw_star,
    draw_ways,
    write_times,
)

log = logging.getLogger(__name__)
VIEW = 45.0  # m shown to either side of the middle
_BOX = {"boxstyle": "round", "facecolor": "white", "edgecolor": INK}


def draw(
    policy: TensorDictModuleBase,
    env: EnvBase,
    rows: Sequence[dict],
    out: Path,
    name: str = "",
    form: str = "gif",
) -> Iterator[Path]:
    """Play episodes of a test again, side by side, and draw each: ``episode_N.png`` and ``episode_N.FORM``.

    Args:
        policy, env: as the test played it, but as many environments as episodes.
        rows: of the episodes, with their ``episode`` number and ``seed``.
        out: folder.
        name: what to call the policy.
        form: ``gif``, ``mp4``, or ``png``: the figure alone.

    Yields:
        The path of each figure, once it is there.
    """
    episodes = record(policy, env, [row["seed"] for row in rows], name)
    for episode, row in zip(episodes, rows, strict=True):
        episode.number = row["episode"]
        if not row.get(episode.outcome, True):
            log.warning("%s, other than in the test: numbers are rounded otherwise.", episode.title)
        stem = out / f"episode_{row['episode']}"
        if form != "png":
            save_animation(episode, stem.with_suffix(f".{form}"))
        yield save_figure(episode, stem.with_suffix(".png"))


def draw_trajectories(axes: Axes, episode: Episode) -> None:
    """The ways of all cars: as they stood at the end, and pale every second before; the time along
    the ego's way and that of a car it hit; a star where it crashed."""
    view = max(VIEW, float(np.abs(episode.ego[-1][:2]).max()) + LENGTH)
    draw_road(axes, (-view, view), (-view, view))
    draw_reference(axes, episode.route)
    draw_compass(axes)
    ego, others = np.stack(episode.ego), np.stack(episode.others, 1)
    draw_ways(axes, episode)
    axes.add_patch(Rectangle((0, 0), 0, 0, color=EGO, label="ego; pale: each second before"))
    write_times(axes, ego, episode.dt, EGO)
    moved = ego[:-1][np.array(episode.corrected, bool)]
    if len(moved):
        axes.plot(
            moved[:, 0], moved[:, 1], "o", color=INK, ms=2, zorder=5, label="projected action"
        )
    if episode.crash is not None:
        where, number = episode.crash
        if number is not None:
            write_times(axes, others[number], episode.dt, colour_of(number))
        draw_star(axes, *where)
        axes.annotate(
            episode.event,
            (where[0], where[1]),
            (0.64 * view, 0.5 * view),
            arrowprops={"arrowstyle": "-", "color": INK, "shrinkB": 9},
            bbox=_BOX,
            ha="center", fontsize=9, zorder=6,
        )  # fmt: skip
    axes.legend(fontsize=8, loc="upper left", framealpha=0, handlelength=1.5)


def draw_speed(axes: Axes, episode: Episode) -> None:
    """The ego's speed over time, and that of a car it hit; the time inside the box is shaded and
    corrected decisions are marked."""
    ego, time, speed = np.stack(episode.ego), episode.time, episode.speed
    inside = time[np.abs(ego[:, :2]).max(1) <= HALF_BOX]
    if len(inside):
        label = f"in the box, {inside[0]:.1f} to {inside[-1]:.1f} s"
        axes.axvspan(inside[0], inside[-1], color=ROAD, lw=0, label=label, zorder=0)
    axes.axhline(
        episode.reference, color="#8a8a8a", lw=1, ls="--", label=f"{episode.reference:g} m/s"
    )
    if episode.crash is not None and episode.crash[1] is not None:
        number = episode.crash[1]
        other = np.stack(episode.others, 1)[number, :, 2]
        axes.plot(time, other, color=colour_of(number), lw=1.6, label=f"car {number}")
    axes.plot(time, speed, color=EGO, lw=2.2, label="ego")
    moved = np.flatnonzero(episode.corrected)
    if len(moved):
        label = f"projected, {len(moved)} of {len(episode.corrected)}"
        axes.plot(time[moved], speed[moved], "o", color=INK, ms=2.5, label=label, zorder=3)
    if episode.crash is not None:
        draw_star(axes, time[-1], speed[-1])
    axes.set(xlabel="time (s)", ylabel="speed (m/s)")
    axes.set_ylim(0, max(12.0, axes.get_ylim()[1]))
    axes.set_xlim(0, max(time[-1], episode.dt))
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=8, loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False)


def save_figure(episode: Episode, path: Path) -> Path:
    """Trajectories beside the ego's speed."""
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(11, 6), width_ratios=(1.3, 1), layout="constrained"
    )
    draw_trajectories(left, episode)
    draw_speed(right, episode)
    left.set_title(f"{episode.title}\n", loc="left", fontsize=11, weight="bold")
    left.text(0, 1.015, episode.about, transform=left.transAxes, fontsize=9)
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return path
