"""Several policies in the same traffic in one figure."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image

from saferl.envs.intersection.comparison import draw_speeds, save_comparison
from saferl.envs.intersection.episode import Episode


def straight(speed: float, seed: int = 0, until: float = -40.0) -> Episode:
    """From 55 m before the middle to the north, at one speed, past a car that stands."""
    y = np.arange(55.0, until, -0.1 * speed)
    ego = [np.array([2.0, each, speed, 0.0, -np.pi / 2, 0.0]) for each in y]
    others = [np.array([[2.0, -20.0, 0.0, 0.0, -np.pi / 2, 0.0]])] * len(ego)
    outcome = "success" if until < -30 else "hit_vehicle"
    corrected = [False] * (len(ego) - 1)
    return Episode(seed, "gs_inner", 0.1, outcome, ego=ego, others=others, corrected=corrected)


def test_the_plot_is_the_speed_inside_the_box_since_it_was_entered():
    """30 m at 10 and at 5 m/s; whoever turns back before has none; a star where one crashes in the box."""
    episodes = {"fast": straight(10.0), "slow": straight(5.0), "shy": straight(5.0, until=20.0)}
    figure, axes = plt.subplots()
    draw_speeds(axes, episodes)
    lines = {line.get_label(): line.get_xydata() for line in axes.lines}
    for name, speed in (("fast", 10.0), ("slow", 5.0)):
        time, shown = lines[name].T
        assert time[0] == 0 and time[-1] == pytest.approx(30 / speed, abs=0.1)
        assert np.allclose(shown, speed)
    assert len(lines["shy: never in the box"]) == 0 and len(axes.collections) == 0
    plt.close(figure)
    figure, axes = plt.subplots()
    crash = straight(5.0, until=-14.8)
    draw_speeds(axes, {"crash": crash})
    assert len(axes.collections) == 1
    plt.close(figure)


@pytest.mark.parametrize("count", [1, 3, 7])
def test_any_number_of_policies_has_a_figure(count: int, tmp_path: Path):
    episodes = {f"policy {k}": straight(5.0 + k) for k in range(count)}
    picture = Image.open(save_comparison(episodes, tmp_path / "x.png"))
    rows = -(-count // 5)
    assert picture.width > 150 * 2.5 * min(max(count, 3), 5)
    assert picture.height > 150 * (2.5 + 2.7 * rows)
    assert save_comparison(episodes, tmp_path / "x.pdf").read_bytes().startswith(b"%PDF")


def test_other_traffic_is_refused(tmp_path: Path):
    with pytest.raises(ValueError, match=r"of one seed and route, got 0, .* and 1, .* \(b\)"):
        save_comparison({"a": straight(5.0), "b": straight(5.0, seed=1)}, tmp_path / "x.png")
    with pytest.raises(ValueError, match="at least one episode"):
        save_comparison({}, tmp_path / "x.png")
