"""The profile of a multiplier, from runs whose figures are known."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import matplotlib.image
import pytest
from made import table
from omegaconf import OmegaConf
from small import compose

from saferl.report.profile import draw, points, profile, tell


def run(folder: Path, lagrange: str, start: float, end: float, cost: float, gain: float) -> None:
    """A finished run on the cart with a limit of 0.2."""
    options = (f"lagrange={lagrange}", f"lagrange.multiplier.init={start}")
    cfg = compose("experiment=cart_profile", "algo=ppo_lag", *options)
    OmegaConf.resolve(cfg)
    (folder / "evaluation").mkdir(parents=True)
    OmegaConf.save(cfg, folder / "config.yaml")
    figures = {
        key: {"mean": mean, "low": mean - 0.01, "high": mean + 0.01}
        for key, mean in (("cost_return", cost), ("return", gain))
    }
    (folder / "evaluation/metrics.json").write_text(json.dumps(figures))
    table(
        folder / "metrics.csv",
        [{"frames": 1, "lagrange_multiplier": start}, {"frames": 2, "lagrange_multiplier": end}],
    )


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Fixed ones of 0.1 and 1 around the limit, the second twice, and one learned between them."""
    run(tmp_path / "a", "fixed", 1.0, 1.0, 0.10, -2.2)
    run(tmp_path / "b", "fixed", 1.0, 1.0, 0.14, -1.8)
    run(tmp_path / "c", "fixed", 0.1, 0.1, 0.28, -1.2)
    run(tmp_path / "d", "episode", 0.5, 0.7, 0.16, -1.9)
    return tmp_path


def test_says_where_the_limit_and_the_learned_one_lie(runs: Path):
    """Half-way in cost from 0.12 to 0.28 is half-way in return and in the logarithm of the multiplier."""
    found = points(runs)
    assert [point.multiplier for point in found] == [0.1, 1.0, 1.0, 0.7]
    assert profile(found).tolist() == [
        pytest.approx([1.0, 0.12, -2.0]),
        pytest.approx([0.1, 0.28, -1.2]),
    ]
    first, second = tell(found).splitlines()
    assert first == "cost_limit=0.2 is met by a multiplier of 0.316, with a return of -1.6."
    assert second == (
        "PIDMultiplier from 0.5 (seed 0) ends at 0.7: cost 0.16, return -1.9; at this cost a fixed one is 0.562 and earns -1.8."
    )


def test_a_limit_beyond_the_profile(runs: Path):
    found = [point for point in points(runs) if point.multiplier != 0.1]
    assert tell(found).splitlines()[0] == "cost_limit=0.2 lies beyond all fixed multipliers."
    assert tell(found).splitlines()[1].endswith("cost 0.16, return -1.9.")


def test_draws_and_keeps_the_numbers(runs: Path, tmp_path: Path):
    path = draw(points(runs), tmp_path)
    assert matplotlib.image.imread(path).std() > 0.05
    with (tmp_path / "profile.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["lagrange"] for row in rows] == ["fixed"] * 3 + ["PIDMultiplier"]
    assert float(rows[3]["multiplier"]) == 0.7
