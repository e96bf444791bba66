"""Pictures of episodes: an animation, and trajectories with the ego's speed."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon, Rectangle
from PIL import Image
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

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

EGO, OTHER, REFERENCE = "#9c5a1a", "#2f6fb3", "#777777"
ROAD, GRASS = "#e9e9e9", "#ffffff"
VIEW = 60.0  # m


@dataclass
class Episode:
    """What happened in one episode, decision by decision.

    Attributes:
        seed, route: which episode.
        dt: seconds between decisions.
        outcome: ``success``, ``collision``, ``offroad`` or ``frozen``.
        ego: states [6], one more than decisions. others: states [N, 6] likewise.
        frames: rendered pictures [H, W, 3] uint8 (none on a backend without a renderer).
        corrected: whether the projector changed the action of each decision.
    """

    seed: int
    route: str
    dt: float
    outcome: str = "frozen"
    ego: list[np.ndarray] = field(default_factory=list)
    others: list[np.ndarray] = field(default_factory=list)
    frames: list[np.ndarray] = field(default_factory=list)
    corrected: list[bool] = field(default_factory=list)


@torch.no_grad()
def record(policy: TensorDictModuleBase, env: EnvBase, seed: int) -> Episode:
    """Play one episode of an environment of batch size 1 with the policy's mean action.

    Raises:
        ValueError: another batch size.
    """
    if env.batch_size != torch.Size([1]):
        raise ValueError(f"record needs num_envs=1, got batch size {tuple(env.batch_size)}.")
    base = env.base_env if isinstance(env, TransformedEnv) else env
    tensordict = env.reset(TensorDict({"seed": torch.tensor([seed])}, batch_size=[1]))
    episode = Episode(seed, ROUTES[int(tensordict["route"])], 1.0 / base.scenario.policy_frequency)

    def look() -> None:
        ego, others = base.snapshot(0)
        episode.ego.append(ego)
        episode.others.append(others)
        frame = base.render(0)
        if frame is not None:
            episode.frames.append(frame)

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


def save_gif(episode: Episode, path: Path) -> None:
    """Write the rendered frames as an endless GIF in real time; the last one stays a second.

    Raises:
        ValueError: the episode has no frames.
    """
    if not episode.frames:
        raise ValueError("This backend draws no frames; use env=highway for a GIF.")
    images = [Image.fromarray(frame).quantize(64) for frame in episode.frames]
    duration = [round(1000 * episode.dt)] * (len(images) - 1) + [1000]
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=duration, loop=0, optimize=True
    )


def draw_road(axes: Axes) -> None:
    """The pavement and its lane markings, metres, north up."""
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
            colour = "#d0a030" if offset == 0 else "#ffffff"
            axes.plot(span, [offset, offset], color=colour, ls=style, lw=0.9, zorder=1)
            axes.plot([offset, offset], span, color=colour, ls=style, lw=0.9, zorder=1)
    axes.set(xlim=(-VIEW, VIEW), ylim=(VIEW, -VIEW), aspect="equal", xlabel="x (m)", ylabel="y (m)")


def _rectangles(axes: Axes, states: np.ndarray, colour: str, alpha: float, zorder: float) -> None:
    for state in states.reshape(-1, 6):
        outline = corners(torch.as_tensor(state[[0, 1, 4]]), LENGTH, WIDTH).numpy()
        axes.add_patch(
            Polygon(outline, facecolor=colour, edgecolor="white", lw=0.3, alpha=alpha, zorder=zorder)
        )


def draw_trajectories(axes: Axes, episode: Episode, every: float = 0.5) -> None:
    """Rectangles of the ego (brown) and of the others (blue) every ``every`` seconds, later ones
    darker, over the ego's two reference lines."""
    draw_road(axes)
    route = torch.tensor(ROUTES.index(episode.route))
    lines = reference_lines(route, torch.zeros(1, dtype=torch.float64))
    along = torch.linspace(40.0, 175.0, 200, dtype=torch.float64)
    for line in lines:
        points = line_pose(line.expand(200, 4, 6), along)
        axes.plot(points[:, 0], points[:, 1], color=REFERENCE, lw=0.8, ls=":", zorder=1.5)
    stride = max(1, round(every / episode.dt))
    last = len(episode.ego) - 1
    for index in sorted({*range(0, last + 1, stride), last}):
        alpha = 0.15 + 0.85 * index / max(last, 1)
        _rectangles(axes, episode.others[index], OTHER, 0.6 * alpha, 2)
        _rectangles(axes, episode.ego[index], EGO, alpha, 3)
    axes.set_title(f"{episode.route}, episode {episode.seed}: {episode.outcome}", fontsize=9)


def draw_speed(axes: Axes, episode: Episode, label: str | None = None) -> None:
    """The ego's speed over time; the time inside the box is marked, so are corrected decisions."""
    ego = np.stack(episode.ego)
    time = np.arange(len(ego)) * episode.dt
    speed = np.hypot(ego[:, 2], ego[:, 3])
    inside = np.abs(ego[:, :2]).max(1) <= HALF_BOX
    if inside.any():
        axes.axvspan(time[inside][0], time[inside][-1], color="#dddddd", lw=0, label="in the box")
    axes.plot(time, speed, color=EGO, lw=1.6, label=label or "ego")
    corrected = np.flatnonzero(episode.corrected)
    if len(corrected):
        axes.plot(
            time[corrected], speed[corrected], "o", color="#c02020", ms=3, label="corrected action"
        )
    axes.set(xlabel="time (s)", ylabel="speed (m/s)", ylim=(0, max(12.0, 1.1 * speed.max())))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="lower right")


def save_figure(episode: Episode, path: Path) -> None:
    """Trajectories beside the ego's speed, as in the paper's figure of compared slices."""
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(10, 5), width_ratios=(1.1, 1), layout="constrained"
    )
    draw_trajectories(left, episode)
    draw_speed(right, episode)
    figure.savefig(path, dpi=120)
    plt.close(figure)
