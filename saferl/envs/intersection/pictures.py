"""Pictures of episodes: an animation, and trajectories with the ego's speed."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.patches import Circle, Polygon, Rectangle
from matplotlib.patheffects import withStroke
from PIL import Image
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from saferl.envs.intersection.episode import Episode, record
from saferl.envs.intersection.geometry import (
    ARM,
    CURB_RADIUS,
    HALF_BOX,
    LANE_WIDTH,
    LENGTH,
    ROUTES,
    WIDTH,
    line_pose,
    reference_lines,
)
from saferl.envs.intersection.rendering import CURBS, PAVEMENT

EGO, INK, ROAD, GRASS = "#d55e00", "#1a1a1a", "#d9d9d9", "#f1f5ec"
#: Of vehicle 0, 1, ...: any two of these and ``EGO`` are apart for all kinds of colour vision.
OTHERS = (
    "#0072b2", "#009e73", "#cc79a7", "#56b4e9", "#ddcc77",
    "#882255", "#332288", "#4f4111", "#b2c28b", "#8c4d47",
)  # fmt: skip
VIEW = 45.0  # m shown to either side of the middle
_SPACING = LENGTH + 0.5  # m between two pictures of a car
_GIF = {"size": 5.0, "strip": 0.3, "dpi": 120, "colours": 128, "view": 34.0}  # inches; m
_BOX = {"boxstyle": "round", "facecolor": "white", "edgecolor": INK}
# A car seen from above: its outline, narrower at the front, and its windscreen.
_BODY = np.array([[-0.5, -0.5], [0.3, -0.5], [0.5, -0.25], [0.5, 0.25], [0.3, 0.5], [-0.5, 0.5]])
_SCREEN = np.array([[0.12, -0.4], [0.28, -0.3], [0.28, 0.3], [0.12, 0.4]])


def draw(policy: TensorDictModuleBase, env: EnvBase, row: dict, out: Path) -> Path:
    """Replay an episode of a test into ``episode_N.gif`` and ``episode_N.png``.

    Args:
        policy, env: as the test played it, the environment of batch size 1.
        row: the episode's row, with its ``episode`` number and ``seed``.
        out: folder.

    Returns:
        The figure's path.
    """
    episode = record(policy, env, row["seed"])
    episode.number = row["episode"]
    stem = out / f"episode_{row['episode']}"
    save_gif(episode, stem.with_suffix(".gif"))
    return save_figure(episode, stem.with_suffix(".png"))


def save_gif(episode: Episode, path: Path) -> Path:
    """Write an endless GIF in real time, five to ten pictures a second; the last one stays 2 s.

    The view follows the ego as far as is needed to keep it in sight.
    """
    size, strip, view = _GIF["size"], _GIF["strip"], _GIF["view"]
    figure = plt.figure(figsize=(size, size + strip), dpi=_GIF["dpi"])
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, size / (size + strip)))
    draw_road(axes)
    _reference(axes, episode)
    words = {"fontsize": 9, "va": "center", "color": INK}
    middle = 1 - strip / 2 / (size + strip)
    figure.text(0.02, middle, episode.title, weight="bold", **words)
    clock = figure.text(0.98, middle, "", ha="right", family="monospace", **words)
    note = axes.text(0.03, 0.05, "", transform=axes.transAxes, fontsize=9, bbox=_BOX, zorder=7)
    last, stride = len(episode.corrected), max(1, round(0.1 / episode.dt))
    shown = sorted({*range(0, last, stride), last})
    images = []
    for index in shown:
        ego = episode.ego[index]
        corrected = index < last and episode.corrected[index]
        x, y = np.clip(ego[:2], (-10, -10), (10, 29))
        axes.set(xlim=(x - view, x + view), ylim=(y + view, y - view))
        drawn = _car(axes, ego, EGO, edge=2.5 if corrected else 1.2, zorder=5)
        for number, state in enumerate(episode.others[index]):
            drawn += _car(axes, state, _colour(number), str(number))
        if index == last and episode.crash is not None:
            drawn.append(_star(axes, *episode.crash[0]))
        note.set_text("projected action" if corrected else episode.event)
        note.set_visible(corrected or index == last)
        clock.set_text(f"{episode.time[index]:4.1f} s {episode.speed[index]:5.1f} m/s")
        canvas.draw()
        picture = np.asarray(canvas.buffer_rgba())[..., :3]
        images.append(Image.fromarray(picture).quantize(_GIF["colours"], dither=Image.Dither.NONE))
        for artist in drawn:
            artist.remove()
    plt.close(figure)
    duration = [round(1000 * episode.dt * (b - a)) for a, b in pairwise(shown)]
    images[0].save(
        path,
        save_all=True,
        append_images=images[1:],
        duration=[*duration, 2000],
        loop=0,
        optimize=True,
    )
    return path


def draw_road(axes: Axes, view: float = VIEW) -> None:
    """The pavement and its markings, north up, ``view`` m to either side of the middle."""
    axes.set(xlim=(-view, view), ylim=(view, -view), aspect="equal", xticks=[], yticks=[])
    axes.set_facecolor(GRASS)
    axes.spines[:].set_visible(False)
    for x, y, width, height in PAVEMENT:
        axes.add_patch(Rectangle((x, y), width, height, color=ROAD, lw=0, zorder=0))
    for centre in CURBS:
        axes.add_patch(Circle(centre, CURB_RADIUS, color=GRASS, lw=0, zorder=0.5))
    end, dashed = HALF_BOX + ARM, (0, (6, 6))
    for sign in (-1, 1):
        along = [sign * HALF_BOX, sign * end]
        entry = [sign * HALF_BOX] * 2
        for u, v, style in (
            (along, [0, 0], {"color": "#9a9a9a", "lw": 1.2}),
            (along, [LANE_WIDTH] * 2, {"color": "white", "lw": 1, "ls": dashed}),
            (along, [-LANE_WIDTH] * 2, {"color": "white", "lw": 1, "ls": dashed}),
            (entry, [0, -sign * 2 * LANE_WIDTH], {"color": "white", "lw": 2}),
        ):
            axes.plot(u, v, **style, zorder=1, solid_capstyle="butt")
            axes.plot([-w for w in v], u, **style, zorder=1, solid_capstyle="butt")


def _reference(axes: Axes, episode: Episode) -> None:
    route = torch.tensor(ROUTES.index(episode.route))
    lines = reference_lines(route, torch.zeros(1, dtype=torch.float64))
    along = torch.linspace(0.0, 2 * ARM + 2 * HALF_BOX, 400, dtype=torch.float64)
    for line in lines:
        points = line_pose(line.expand(400, 4, 6), along)
        drawn = axes.plot(points[:, 0], points[:, 1], color="#8a8a8a", lw=1, ls=":", zorder=1.5)
    drawn[0].set_label("reference lines")


def _compass(axes: Axes, view: float) -> None:
    x, y = -0.93 * view, 0.94 * view
    axes.plot([x, x + 10], [y, y], color=INK, lw=1.5, solid_capstyle="butt")
    axes.text(x + 5, y - 0.02 * view, "10 m", ha="center", va="bottom", fontsize=8, color=INK)
    axes.annotate(
        "N",
        (x + 15, y - 0.13 * view),
        (x + 15, y),
        arrowprops={"arrowstyle": "-|>", "color": INK, "shrinkB": 0},
        ha="center", va="bottom", fontsize=8, color=INK,
    )  # fmt: skip


def _colour(number: int) -> str:
    return OTHERS[number % len(OTHERS)]


def _dark(colour: str) -> np.ndarray:
    """The colour for writing on a light ground."""
    return (np.array(to_rgb(colour)) + to_rgb(INK)) / 2


def _placed(points: np.ndarray, state: np.ndarray) -> np.ndarray:
    """Points [P, 2], in lengths and widths of a car, where the car in ``state`` [6] has them."""
    cos, sin = np.cos(state[4]), np.sin(state[4])
    return state[:2] + points * (LENGTH, WIDTH) @ np.array([[cos, sin], [-sin, cos]])


def _car(
    axes: Axes, state: np.ndarray, colour: str, label: str = "", alpha=1.0, edge=0.8, zorder=4.0
) -> list[Artist]:
    """A car in ``state`` [6] with its label on it; nothing for one that is not on the road."""
    if not np.isfinite(state[0]):
        return []
    outline = INK if alpha == 1.0 else (colour, 0.5 + alpha / 2)
    body = Polygon(
        _placed(_BODY, state), facecolor=(colour, alpha), edgecolor=outline, lw=edge, zorder=zorder
    )
    screen = Polygon(_placed(_SCREEN, state), color="white", alpha=0.8 * alpha, lw=0, zorder=zorder)
    drawn: list[Artist] = [axes.add_patch(body), axes.add_patch(screen)]
    if label:
        x, y = _placed(np.array([[-0.17, 0.0]]), state)[0]
        light = alpha < 1 or np.dot(to_rgb(colour), (0.3, 0.6, 0.1)) > 0.55
        words = axes.text(
            x, y, label, ha="center", va="center_baseline", fontsize=6.5, weight="bold",
            color=INK if light else "white", zorder=zorder, clip_on=True,
        )  # fmt: skip
        drawn.append(words)
    return drawn


def _star(axes: Axes, x: float, y: float) -> Artist:
    return axes.scatter(
        x, y, s=160, marker="*", color="#ffd92f", edgecolor=INK, lw=1.2, zorder=6, clip_on=False
    )


def _trail(
    axes: Axes, states: np.ndarray, dt: float, colour: str, label: str, pale: float, zorder: float
) -> None:
    """The way of a car [T, 6]: a line, and the car at its end and at the whole seconds before.

    Where it has moved less than a car's length it is drawn once.
    """
    x, y = states[:, :2].T.copy()
    jump = np.hypot(np.diff(x), np.diff(y)) > _SPACING  # another car that took the number
    x[1:][jump] = np.nan
    axes.plot(x, y, color=colour, lw=1.4, alpha=0.6, zorder=2)
    view, last, kept = axes.get_xlim()[1], len(states) - 1, None
    for index in [last, *reversed(_seconds(last + 1, dt))]:
        state = states[index]
        if not np.abs(state[:2]).max() < view:  # or not on the road
            continue
        if kept is None or np.hypot(*(state - kept)[:2]) > _SPACING:
            name, alpha = "" if kept is not None else label, pale if index < last else 1.0
            _car(axes, state, colour, name, alpha=alpha, zorder=zorder + alpha)
            kept = state


def _seconds(count: int, dt: float) -> list[int]:
    """Which of ``count`` states are at whole seconds."""
    return [round(k / dt) for k in range(int((count - 1) * dt + 1e-6) + 1)]


def _times(axes: Axes, states: np.ndarray, dt: float, colour: str) -> None:
    """Whole seconds to the right of a car's way [T, 6]; where it waits, from when to when."""
    stops: list[list[int]] = []
    for second, index in enumerate(_seconds(len(states), dt)):
        if stops and np.hypot(*(states[index] - states[stops[-1][1]])[:2]) < _SPACING / 2:
            stops[-1][2] = second
        elif np.isfinite(states[index, 0]):
            stops.append([second, index, second])
    for first, index, final in stops:
        x, y = _placed(np.array([[0.0, 2.0]]), states[index])[0]
        text = f"{first} s" if first == final else f"{first}-{final} s"
        axes.text(
            x, y, text, ha="center", va="center", fontsize=7, color=_dark(colour), zorder=5,
            clip_on=True, path_effects=[withStroke(linewidth=2, foreground="white")],
        )  # fmt: skip


def draw_trajectories(axes: Axes, episode: Episode) -> None:
    """The ways of all cars: as they stood at the end, and pale every second before; the time along
    the ego's way and that of a car it hit; a star where it crashed."""
    view = max(VIEW, float(np.abs(episode.ego[-1][:2]).max()) + LENGTH)
    draw_road(axes, view)
    _reference(axes, episode)
    _compass(axes, view)
    ego, others = np.stack(episode.ego), np.stack(episode.others, 1)
    for number, states in enumerate(others):
        _trail(axes, states, episode.dt, _colour(number), str(number), 0.2, 3)
    _trail(axes, ego, episode.dt, EGO, "", 0.5, 3.5)
    axes.add_patch(Rectangle((0, 0), 0, 0, color=EGO, label="ego; pale: each second before"))
    _times(axes, ego, episode.dt, EGO)
    moved = ego[:-1][np.array(episode.corrected, bool)]
    if len(moved):
        axes.plot(
            moved[:, 0], moved[:, 1], "o", color=INK, ms=2, zorder=5, label="projected action"
        )
    if episode.crash is not None:
        where, number = episode.crash
        if number is not None:
            _times(axes, others[number], episode.dt, _colour(number))
        _star(axes, *where)
        axes.annotate(
            episode.event,
            (where[0], where[1]),
            (0.64 * view, 0.5 * view),
            arrowprops={"arrowstyle": "-", "color": INK, "shrinkB": 9},
            bbox=_BOX,
            ha="center", fontsize=9, zorder=6,
        )  # fmt: skip
    axes.set_title(f"{episode.title}\n", loc="left", fontsize=11, weight="bold")
    note = f"{episode.route}, {episode.event}, seed {episode.seed}"
    axes.text(0, 1.015, note, transform=axes.transAxes, fontsize=9)
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
        axes.plot(time, other, color=_colour(number), lw=1.6, label=f"car {number}")
    axes.plot(time, speed, color=EGO, lw=2.2, label="ego")
    moved = np.flatnonzero(episode.corrected)
    if len(moved):
        label = f"projected, {len(moved)} of {len(episode.corrected)}"
        axes.plot(time[moved], speed[moved], "o", color=INK, ms=2.5, label=label, zorder=3)
    if episode.crash is not None:
        _star(axes, time[-1], speed[-1])
    axes.set(xlabel="time (s)", ylabel="speed (m/s)", ylim=(0, max(12.0, 1.1 * speed.max())))
    axes.set_xlim(0, max(time[-1], episode.dt))
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=8, loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False)


def save_figure(episode: Episode, path: Path) -> Path:
    """Trajectories beside the ego's speed, as in the paper's figure of compared slices."""
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(11, 6), width_ratios=(1.3, 1), layout="constrained"
    )
    draw_trajectories(left, episode)
    draw_speed(right, episode)
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return path
