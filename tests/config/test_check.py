"""Values that cannot be meant are refused in one line, before a folder is made."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ValidationError
from small import EMPTY, SMALL, compose

from saferl.algorithms.assemble import build_env
from saferl.config.check import check
from saferl.config.locate import config_dir
from saferl.envs.intersection import CollisionCost, Reward, Scenario
from saferl.evaluation.rows import write
from saferl.evaluation.statistics import FIGURES

MISTAKES = [
    (
        "+task.traffic.vehicles=ab",
        "task.traffic.vehicles must be a list of 2, each a whole number, ",
    ),
    ("+task.traffic.vehicles=[5.5,6]", "task.traffic.vehicles must be a list of 2, each a whole"),
    ("+task.traffic.respawn=maybe", "task.traffic.respawn must be true or false, got 'maybe'."),
    (
        "+task.traffic.foo=1",
        "unknown key task.traffic.foo: task.traffic, a Traffic, takes vehicles,",
    ),
    ("task.traffic.bias=0", "task.traffic is empty by default, set it with +task.traffic.bias=..."),
    (
        "learning.update_order=paper",
        "learning.update_order must be one of joint, sequential, got 'paper'.",
    ),
    ("learning.lr=3", "learning.lr must be a mapping of actor, critic, alpha, got 3."),
    ("learning.lr=null", "learning.lr must not be null."),
    ("learning.lr.actor=[1]", "learning.lr.actor must be [first, last], both >= 0, got [1.0]."),
    ("learning.lr.alpha=[a,1]", "learning.lr.alpha[0] must be a number, got 'a'."),
    ("seed=abc", "seed must be a whole number, got 'abc'."),
    ("frames=2.5", "frames must be a whole number, got 2.5."),
    ("seed=null", "seed must not be null."),
    ("compile=perhaps", "compile must be true or false, got 'perhaps'."),
    ("gamma=nan", "gamma must be >= 0 and <= 1, got nan."),
    (
        "evaluation=3",
        "evaluation must be a mapping of episodes, num_envs, drivers, draw, draw_most, draw_format, got 3.",
    ),
    ("lagrange.multiplier=3", "lagrange.multiplier must be a mapping of _target_, "),
    ("task.reward=3", "task.reward must be a mapping of reading, risk_shaping, "),
    ("+task.reward.weights=[1,2]", "reward.weights must be 6 numbers, got [1, 2]."),
    ("+task.reward.energy=[1]", "reward.energy must be a list of 2, each a number, got [1]."),
    (
        "+task.reward.smoothness=[1,2,3]",
        "reward.smoothness must be a list of 2, each a number, got [1, 2, 3].",
    ),
    ("+task.cost.growth=[1]", "cost.growth must be a list of 2, each a number, got [1]."),
    ("+task.cost.growth=[2,1]", "cost.growth must be 2 numbers with 0 < first <= last, got [2, 1]"),
    ("+task.cost.growth=[0,1]", "cost.growth must be 2 numbers with 0 < first <= last, got [0, 1]"),
    ("+task.cost.decay=nan", "task.cost.decay must be finite, got nan."),
    ("+task.reward.weights=[1,1,1,1,1,-inf]", "task.reward.weights[5] must be finite, got -inf."),
    ("+task.traffic.gap=inf", "task.traffic.gap must be finite, got inf."),
    ("task.duration=nan", "task.duration must be finite, got nan."),
    ("projector.limit=inf", "projector.limit must be finite, got inf."),
    ("+task.reward.collision=1", "reward.collision must be <= 0, got 1."),
    ("+task.reward.arrival=-1", "reward.arrival must be >= 0, got -1."),
    ("task.duration=0.05", "duration must be at least a decision, 0.2 seconds, got 0.05."),
    ("task.vehicles=1 task.rows=1", "rows must be >= 2 with traffic, got 1: one row is always"),
    ("algo_name=foo/bar", "algo_name must be without / and \\, got 'foo/bar'."),
    ("cost_critic.outputs=0", "cost_critic.outputs must be >= 1, got 0."),
    ("critic.layer_norm=abc", "critic.layer_norm must be true or false, got 'abc'."),
    ("learning.updates_per_frame=0", "learning.updates_per_frame must be > 0, got 0.0."),
    (
        "learning.buffer_size=8 env.num_envs=9",
        "buffer_size must be >= env.num_envs * learning.frames_per_env, got 8 and 9.",
    ),
    ("save_minutes=0", "save_minutes must be > 0, got 0.0."),
]


@pytest.mark.parametrize(("arguments", "message"), MISTAKES, ids=[m[0] for m in MISTAKES])
def test_mistake_is_one_line_and_leaves_nothing(arguments, message, refusal, tmp_path: Path):
    line = refusal("train", "config", *SMALL, *EMPTY, *arguments.split())
    assert message in line
    assert not list(tmp_path.iterdir())


def test_a_test_refuses_what_is_not_finite(refusal, tmp_path: Path):
    line = refusal("evaluate", "evaluate", "policy=blind", "task.duration=inf")
    assert "task.duration must be finite, got inf." in line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("algo", ["arsac", "sac"])
def test_a_number_in_place_of_settings_is_refused(algo: str):
    """Wherever it can stand: for a group itself Hydra takes the name of a file alone."""

    def mappings(node: DictConfig, path: str = ""):
        for key, value in node.items():
            if isinstance(value, DictConfig):
                yield f"{path}{key}"
                yield from mappings(value, f"{path}{key}.")

    for name in mappings(compose(f"algo={algo}")):
        if (Path(config_dir()) / name).is_dir():
            continue
        cfg = compose(f"algo={algo}")
        OmegaConf.set_struct(cfg, False)
        try:
            OmegaConf.update(cfg, name, 3, merge=False)
        except ValidationError:  # the schema
            continue
        with pytest.raises(ValueError, match=rf"{name}\S* must be .*, got "):
            check(cfg)


def test_classes_refuse_what_is_no_number():
    """Without a configuration, too."""
    for kind, values in (
        (Reward, {"collision": math.nan, "arrival": math.nan, "energy": (0.1,)}),
        (CollisionCost, {"growth": (math.nan, 1.0)}),
        (Scenario, {"duration": math.inf, "rows": 1}),
    ):
        for key, value in values.items():
            with pytest.raises(ValueError, match=f"{key} must be "):
                kind(**{key: value})
    assert Scenario(rows=1, vehicles=0).rows == 1
    assert Scenario(duration=0.2).horizon == 1
    assert CollisionCost(growth=(1.2, 1.2)).growth == (1.2, 1.2)


def test_metrics_are_json_that_everything_reads(tmp_path: Path):
    row = dict.fromkeys((name.removesuffix("_rate") for name in FIGURES), 0.0)
    row["intervention_rate"] = 0.0
    write([row], tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text())["return"]["mean"] == 0.0
    with pytest.raises(ValueError, match="not JSON compliant"):
        write([{**row, "return": math.nan}], tmp_path)


def test_a_test_plays_hardly_more_episodes_than_it_needs(command, tmp_path: Path, monkeypatch):
    made = []

    def build(node, task, num_envs, *others):
        made.append(num_envs)
        return build_env(node, task, num_envs, *others)

    monkeypatch.setattr("saferl.cli.evaluate.build_env", build)
    options = ("env=batched", "task.vehicles=0", "task.duration=1")
    command(
        "evaluate", "evaluate", "policy=blind", *options, "episodes=7", "env.num_envs=6", "out=test"
    )
    assert made == [4]  # two rounds, as of 6
    assert (tmp_path / "test/episodes.csv").read_text().count("\n") == 8
