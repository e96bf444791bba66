"""Pictures of episodes on both backends."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from PIL import Image
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv

from saferl.envs.intersection import BatchedIntersection, HighwayIntersection, Scenario
from saferl.envs.intersection.animation import save_animation
from saferl.envs.intersection.drivers import CautiousDriver, Driver
from saferl.envs.intersection.episode import Episode, record
from saferl.envs.intersection.pictures import draw, draw_trajectories
from saferl.envs.intersection.scene import EGO, OTHERS
from saferl.envs.transforms import SafetyProjector

EMPTY = Scenario(task="rt", vehicles=0, policy_frequency=5)
TRAFFIC = Scenario(task="gs", vehicles=3, policy_frequency=5, duration=2.0)


@pytest.mark.parametrize(
    ("kind", "scenario"), [(BatchedIntersection, EMPTY), (HighwayIntersection, TRAFFIC)]
)
def test_draw(kind: type, scenario: Scenario, tmp_path: Path):
    env = kind(scenario, num_envs=2)
    rows = [{"episode": 2, "seed": 11}, {"episode": 4, "seed": 12}]
    figures = [*draw(Driver(), env, rows, tmp_path, "blind")]
    assert figures == [tmp_path / f"episode_{number}.png" for number in (2, 4)]
    assert min(Image.open(figures[0]).size) > 400
    episode = record(Driver(), env, [11, 12])[0]
    animation = Image.open(tmp_path / "episode_2.gif")
    delays = []
    for index in range(animation.n_frames):
        animation.seek(index)
        delays.append(animation.info["duration"])
    # Real time, but for the two seconds at the end; a GIF merges pictures that are alike.
    assert sum(delays) == round(1000 * (len(episode.ego) - 1) * episode.dt) + 2000
    assert (tmp_path / "episode_2.gif").stat().st_size < 1.5e6


def test_record_is_the_episode_of_its_seed():
    """Whoever plays beside it, on either backend."""
    for kind in (BatchedIntersection, HighwayIntersection):
        env = kind(TRAFFIC, num_envs=3, seed=0)
        first, again, other = record(Driver(), env, [3, 3, 4], "blind")
        (alone,) = record(Driver(), kind(TRAFFIC, num_envs=1, seed=5), [3])
        for same in (again, alone):
            assert all(np.array_equal(a, b) for a, b in zip(first.ego, same.ego, strict=True))
            assert np.array_equal(np.stack(first.others), np.stack(same.others), equal_nan=True)
        assert not np.array_equal(first.ego[0], other.ego[0])
    assert first.outcome == "frozen" and len(first.ego) == 11  # 2 s at 5 Hz, and the start
    assert first.others[0].shape[1] == 6
    assert first.about.startswith("blind, straight on in the ")
    (arrives,) = record(Driver(), BatchedIntersection(EMPTY, num_envs=1, seed=0), [1])
    assert arrives.outcome == "success" and arrives.about == "right turn, seed 1"
    with pytest.raises(ValueError, match="num_envs=1"):
        record(Driver(), BatchedIntersection(EMPTY, num_envs=2, seed=0), [1])


def test_episodes_of_unequal_length_end_where_they_end_alone():
    """As a driver that brakes for others is quicker or slower than the one beside it."""
    scenario = Scenario(task="mixed", scenario="dense", policy_frequency=5)
    several = record(CautiousDriver(), BatchedIntersection(scenario, num_envs=3), [1, 2, 3])
    assert len({len(each.ego) for each in several}) == 3
    for each in several:
        (alone,) = record(CautiousDriver(), BatchedIntersection(scenario), [each.seed])
        assert len(alone.ego) == len(each.ego) and alone.outcome == each.outcome
        assert len(each.corrected) == len(each.ego) - 1


def test_corrections_are_marked(tmp_path: Path):
    """A risk that is the acceleration itself: the driver's is corrected, and the picture says so."""
    risk = TensorDictModule(lambda action: action[..., :1], ["action"], ["risk"])
    scenario = dataclasses.replace(EMPTY, duration=1.5)
    env = TransformedEnv(
        BatchedIntersection(scenario, num_envs=1, seed=0),
        SafetyProjector(risk, limit=-0.9, penalty=100.0),
    )
    (episode,) = record(Driver(), env, [1])
    assert any(episode.corrected)
    (plain,) = record(Driver(), BatchedIntersection(EMPTY, num_envs=1, seed=0), [1])
    assert np.array_equal(episode.ego[0], plain.ego[0])  # the same episode, corrected
    assert len(episode.corrected) == len(episode.ego) - 1
    next(draw(Driver(), env, [{"episode": 0, "seed": 1}], tmp_path))


def test_the_ego_is_where_it_is_drawn(tmp_path: Path):
    """Colour of the pixels around a standing ego in the middle, and its size: 5 m by 2 m."""
    episode = Episode(0, "gs_inner", 0.2, ego=[np.zeros(6)] * 2, others=[np.zeros((0, 6))] * 2)
    episode.corrected = [False]
    picture = np.asarray(
        Image.open(save_animation(episode, tmp_path / "x.gif")).convert("RGB"), int
    )
    colour = np.array([int(EGO[i : i + 2], 16) for i in (1, 3, 5)])
    y, x = np.nonzero(np.abs(picture - colour).sum(-1) < 60)
    metre = 2 * 34.0 / picture.shape[1]
    assert np.ptp(x) * metre == pytest.approx(5.0, abs=0.5)
    assert np.ptp(y) * metre == pytest.approx(2.0, abs=0.5)
    strip = picture.shape[0] - picture.shape[1]  # above the square
    assert (x.min() + x.max()) / 2 == pytest.approx(picture.shape[1] / 2, abs=2)
    assert (y.min() + y.max()) / 2 == pytest.approx(strip + picture.shape[1] / 2, abs=2)


def test_the_view_follows_the_ego_and_keeps_the_palette(tmp_path: Path):
    """Between 10 m north of the middle and 29 m south of it; each car has its own colour, whenever it comes."""
    ego = [np.array([0.0, y, 9.0, 0.0, -np.pi / 2, 0.0]) for y in (60.0, 20.0, -30.0)]
    others = np.full((3, 10, 6), np.nan)
    others[2] = [[-30 + 6 * k, 0.0, 0.0, 0.0, 0.0, 0.0] for k in range(10)]
    episode = Episode(0, "gs_inner", 0.2, ego=ego, others=[*others], corrected=[False] * 2)
    pictures = Image.open(save_animation(episode, tmp_path / "x.gif"))
    scale, found = pictures.width / 68, []
    for index in range(3):
        pictures.seek(index)
        picture = np.asarray(pictures.convert("RGB"))
        colours = [tuple(int(c[i : i + 2], 16) for i in (1, 3, 5)) for c in (EGO, *OTHERS)]
        counts = [(picture == colour).all(-1).sum() / scale**2 for colour in colours]
        assert all((3 < count < 10) == (index == 2) for count in counts[1:]), counts
        found.append(np.nonzero((picture == colours[0]).all(-1))[0].mean() - 60)
    assert np.array(found) / scale - 34 == pytest.approx([60 - 29, 0, -30 + 10], abs=1)


def test_an_mp4_is_the_episode_in_real_time(tmp_path: Path):
    video = pytest.importorskip("imageio_ffmpeg")
    episode = Episode(0, "rt", 0.1, ego=[np.array([0.0, y, *NORTH[2:]]) for y in range(11)])
    episode.others, episode.corrected = [np.zeros((0, 6))] * 11, [False] * 10
    reader = video.read_frames(str(save_animation(episode, tmp_path / "x.mp4")))
    about = next(reader)
    assert about["size"] == (600, 660) and about["fps"] == 10
    assert len([*reader]) == 11 + 20  # the last one stays
    with pytest.raises(ValueError, match=r"must end in .gif or .mp4, got .*x.avi"):
        save_animation(episode, tmp_path / "x.avi")


@pytest.mark.parametrize("kind", [BatchedIntersection, HighwayIntersection])
def test_a_vehicle_keeps_its_row(kind: type):
    """Until it leaves the road: a row moves by no more than 12 m/s, or 0.2 s, allow."""
    scenario = dataclasses.replace(TRAFFIC, vehicles=8, duration=25.0)
    others = np.stack(record(Driver(speed=1.0), kind(scenario, num_envs=1), [4])[0].others)
    assert others.shape[1:] == (8, 6)
    there = np.isfinite(others[..., 0])
    assert np.array_equal(np.isfinite(others).all(-1), there)
    assert (there[:-1] & ~there[1:]).any() and not (~there[:-1] & there[1:]).any()
    assert np.nanmax(np.hypot(*np.diff(others[..., :2], axis=0).transpose(2, 0, 1))) < 12 * 0.2


NORTH = [0.0, 0.0, 9.0, 0.0, -np.pi / 2, 0.0]


def test_the_crash_is_where_both_cars_are():
    others = np.full((3, 6), np.nan)
    others[1] = [0.0, -20.0, 0.0, 0.0, 0.0, 0.0]
    others[2] = [3.0, -2.0, 5.0, 0.0, np.pi, 0.0]  # its front left, the ego's front right
    episode = Episode(7, "gs_inner", 0.1, "hit_vehicle", 4, ego=[np.array(NORTH)] * 22)
    episode.others, episode.corrected = [others] * 22, [False] * 21
    assert episode.crash is not None
    where, number = episode.crash
    assert number == 2
    assert where == pytest.approx([0.75, -1.75], abs=0.1)  # of [0.5, 1] x [-2.5, -1]
    assert episode.event == "hits car 2 at 2.1 s"
    assert episode.title == "Episode 4: hits car 2 at 2.1 s"


def test_the_road_is_left_where_a_corner_is_off_it():
    ego = np.array([7.4, 40.0, 5.0, 0.0, -np.pi / 2, 0.0])
    episode = Episode(7, "gs_outer", 0.2, "left_road", ego=[ego], others=[np.zeros((0, 6))])
    assert episode.crash is not None
    assert episode.crash[0] == pytest.approx([8.4, 40.0]) and episode.crash[1] is None
    assert episode.title == "Seed 7: leaves the road at 0.0 s"


def test_a_waiting_car_is_drawn_once_and_another_with_its_number_is_another():
    """The line breaks where a vehicle enters under the number of one that has left."""
    cars = np.zeros((61, 2, 6))
    cars[:, 0, 0] = 20.0
    cars[:, 1, 0] = np.r_[np.arange(31) * 1.0, -40.0 + np.arange(30)]
    episode = Episode(0, "lt", 0.1, ego=[np.array([2.0, 50.0, *NORTH[2:]])] * 61, others=[*cars])
    episode.corrected = [False] * 60
    figure, axes = plt.subplots()
    draw_trajectories(axes, episode)
    bodies = [tuple(face[:3]) for drawn in axes.collections for face in drawn.get_facecolor()]
    first, second = (tuple(int(c[i : i + 2], 16) / 255 for i in (1, 3, 5)) for c in OTHERS[:2])
    assert bodies.count(first) == 1 and bodies.count(second) == 7
    assert "0-6 s" in [text.get_text() for text in axes.texts]
    (line,) = (line for line in axes.lines if line.get_color() == OTHERS[1])
    assert np.isnan(line.get_xdata()).sum() == 1
    plt.close(figure)


#: Linear RGB as it is seen without one kind of cone (Machado et al. 2009, severity 1).
CONES = {
    "all": np.eye(3),
    "protan": [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]],
    "deutan": [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]],
    "tritan": [[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]],
}
XYZ = np.array([[0.434, 0.376, 0.190], [0.213, 0.715, 0.072], [0.018, 0.109, 0.873]])  # white is 1


@pytest.mark.parametrize("cones", CONES)
def test_any_two_cars_differ_in_colour(cones: str):
    """By 15 in CIELAB, to all kinds of colour vision (2 is just noticed), and from the ego by 25."""
    srgb = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in (EGO, *OTHERS)]) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    f = np.cbrt(np.clip(linear @ np.transpose(CONES[cones]), 0, 1) @ XYZ.T)
    lab = np.stack([116 * f[:, 1], 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], -1)
    apart = np.linalg.norm(lab[:, None] - lab, axis=-1) + 1000 * np.eye(len(lab))
    assert apart.min() > 15 and apart[0].min() > 25


@pytest.mark.parametrize("seed", [1, 2])
def test_both_backends_render_the_same_scene(seed: int):
    scenario = Scenario(task="mixed", vehicles=10)
    pictures = []
    for kind in (BatchedIntersection, HighwayIntersection):
        env = kind(scenario, num_envs=2)
        env.reset(seeds=torch.tensor([99, seed]))
        pictures.append(env.render(1).astype(int))
        assert (pictures[-1] != env.render(0)).any()
    assert pictures[0].shape == (600, 600, 3)
    assert (pictures[0] != pictures[1]).any(-1).mean() < 1e-3


def test_yielding_cars_are_orange():
    env = BatchedIntersection(Scenario(task="gs", vehicles=10), num_envs=1, seed=0)
    env.reset(seeds=torch.tensor([3]))
    orange = np.array([255, 170, 60])
    for _ in range(20):
        env.step(TensorDict({"action": torch.zeros(1, 2)}, [1]))
        state = env.state_dict()
        held = state["vehicle_held"] & state["vehicle_present"]
        seen = (env.render(0) == orange).all(-1).any()
        assert seen == bool(held.any())
        if seen:
            return
    pytest.fail("nobody yields in this episode")


def test_torch_is_left_as_it_was():
    state = torch.get_rng_state()
    record(Driver(), BatchedIntersection(EMPTY, num_envs=1, seed=0), [1])
    assert torch.equal(state, torch.get_rng_state())
