"""Episodes that move: GIF and MP4."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, pairwise, product
from math import ceil
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from saferl.envs.intersection.episode import Episode
from saferl.envs.intersection.scene import (
    EGO,
    GRASS,
    INK,
    OTHERS,
    ROAD,
    STAR,
    car,
    colour_of,
    draw_cars,
    draw_reference,
    draw_road,
    draw_star,
    show,
)

SIZE, STRIP, DPI = 600, 60, 120  # pixels of the scene and of the words above it; dots an inch
VIEW = 34.0  # m shown to either side of the middle
STILL = 2.0  # s that the last picture stays
_SCALE = SIZE / (2 * VIEW)  # pixels a metre
# The middle of the view follows the ego between these, m.
_FIRST, _LAST = np.array([-10.0, -10.0]), np.array([10.0, 29.0])


class _Canvas:
    """A figure whose background is drawn once: pixels [H, W, 3] of it with artists above."""

    def __init__(self, width: int, height: int):
        self.figure = plt.figure(figsize=(width / DPI, height / DPI), dpi=DPI)
        self._canvas = FigureCanvasAgg(self.figure)

    def keep(self) -> None:
        """What is drawn by now, but for what is animated, is the background."""
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(self.figure.bbox)

    def picture(self, *artists) -> np.ndarray:
        self._canvas.restore_region(self._background)  # pyright: ignore[reportAttributeAccessIssue]
        for artist in artists:
            self.figure.draw_artist(artist)
        return np.asarray(self._canvas.buffer_rgba())[..., :3]

    def close(self) -> None:
        plt.close(self.figure)


def shown(episode: Episode) -> list[int]:
    """The states that are shown: the first, the last, five to ten a second."""
    last, stride = len(episode.ego) - 1, max(1, round(0.1 / episode.dt))
    return sorted({*range(0, last, stride), last})


def pictures(episode: Episode) -> Iterator[np.ndarray]:
    """The pictures [660, 600, 3] uint8 of :func:`shown`.

    The view follows the ego as far as is needed to keep it in sight.
    """
    low, high = _FIRST - VIEW, _LAST + VIEW
    width, height = (ceil(side * _SCALE) for side in high - low)
    scene, words = _Canvas(width, height), _Canvas(SIZE, STRIP)
    axes: Axes = scene.figure.add_axes((0, 0, 1, 1))
    draw_road(axes, (low[0], low[0] + width / _SCALE), (low[1], low[1] + height / _SCALE))
    draw_reference(axes, episode.route)
    cars, stars = draw_cars(axes, []), []
    cars.set_animated(True)
    if episode.crash is not None:
        stars = [draw_star(axes, *episode.crash[0])]
        stars[0].set_animated(True)
    scene.keep()
    clock, note = _words(words.figure, episode)
    words.keep()
    last = len(episode.ego) - 1
    for index in shown(episode):
        ego = episode.ego[index]
        corrected = index < last and episode.corrected[index]
        shapes = []
        for number, state in enumerate(episode.others[index]):
            shapes += car(state, colour_of(number), str(number))
        show(cars, shapes + car(ego, EGO, edge=2.5 if corrected else 1.2))
        drawn = scene.picture(cars, *(stars if index == last else ()))
        left, top = np.round((np.clip(ego[:2], _FIRST, _LAST) - _FIRST) * _SCALE).astype(int)
        clock.set_text(f"{episode.time[index]:4.1f} s {episode.speed[index]:5.1f} m/s")
        note.set_text("projected action" if corrected else "")
        strip = words.picture(clock, note)
        yield np.concatenate([strip, drawn[top : top + SIZE, left : left + SIZE]])
    scene.close()
    words.close()


def _words(figure: Figure, episode: Episode) -> tuple:
    """What stands above the scene; the clock and the note that change are returned."""
    words: dict[str, Any] = {"va": "center", "color": INK}
    figure.text(0.02, 0.7, episode.title, fontsize=9, weight="bold", **words)
    figure.text(0.02, 0.27, episode.about, fontsize=7.5, **words)
    moving: dict[str, Any] = {**words, "ha": "right", "animated": True}
    clock = figure.text(0.98, 0.7, "", fontsize=9, family="monospace", **moving)
    note = figure.text(0.98, 0.27, "", fontsize=8, weight="bold", **{**moving, "color": EGO})
    return clock, note


def save_animation(episode: Episode, path: Path) -> Path:
    """Write an episode in real time; the last picture stays 2 s.

    Args:
        path: its ending says how: ``.gif``, which begins again, or ``.mp4``, which needs imageio-ffmpeg.

    Raises:
        ValueError: another ending.
    """
    if path.suffix not in (".gif", ".mp4"):
        raise ValueError(f"path must end in .gif or .mp4, got {path}.")
    (_save_gif if path.suffix == ".gif" else _save_mp4)(episode, path)
    return path


def _palette() -> Image.Image:
    """All colours of the pictures, and steps between those that meet."""
    cars, grounds = (EGO, *OTHERS, STAR), ("white", INK, ROAD, GRASS, "#9a9a9a", "#8a8a8a")
    meet = [*product(cars, ("white", INK, ROAD)), *combinations(grounds[:4], 2)]
    colours = [np.array(to_rgb(each)) for each in (*cars, *grounds)]
    colours += [
        (1 - part) * np.array(to_rgb(one)) + part * np.array(to_rgb(other))
        for one, other in meet
        for part in (0.25, 0.5, 0.8)
    ]
    image = Image.new("P", (1, 1))
    image.putpalette((255 * np.array(colours)).round().astype(np.uint8).tobytes())
    return image


def _save_gif(episode: Episode, path: Path) -> None:
    palette = _palette()
    images = [
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
        for picture in pictures(episode)
    ]
    took = [round(1000 * episode.dt * (b - a)) for a, b in pairwise(shown(episode))]
    duration = [*took, round(1000 * STILL)]
    images[0].save(path, save_all=True, append_images=images[1:], duration=duration, loop=0)


def _save_mp4(episode: Episode, path: Path) -> None:
    from imageio_ffmpeg import write_frames  # pyright: ignore  (an extra)

    indices = shown(episode)
    fps: Any = 1 / (episode.dt * (indices[1] - indices[0]))
    writer = write_frames(str(path), (SIZE, SIZE + STRIP), fps=fps, quality=7, macro_block_size=2)
    writer.send(None)
    for picture in pictures(episode):
        writer.send(np.ascontiguousarray(picture))
    for _ in range(round(STILL * fps)):
        writer.send(np.ascontiguousarray(picture))
    writer.close()
