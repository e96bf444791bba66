"""Pictures of episodes: an animation, and trajectories with the ego's speed."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.patches import Circle, Patch, Polygon, Rectangle
from PIL import Image
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from saferl.envs.intersection import IntersectionBase
from saferl.envs.intersection.geometry import (
    CURB_RADIUS,
    HALF_BOX,
    LANE_WIDTH,
    LENGTH,
    ROUTES,
    WIDTH,
    corners,
    line_pose,
    reference_lines,
)
from saferl.evaluation import start

# Okabe and Ito's palette, which all kinds of colour vision can tell apart.
EGO, OTHER, CORRECTED, REFERENCE = "#d55e00", "#0072b2", "#000000", "#666666"
ROAD, GRASS = "#e4e4e4", "#ffffff"
VIEW = 60.0  # m
_GIF = {"size": 4.2, "dpi": 120, "colours": 64}  # inches, dots an inch


@dataclass
class Episode:
    """What happened in one episode, decision by decision.

    Attributes:
        seed, route: which episode.
        dt: seconds between decisions.
        outcome: ``success``, ``collision``, ``offroad`` or ``frozen``.
        ego: states [6], one more than decisions. others: states [N, 6] likewise.
        corrected: whether the projector changed the action of each decision.
    """

    seed: int
    route: str
    dt: float
    outcome: str = "frozen"
    ego: list[np.ndarray] = field(default_factory=list)
    others: list[np.ndarray] = field(default_factory=list)
    corrected: list[bool] = field(default_factory=list)

    @property
    def speed(self) -> np.ndarray:
        """Speed of the ego [decisions + 1], m/s."""
        ego = np.stack(self.ego)
        return np.hypot(ego[:, 2], ego[:, 3])

    @property
    def title(self) -> str:
        """What a picture is headed with."""
        names = {"lt": "left turn", "gs": "straight", "rt": "right turn"}
        task, _, lane = self.route.partition("_")
        where = f" ({lane} lane)" if lane else ""
        return f"{names[task]}{where}, episode {self.seed}: {self.outcome}"


@torch.no_grad()
def record(policy: TensorDictModuleBase, env: EnvBase, seed: int) -> Episode:
    """Play one episode of an environment of batch size 1 with the policy's mean action.

    Raises:
        ValueError: another batch size.
    """
    if env.batch_size != torch.Size([1]):
        raise ValueError(f"record needs num_envs=1, got batch size {tuple(env.batch_size)}.")
    base = env.base_env if isinstance(env, TransformedEnv) else env
    assert isinstance(base, IntersectionBase)
    tensordict = start(env, torch.tensor([seed], device=env.device))
    episode = Episode(seed, ROUTES[int(tensordict["route"])], 1.0 / base.scenario.policy_frequency)

    def look() -> None:
        ego, others = base.snapshot(0)
        episode.ego.append(ego)
        episode.others.append(others)

    look()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        while True:
            tensordict = env.step(policy(tensordict))
            look()
            after = tensordict["next"]
            episode.corrected.append(bool(after.get("intervened", torch.tensor(False))))
            if after["done"].item():
                break
            tensordict = env.step_mdp(tensordict)
    for outcome in ("success", "collision", "offroad"):
        if after[outcome].item():
            episode.outcome = outcome
    return episode


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
    stem = out / f"episode_{row['episode']}"
    save_gif(episode, stem.with_suffix(".gif"))
    return save_figure(episode, stem.with_suffix(".png"))


def save_gif(episode: Episode, path: Path) -> Path:
    """Write an endless GIF in real time, five to ten pictures a second; the last one stays a second."""
    figure, axes = plt.subplots(figsize=(_GIF["size"],) * 2, dpi=_GIF["dpi"])
    canvas = FigureCanvasAgg(figure)
    figure.subplots_adjust(0, 0, 1, 0.93)
    draw_road(axes, bare=True)
    _reference(axes, episode)
    head = axes.set_title("", fontsize=9)
    stride = max(1, round(0.1 / episode.dt))
    last = len(episode.ego) - 1
    shown = sorted({*range(0, last, stride), last})
    images = []
    for index in shown:
        corrected = index < last and episode.corrected[index]
        cars = _rectangles(axes, episode.others[index], OTHER)
        cars += _rectangles(axes, episode.ego[index], EGO, edge=CORRECTED if corrected else "white")
        end = f"  {episode.outcome}" if index == last else "  corrected" if corrected else ""
        head.set_text(f"{index * episode.dt:4.1f} s  {episode.speed[index]:4.1f} m/s{end}")
        canvas.draw()
        picture = np.asarray(canvas.buffer_rgba())[..., :3]
        images.append(Image.fromarray(picture).quantize(_GIF["colours"], dither=Image.Dither.NONE))
        for car in cars:
            car.remove()
    plt.close(figure)
    duration = [round(1000 * episode.dt * (b - a)) for a, b in pairwise(shown)]
    images[0].save(
        path,
        save_all=True,
        append_images=images[1:],
        duration=[*duration, 1000],
        loop=0,
        optimize=True,
    )
    return path


def draw_road(axes: Axes, bare: bool = False) -> None:
    """The pavement and its lane markings, metres, north up.

    Args:
        axes: where.
        bare: without axis labels and ticks.
    """
    half = 2 * LANE_WIDTH
    axes.set_facecolor(GRASS)
    for corner, width, height in (
        ((-half, -VIEW), 2 * half, 2 * VIEW),
        ((-VIEW, -half), 2 * VIEW, 2 * half),
        ((-HALF_BOX, -HALF_BOX), 2 * HALF_BOX, 2 * HALF_BOX),
    ):
        axes.add_patch(Rectangle(corner, width, height, color=ROAD, lw=0, zorder=0))
    for x in (-HALF_BOX, HALF_BOX):
        for y in (-HALF_BOX, HALF_BOX):
            axes.add_patch(Circle((x, y), CURB_RADIUS, color=GRASS, lw=0, zorder=0.5))
    for sign in (-1, 1):
        span = [sign * HALF_BOX, sign * VIEW]
        for offset, style in ((0.0, "-"), (LANE_WIDTH, (0, (6, 6))), (-LANE_WIDTH, (0, (6, 6)))):
            colour = "#999999" if offset == 0 else "#ffffff"
            axes.plot(span, [offset, offset], color=colour, ls=style, lw=0.9, zorder=1)
            axes.plot([offset, offset], span, color=colour, ls=style, lw=0.9, zorder=1)
    axes.set(xlim=(-VIEW, VIEW), ylim=(VIEW, -VIEW), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    if bare:
        axes.set_axis_off()


def _rectangles(
    axes: Axes, states: np.ndarray, colour: str, alpha: float = 1.0, zorder: float = 3, edge="white"
) -> list[Patch]:
    return [
        axes.add_patch(
            Polygon(
                corners(torch.as_tensor(state[[0, 1, 4]]), LENGTH, WIDTH).numpy(),
                facecolor=colour,
                edgecolor=edge,
                lw=0.4 if edge == "white" else 1.4,
                alpha=alpha,
                zorder=zorder,
            )
        )
        for state in states.reshape(-1, 6)
        if np.abs(state[:2]).max() < VIEW
    ]


def _reference(axes: Axes, episode: Episode) -> None:
    route = torch.tensor(ROUTES.index(episode.route))
    lines = reference_lines(route, torch.zeros(1, dtype=torch.float64))
    along = torch.linspace(40.0, 175.0, 200, dtype=torch.float64)
    for line, label in zip(lines, ("reference lines", None), strict=True):
        points = line_pose(line.expand(200, 4, 6), along)
        axes.plot(
            points[:, 0], points[:, 1], color=REFERENCE, lw=0.9, ls=":", zorder=1.5, label=label
        )


def draw_trajectories(axes: Axes, episode: Episode, every: float = 1.0) -> None:
    """Rectangles of the ego and of the others every ``every`` seconds, later ones darker, over the
    ego's two reference lines."""
    draw_road(axes)
    _reference(axes, episode)
    stride = max(1, round(every / episode.dt))
    last = len(episode.ego) - 1
    for index in sorted({*range(0, last + 1, stride), last}):
        alpha = 0.15 + 0.85 * index / max(last, 1)
        _rectangles(axes, episode.others[index], OTHER, 0.6 * alpha, 2)
        _rectangles(axes, episode.ego[index], EGO, alpha, 3)
    for colour, label in ((EGO, "ego"), (OTHER, "other vehicles")):
        if colour == EGO or any(len(others) for others in episode.others):
            axes.add_patch(Rectangle((0, 2 * VIEW), 0, 0, color=colour, label=label))
    axes.legend(fontsize=8, loc="lower left", framealpha=1.0)
    axes.set_title(episode.title, fontsize=10)


def draw_speed(axes: Axes, episode: Episode) -> None:
    """The ego's speed over time; the time inside the box is marked, so are corrected decisions."""
    ego, speed = np.stack(episode.ego), episode.speed
    time = np.arange(len(ego)) * episode.dt
    inside = np.flatnonzero(np.abs(ego[:, :2]).max(1) <= HALF_BOX)
    if len(inside):
        axes.axvspan(
            float(time[inside[0]]),
            float(time[inside[-1]]),
            color=ROAD,
            lw=0,
            label="in the box",
            zorder=0,
        )
    axes.plot(time, speed, color=EGO, lw=1.8, label="ego")
    corrected = np.flatnonzero(episode.corrected)
    if len(corrected):
        axes.plot(
            time[corrected], speed[corrected], "o", color=CORRECTED, ms=3, label="corrected action"
        )
    axes.set(xlabel="time (s)", ylabel="speed (m/s)", ylim=(0, max(12.0, 1.1 * speed.max())))
    axes.set_xlim(0, max(time[-1], episode.dt))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="lower right", framealpha=1.0)


def save_figure(episode: Episode, path: Path) -> Path:
    """Trajectories beside the ego's speed, as in the paper's figure of compared slices."""
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(10, 5), width_ratios=(1.1, 1), layout="constrained"
    )
    draw_trajectories(left, episode)
    draw_speed(right, episode)
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return path
