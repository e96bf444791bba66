"""The road and its cars as matplotlib draws them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import NamedTuple

import matplotlib

matplotlib.use("Agg")
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgb, to_rgba
from matplotlib.font_manager import FontProperties
from matplotlib.patches import Circle, Rectangle
from matplotlib.path import Path as Outline
from matplotlib.patheffects import withStroke
from matplotlib.textpath import TextPath
from matplotlib.typing import RGBAColorType

from saferl.envs.intersection.episode import Episode
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

EGO, INK, ROAD, GRASS, STAR = "#d55e00", "#1a1a1a", "#d9d9d9", "#f1f5ec", "#ffd92f"
#: Of vehicle 0, 1, ...: any two of these and ``EGO`` are apart for all kinds of colour vision.
OTHERS = (
    "#0072b2", "#009e73", "#cc79a7", "#56b4e9", "#ddcc77",
    "#882255", "#332288", "#4f4111", "#b2c28b", "#8c4d47",
)  # fmt: skip
SPACING = LENGTH + 0.5  # m between two pictures of a car
# A car seen from above, in its lengths and widths: its outline, narrower at the front, and its windscreen.
_BODY = np.array([[-0.5, -0.5], [0.3, -0.5], [0.5, -0.25], [0.5, 0.25], [0.3, 0.5], [-0.5, 0.5]])
_SCREEN = np.array([[0.12, -0.4], [0.28, -0.3], [0.28, 0.3], [0.12, 0.4]])
_LABEL = np.array([[-0.17, 0.0]])


def draw_road(axes: Axes, x: Sequence[float], y: Sequence[float]) -> None:
    """The pavement and its markings, north up, between these x and y, m."""
    axes.set(xlim=x, ylim=y[::-1], aspect="equal", xticks=[], yticks=[])
    axes.set_facecolor(GRASS)
    axes.spines[:].set_visible(False)
    for left, top, width, height in PAVEMENT:
        axes.add_patch(Rectangle((left, top), width, height, color=ROAD, lw=0, zorder=0))
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


def draw_reference(axes: Axes, route: str) -> None:
    """The reference lines of a route."""
    number = torch.tensor(ROUTES.index(route))
    lines = reference_lines(number, torch.zeros(1, dtype=torch.float64))
    along = torch.linspace(0.0, 2 * ARM + 2 * HALF_BOX, 400, dtype=torch.float64)
    for line in lines:
        points = line_pose(line.expand(400, 4, 6), along)
        drawn = axes.plot(points[:, 0], points[:, 1], color="#8a8a8a", lw=1, ls=":", zorder=1.5)
    drawn[0].set_label("reference lines")


def draw_compass(axes: Axes, fontsize: float = 8) -> None:
    """Ten metres and the north, in the lower left corner."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    x, y, view = left + 0.035 * (right - left), bottom + 0.03 * (top - bottom), (right - left) / 2
    axes.plot([x, x + 10], [y, y], color=INK, lw=1.5, solid_capstyle="butt")
    words = {"ha": "center", "va": "bottom", "fontsize": fontsize, "color": INK}
    axes.text(x + 5, y - 0.02 * view, "10 m", **words)
    arrow = {"arrowstyle": "-|>", "color": INK, "shrinkB": 0}
    axes.annotate("N", (x + 15, y - 0.13 * view), (x + 15, y), arrowprops=arrow, **words)


def colour_of(number: int) -> str:
    """The colour of a vehicle."""
    return OTHERS[number % len(OTHERS)]


def dark(colour: str) -> np.ndarray:
    """The colour for writing on a light ground."""
    return (np.array(to_rgb(colour)) + to_rgb(INK)) / 2


def placed(points: np.ndarray, state: np.ndarray) -> np.ndarray:
    """Points [P, 2], in lengths and widths of a car, where the car in ``state`` [6] has them."""
    cos, sin = np.cos(state[4]), np.sin(state[4])
    return state[:2] + points * (LENGTH, WIDTH) @ np.array([[cos, sin], [-sin, cos]])


@lru_cache(maxsize=64)
def _letters(text: str) -> Outline:
    """The outline of a label that is read on a map whose y points down, its middle at 0, m."""
    path = TextPath((0, 0), text, size=1.6, prop=FontProperties(weight="bold"))
    box = path.get_extents()
    middle = np.array([box.min, box.max]).mean(0)
    return Outline((path.vertices - middle) * (1, -1), path.codes)


class Shape(NamedTuple):
    """A part of a picture of a car."""

    outline: Outline
    face: RGBAColorType
    edge: RGBAColorType
    width: float


_NONE: RGBAColorType = (0.0, 0.0, 0.0, 0.0)


def car(
    state: np.ndarray, colour: str, label: str = "", alpha: float = 1.0, edge: float = 0.8
) -> list[Shape]:
    """A car in ``state`` [6] with its label on it; nothing for one that is not on the road."""
    if not np.isfinite(state[0]):
        return []
    line = to_rgba(INK) if alpha > 0.5 else to_rgba(colour, 0.5 + alpha / 2)
    body, screen = (_closed(placed(points, state)) for points in (_BODY, _SCREEN))
    shapes = [
        Shape(body, to_rgba(colour, alpha), line, edge),
        Shape(screen, to_rgba("white", 0.8 * alpha), _NONE, 0.0),
    ]
    if label:
        light = alpha < 0.5 or np.dot(to_rgb(colour), (0.3, 0.6, 0.1)) > 0.55
        letters = _letters(label)
        where = Outline(letters.vertices + placed(_LABEL, state), letters.codes)
        shapes.append(Shape(where, to_rgba(INK if light else "white"), _NONE, 0.0))
    return shapes


def _closed(points: np.ndarray) -> Outline:
    return Outline(np.vstack([points, points[:1]]), closed=True)


def draw_cars(axes: Axes, shapes: Iterable[Shape], zorder: float = 4.0) -> PathCollection:
    """Shapes one above the other, the last on top, as one artist; :func:`show` changes them."""
    drawn = PathCollection([], zorder=zorder)
    show(drawn, shapes)
    axes.add_collection(drawn, autolim=False)
    return drawn


def show(drawn: PathCollection, shapes: Iterable[Shape]) -> None:
    """Let an artist of :func:`draw_cars` show these in place of what it showed."""
    shapes = [*shapes]
    drawn.set_paths([shape.outline for shape in shapes])
    drawn.set_facecolor([shape.face for shape in shapes])
    drawn.set_edgecolor([shape.edge for shape in shapes])
    drawn.set_linewidth([shape.width for shape in shapes] or [0.0])


def draw_star(axes: Axes, x: float, y: float, size: float = 160) -> PathCollection:
    """Where somebody crashed."""
    return axes.scatter(
        x, y, s=size, marker="*", color=STAR, edgecolor=INK, lw=1.2, zorder=6, clip_on=False
    )


def seconds(count: int, dt: float) -> list[int]:
    """Which of ``count`` states are at whole seconds.

    >>> seconds(6, dt=0.4)
    [0, 2, 5]
    """
    return [round(second / dt) for second in range(int((count - 1) * dt + 1e-6) + 1)]


def _seen(axes: Axes, state: np.ndarray) -> bool:
    """Whether a car is in view, and on the road."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    return bool(left < state[0] < right and top < state[1] < bottom)


def draw_way(
    axes: Axes, states: np.ndarray, dt: float, colour: str, label: str = "", pale: float = 0.2,
    final: float = 1.0,
) -> list[Shape]:  # fmt: skip
    """Draw the line of a car's way [T, 6]; returns the car at every whole second, pale, and at its end.

    Where it has moved less than a car's length it is there once.

    Args:
        pale, final: how opaque.
    """
    x, y = states[:, :2].T.copy()
    jump = np.hypot(np.diff(x), np.diff(y)) > SPACING  # another car that took the number
    x[1:][jump] = np.nan
    axes.plot(x, y, color=colour, lw=1.4, alpha=0.6, zorder=2)
    last, kept, shown = len(states) - 1, None, []
    for index in [last, *reversed(seconds(last + 1, dt))]:
        state = states[index]
        if not _seen(axes, state):
            continue
        if kept is None or np.hypot(*(state - kept)[:2]) > SPACING:
            name, alpha = "" if kept is not None else label, pale if index < last else final
            shown.append(car(state, colour, name, alpha))
            kept = state
    return [shape for shapes in reversed(shown) for shape in shapes]


def write_times(
    axes: Axes, states: np.ndarray, dt: float, colour: str, fontsize: float = 7
) -> None:
    """Whole seconds to the right of a car's way [T, 6]; where it waits, from when to when."""
    stops: list[list[int]] = []
    for index in seconds(len(states), dt):
        if stops and np.hypot(*(states[index] - states[stops[-1][0]])[:2]) < SPACING / 2:
            stops[-1][1] = index
        elif _seen(axes, states[index]):
            stops.append([index, index])
    for first, final in stops:
        begin, end = round(first * dt), round(final * dt)
        text = f"{begin} s" if begin == end else f"{begin}-{end} s"
        aside = 1.2 + 0.25 * len(text) * abs(np.sin(states[first][4]))
        x, y = placed(np.array([[0.0, aside]]), states[first])[0]
        axes.text(
            x, y, text, ha="center", va="center", fontsize=fontsize, color=dark(colour), zorder=5,
            clip_on=True, path_effects=[withStroke(linewidth=2, foreground="white")],
        )  # fmt: skip


def draw_ways(axes: Axes, episode: Episode, ego: str = EGO, others: str | None = None) -> None:
    """The ways of all cars, with their numbers. The others lie below the ego's and shine through each other, so that
    whoever comes late hides nothing.

    Args:
        ego: its colour.
        others: the colour of all others; None: each has its own.
    """
    shapes: list[Shape] = []
    for number, states in enumerate(np.stack(episode.others, 1)):
        colour = others or colour_of(number)
        shapes += draw_way(axes, states, episode.dt, colour, str(number), 0.2, 0.8)
    draw_cars(axes, shapes, zorder=3)
    own = draw_way(axes, np.stack(episode.ego), episode.dt, ego, pale=0.4)
    draw_cars(axes, own, zorder=3.5)
