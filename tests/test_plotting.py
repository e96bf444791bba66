"""Pictures of episodes on both backends."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv

from saferl.envs.intersection import BatchedIntersection, HighwayIntersection, Scenario
from saferl.envs.intersection.drivers import Driver
from saferl.envs.transforms import SafetyProjector
from saferl.plotting import EGO, Episode, draw, record, save_gif

EMPTY = Scenario(task="rt", vehicles=0, policy_frequency=5)
TRAFFIC = Scenario(task="gs", vehicles=3, policy_frequency=5, duration=2.0)


@pytest.mark.parametrize(
    ("kind", "scenario"), [(BatchedIntersection, EMPTY), (HighwayIntersection, TRAFFIC)]
)
def test_draw(kind: type, scenario: Scenario, tmp_path: Path):
    env = kind(scenario, num_envs=1)
    figure = draw(Driver(), env, {"episode": 2, "seed": 11}, tmp_path)
    assert figure == tmp_path / "episode_2.png"
    assert min(Image.open(figure).size) > 400
    episode = record(Driver(), env, 11)
    animation = Image.open(tmp_path / "episode_2.gif")
    delays = []
    for index in range(animation.n_frames):
        animation.seek(index)
        delays.append(animation.info["duration"])
    # Real time, but for the second at the end; a GIF merges pictures that are alike.
    assert sum(delays) == round(1000 * (len(episode.ego) - 1) * episode.dt) + 1000
    assert (tmp_path / "episode_2.gif").stat().st_size < 1.5e6


def test_record_is_the_episode_of_its_seed():
    first, again, other = (
        record(Driver(), HighwayIntersection(TRAFFIC, num_envs=1), seed) for seed in (3, 3, 4)
    )
    assert all(np.array_equal(a, b) for a, b in zip(first.ego, again.ego, strict=True))
    assert not np.array_equal(first.ego[0], other.ego[0])
    assert first.outcome == "frozen" and len(first.ego) == 11  # 2 s at 5 Hz, and the start
    assert first.others[0].shape[1] == 6
    assert record(Driver(), BatchedIntersection(EMPTY, num_envs=1), 1).outcome == "success"
    with pytest.raises(ValueError, match="num_envs=1"):
        record(Driver(), BatchedIntersection(EMPTY, num_envs=2), 1)


def test_corrections_are_marked(tmp_path: Path):
    """A risk that is the acceleration itself: the driver's is corrected, and the picture says so."""
    risk = TensorDictModule(lambda action: action[..., :1], ["action"], ["risk"])
    scenario = dataclasses.replace(EMPTY, duration=1.5)
    env = TransformedEnv(
        BatchedIntersection(scenario, num_envs=1), SafetyProjector(risk, limit=-0.9, penalty=100.0)
    )
    episode = record(Driver(), env, 1)
    assert any(episode.corrected)
    plain = record(Driver(), BatchedIntersection(EMPTY, num_envs=1), 1)
    assert np.array_equal(episode.ego[0], plain.ego[0])  # the same episode, corrected
    assert len(episode.corrected) == len(episode.ego) - 1
    draw(Driver(), env, {"episode": 0, "seed": 1}, tmp_path)


def test_the_ego_is_where_it_is_drawn(tmp_path: Path):
    """Colour of the pixels around a standing ego in the middle, and its size: 5 m by 2 m."""
    episode = Episode(0, "gs_inner", 0.2, ego=[np.zeros(6)] * 2, others=[np.zeros((0, 6))] * 2)
    episode.corrected = [False]
    picture = np.asarray(Image.open(save_gif(episode, tmp_path / "x.gif")).convert("RGB"), int)
    colour = np.array([int(EGO[i : i + 2], 16) for i in (1, 3, 5)])
    y, x = np.nonzero(np.abs(picture - colour).sum(-1) < 60)
    metre = 120.0 / (picture.shape[0] * 0.93)
    assert np.ptp(x) * metre == pytest.approx(5.0, abs=0.6)
    assert np.ptp(y) * metre == pytest.approx(2.0, abs=0.6)
    assert x.mean() == pytest.approx(picture.shape[1] / 2, abs=2)


def test_torch_is_left_as_it_was():
    state = torch.get_rng_state()
    record(Driver(), BatchedIntersection(EMPTY, num_envs=1), 1)
    assert torch.equal(state, torch.get_rng_state())
