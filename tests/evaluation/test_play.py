"""Tests of policies: the same episodes whatever plays beside them, and the figures of each."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from pathlib import Path

import hydra
import pytest
import torch
from omegaconf import OmegaConf
from small import EMPTY, SMALL, compose
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv

from saferl.algorithms.assemble import build_trainer
from saferl.algorithms.policy import trained_agent
from saferl.checkpoint.run import CONFIG, export
from saferl.cli.evaluate import on_its_own_task
from saferl.envs.intersection import (
    BatchedIntersection,
    CollisionCost,
    HighwayIntersection,
    IntersectionEnv,
    Reward,
    Scenario,
)
from saferl.envs.intersection.drivers import CautiousDriver, Driver, RandomDriver
from saferl.envs.seeding import episode_seeds
from saferl.envs.transforms import SafetyProjector, Shield
from saferl.evaluation.play import evaluate
from saferl.evaluation.rows import write
from saferl.evaluation.statistics import FIGURES

ROAD = Scenario(task="mixed", vehicles=0, policy_frequency=10)
TRAFFIC = Scenario(task="gs", vehicles=4, policy_frequency=5, duration=12.0)


def same(ours: list[dict], theirs: list[dict]) -> bool:
    """Equal rows; sums to float32 rounding, which may differ in the last lanes of a vector unit."""
    exact = ("episode", "seed", "route", "collision", "success", "decisions")
    sums = ["return", "speed", "cost_return", "min_distance"]
    sums += [key for key in ("intervention_rate", "correction") if key in ours[0]]
    return len(ours) == len(theirs) and all(
        [one[key] for key in exact] == [other[key] for key in exact]
        and [one[key] for key in sums] == pytest.approx([other[key] for key in sums], rel=1e-5)
        for one, other in zip(ours, theirs, strict=True)
    )


def wary() -> SafetyProjector:
    """Corrects whatever accelerates, to a point that does not depend on rounding."""
    risk = TensorDictModule(lambda action: action[..., :1], ["action"], ["risk"])
    return SafetyProjector(risk, limit=0.5, steps=5, penalty=1e6)


@pytest.mark.parametrize("projected", [False, True])
@pytest.mark.parametrize(
    ("kind", "scenario", "driver"),
    [(BatchedIntersection, ROAD, Driver), (HighwayIntersection, TRAFFIC, CautiousDriver)],
)
def test_an_episode_is_a_function_of_its_seed_alone(kind, scenario, driver, projected):
    """Of neither the number nor the seed of the environments, with transforms as without."""

    brief = dataclasses.replace(scenario, duration=4.0)

    def rows(num_envs: int, env_seed: int, seed: int, count: int) -> list[dict]:
        env = kind(brief, num_envs=num_envs, seed=env_seed)
        env = TransformedEnv(env, wary()) if projected else env
        return evaluate(driver(), env, count, seed=seed, progress=False)

    alone, beside = rows(1, 5, seed=3, count=4), rows(3, 9, seed=3, count=4)
    assert same(alone, beside)
    assert same(beside[:2], rows(2, 5, seed=3, count=2))
    assert [row["episode"] for row in alone] == [0, 1, 2, 3]
    assert len({row["return"] for row in alone}) == 4
    assert rows(2, 5, seed=4, count=1)[0]["seed"] != alone[0]["seed"]
    assert any(row.get("intervention_rate", 0.0) > 0 for row in alone) == projected


def test_figures_against_gymnasium_by_hand():
    """The same episode through the gymnasium environment, summed in a plain loop."""
    row = evaluate(
        Driver(), HighwayIntersection(TRAFFIC, num_envs=2, seed=0), 1, seed=7, progress=False
    )[0]
    env = IntersectionEnv(task="gs", vehicles=4, policy_frequency=5, duration=12.0)
    observation, info = env.reset(seed=row["seed"])
    rewards, costs, speeds, distances, done = [], [], [], [], False
    route = torch.tensor([[["lt", "gs_inner", "gs_outer", "rt"].index(info["route"])]])
    while not done:
        inputs = {key: torch.from_numpy(value)[None] for key, value in observation.items()}
        action = Driver()(TensorDict({**inputs, "route": route}, [1]))["action"][0]
        observation, reward, terminated, truncated, info = env.step(action.numpy())
        rewards.append(reward)
        costs.append(info["cost"])
        own = dict(zip(env.scenario.form.ego, observation["ego"].tolist(), strict=True))
        speeds.append(math.hypot(own["v_x"], own["v_y"]))
        distances.append(own["d_veh"])
        done = terminated or truncated
    assert row["decisions"] == len(rewards)
    assert row["return"] == pytest.approx(sum(rewards), rel=1e-5)
    assert row["cost_return"] == pytest.approx(sum(costs), rel=1e-5, abs=1e-7)
    assert row["speed"] == pytest.approx(sum(speeds) / len(speeds), rel=1e-5)
    assert row["min_distance"] == pytest.approx(max(min(distances), 0.0), rel=1e-5)
    assert row["route"] == info["route"]
    for key, flag in (
        ("hit_vehicle", "collision"),
        ("left_road", "offroad"),
        ("success", "success"),
    ):
        assert row[key] == info[flag]
    assert row["collision"] == (info["collision"] or info["offroad"])
    assert row["collision"] + row["success"] + row["frozen"] == 1


def test_conditions_of_a_test():
    """10 Hz, starts before the box, parked cars left alone, reward without r_safe."""
    training = Scenario(route_starts=0.5, standstill=8.0, reward=Reward(risk_shaping=True))
    scenario = training.as_test()
    assert scenario == Scenario(policy_frequency=10)
    rows = evaluate(
        TensorDictModule(lambda ego: ego[..., :2] * 0 + torch.tensor([-1.0, 0.0]), ["ego"], ["action"]),
        BatchedIntersection(Scenario(vehicles=0, duration=8.0).as_test(), num_envs=6, seed=0),
        6, seed=0, progress=False,
    )  # fmt: skip
    # Braking at once: all stay on the approach, stand there, and play on to the limit.
    assert all(row["frozen"] == 1 and row["decisions"] == 80 for row in rows)


def test_interventions_are_shares_of_decisions():
    """A risk above the limit for ever: every decision is corrected, by the whole reach."""
    risk = TensorDictModule(lambda action: 10 + action[..., :1], ["action"], ["risk"])
    projector = SafetyProjector(risk, limit=0.0, steps=5, step_size=0.02, penalty=1e6)
    env = TransformedEnv(BatchedIntersection(ROAD, num_envs=2, seed=0), projector)
    rows = evaluate(Driver(), env, 2, seed=0, progress=False)
    assert all(row["intervention_rate"] == pytest.approx(1.0, abs=0.1) for row in rows)
    plain = evaluate(
        Driver(), BatchedIntersection(ROAD, num_envs=2, seed=0), 2, seed=0, progress=False
    )
    assert not any("intervention_rate" in row or "correction" in row for row in plain)


def test_each_fallback_of_a_shield_is_counted():
    env = TransformedEnv(BatchedIntersection(TRAFFIC, num_envs=4, seed=2), Shield())
    rows = evaluate(Driver(), env, 4, seed=2, progress=False)  # blind to traffic
    drove = [
        [row[f"fallback_{name}"] for name in ("brake", "hold", "cautious", "go")] for row in rows
    ]
    assert any(share[0] > 0 for share in drove)
    for row, shares in zip(rows, drove, strict=True):
        assert sum(shares) == pytest.approx(row["intervention_rate"], abs=1e-12)


def test_nothing_after_the_end_counts():
    """In a batch the others play on; a wreck may meanwhile be anywhere, at any speed."""
    rows = evaluate(
        RandomDriver(seed=1),
        BatchedIntersection(ROAD, num_envs=8, seed=0),
        8,
        seed=0,
        progress=False,
    )
    assert len({row["decisions"] for row in rows}) > 1
    assert all(0 < row["speed"] < 20 and abs(row["return"]) < 1000 for row in rows)


def test_write(tmp_path: Path):
    rows = evaluate(
        Driver(), BatchedIntersection(ROAD, num_envs=3, seed=0), 3, seed=0, progress=False
    )
    figures = write(rows, tmp_path / "new", policy="blind", seed=0)
    stored = json.loads((tmp_path / "new/metrics.json").read_text())
    assert {key: stored[key] for key in figures} == figures and stored["policy"] == "blind"
    assert all(0 <= stored[key]["mean"] <= 1 for key in figures if key.endswith("_rate"))
    lines = (tmp_path / "new/episodes.csv").read_text().splitlines()
    assert len(lines) == 4 and lines[0].startswith("episode,seed,route,collision")
    with pytest.raises(ValueError, match="episodes must be >= 1"):
        evaluate(Driver(), BatchedIntersection(ROAD, num_envs=1, seed=0), 0, seed=0)


def test_a_runs_closing_test_is_the_evaluation_of_its_checkpoint(tmp_path: Path, command):
    """Training and testing agree (a peer's did not, docs/pitfalls.md, 11): same policy, episodes and figures,
    on the run's own task, whose reward is not the default one here."""
    task = (*EMPTY, "task=rt", "task.duration=2", "task.rows=4")
    algo = ("algo=rsac", "projector.steps=5", "experiment=paper")
    command("train", "config", *SMALL, *algo, *task, "evaluation.episodes=3", "out=run")
    command("evaluate", "evaluate", "checkpoint=run", "episodes=3", "out=test")
    ours, theirs = (
        json.loads((tmp_path / name / "metrics.json").read_text())
        for name in ("run/evaluation", "test")
    )
    for name in FIGURES:
        assert ours[name] == pytest.approx(theirs[name], rel=1e-4), name
    about = set(ours) - set(FIGURES) - {"policy"}
    assert {key: ours[key] for key in about} == {key: theirs[key] for key in about}
    assert ours["reading"] == "raw" and ours["rows"] == 4 and ours["scenario"] == "nominal"
    assert ours["policy_frequency"] == 10 and ours["project"] is True and ours["vehicles"] == 0

    command("export", "export", "checkpoint=run", "out=policy")
    command("evaluate", "evaluate", "checkpoint=policy", "episodes=3", "out=again")
    again = json.loads((tmp_path / "again/metrics.json").read_text())
    assert all(again[name] == theirs[name] for name in FIGURES)


def test_a_training_ends_beside_the_drivers_that_it_names_and_with_pictures(
    tmp_path: Path, command, capsys
):
    beside = (
        "evaluation.drivers=[blind,scripted]",
        "evaluation.episodes=3",
        "evaluation.draw=all",
        "evaluation.draw_most=1",
    )
    command("train", "config", *SMALL, *EMPTY, "algo=sac", "task.duration=2", *beside, "out=run")
    command(
        "evaluate", "evaluate", "policy=blind", *EMPTY, "task.duration=2", "episodes=3", "out=b"
    )
    ours, theirs = (
        json.loads((tmp_path / name / "metrics.json").read_text())
        for name in ("run/evaluation/blind", "b")
    )
    assert all(ours.get(name) == theirs.get(name) for name in FIGURES)
    assert (tmp_path / "run/evaluation/episode_0.gif").is_file()
    drawn = [path.name for path in (tmp_path / "run/evaluation").glob("*.png")]
    assert drawn == ["episode_0.png"]
    text = capsys.readouterr().out.partition("The same 3 episodes of gs")[2]
    rows = [line.split()[0] for line in text.splitlines()[2:5]]
    assert rows == ["sac", "blind", "scripted"] and "SR %" in text


@pytest.mark.parametrize(
    ("asked", "column", "most"),
    [("collisions", "collision", 1), ("frozen", "frozen", 9), ("all", None, 2)],
)
def test_a_test_draws_the_first_of_the_episodes_that_are_asked_for(
    asked: str, column: str | None, most: int, tmp_path: Path, command, capsys
):
    traffic = ("policy=blind", "task=gs", "env.num_envs=8", "episodes=8", "draw_format=png")
    command("evaluate", "evaluate", *traffic, f"draw={asked}", f"draw_most={most}", "out=test")
    rows = [*csv.DictReader((tmp_path / "test/episodes.csv").open())]
    found = [row["episode"] for row in rows if column is None or row[column] == "1"]
    names = {path.name for path in (tmp_path / "test").glob("*.png")}
    assert names == {f"episode_{number}.png" for number in found[:most]}
    told = f"draw={asked}: {len(found)} of 8 episodes" in capsys.readouterr().out
    assert told == (len(found) > most or not found)


def test_a_test_draws_episodes_by_their_numbers(tmp_path: Path, command):
    short = ("policy=blind", *EMPTY, "task.duration=1", "episodes=4", "draw_format=png")
    for asked, numbers in (("2", {2}), ("[3,1]", {1, 3})):
        command("evaluate", "evaluate", *short, f"episode={asked}", f"out=test{asked}")
        names = {path.name for path in (tmp_path / f"test{asked}").glob("*.png")}
        assert names == {f"episode_{number}.png" for number in numbers}


def test_without_its_package_an_mp4_is_refused_with_the_command_that_installs_it(
    refusal, monkeypatch, tmp_path: Path
):
    monkeypatch.setattr("saferl.config.ranges.find_spec", lambda name: None)
    line = refusal("evaluate", "evaluate", "policy=blind", "draw=all", "draw_format=mp4")
    assert line.endswith("draw_format=mp4 needs imageio-ffmpeg: pip install 'saferl[video]'.")
    line = refusal("train", "config", "evaluation.draw_format=mp4")
    assert line.startswith("error: evaluation.draw_format=mp4 needs imageio-ffmpeg")
    assert not [*tmp_path.iterdir()]


def test_the_command_line_alone_changes_a_runs_own_task():
    trained = compose("experiment=paper", "algo=sac_rs", *EMPTY, "task.rows=4", "task=gs")
    own = Scenario(
        task="gs", vehicles=0, rows=4, policy_frequency=10, observation="world",
        reward=Reward(reading="raw", destination_scale=100.0), cost=CollisionCost(crash=0.0),
    )  # fmt: skip
    overrides: dict[tuple[str, ...], dict] = {
        (): {},
        ("task=lt",): {"task": "lt"},
        ("task.vehicles=7", "episodes=3"): {"vehicles": 7},
        ("task.policy_frequency=5", "task.route_starts=0.5"): {
            "policy_frequency": 5,
            "route_starts": 0.5,
        },
        ("task.test_frequency=5",): {"test_frequency": 5, "policy_frequency": 5},
        ("task.reward.reading=normalised",): {"reward": Reward(destination_scale=100.0)},
        ("task.scenario=dense", "task.vehicles=null"): {"scenario": "dense", "traffic": {}},
        ("+task.reward.risk_shaping=true",): {
            "reward": dataclasses.replace(own.reward, risk_shaping=True)
        },
    }
    for given, changes in overrides.items():
        cfg = on_its_own_task(compose(*given, config="evaluate"), trained, given)
        if "scenario" in changes:
            changes = {**changes, "vehicles": None}
        assert hydra.utils.instantiate(cfg.task) == dataclasses.replace(own, **changes), given
        assert cfg.env._target_.endswith("BatchedIntersection") and cfg.env.num_envs == 100
    given = ("env=highway", "env.num_envs=3")
    cfg = on_its_own_task(compose(*given, config="evaluate"), trained, given)
    assert cfg.env._target_.endswith("HighwayIntersection") and cfg.env.num_envs == 3


@pytest.mark.parametrize("backend", ["batched", "highway"])
def test_a_test_takes_the_runs_backend_and_sets_it_itself(backend: str):
    """A run of 256 compiled environments is not compiled again to be tested, unless asked for."""
    compiles = ("env.compile_physics=true",) if backend == "batched" else ()
    trained = compose("algo=sac", f"env={backend}", "env.num_envs=256", *compiles)
    OmegaConf.set_struct(trained, False)  # as a run's own file is read
    cfg = on_its_own_task(compose(config="evaluate"), trained, ())
    assert cfg.env._target_ == trained.env._target_ and cfg.env.num_envs == 100
    assert not cfg.env.get("compile_physics", False)
    if compiles:
        cfg = on_its_own_task(compose(*compiles, config="evaluate"), trained, compiles)
        assert cfg.env.compile_physics


def test_a_checkpoints_projector_acts_as_it_did_in_training(tmp_path: Path):
    """Not at all before its start, in an exported policy as in the run."""
    cfg = compose(*SMALL, *EMPTY, "algo=rsac", "projector.start=0.5")
    trainer = build_trainer(cfg, tmp_path / "run")
    trainer.save()
    OmegaConf.save(cfg, tmp_path / "run" / CONFIG, resolve=True)
    early = export(tmp_path / "run", tmp_path / "early")
    assert [bool(t.enabled) for t in trained_agent(cfg, early).transforms] == [False]
    assert [bool(t.enabled) for t in trained_agent(cfg, tmp_path / "run").transforms] == [False]
    trainer.train()
    late = export(tmp_path / "run", tmp_path / "late")
    assert [bool(t.enabled) for t in trained_agent(cfg, late).transforms] == [True]
    assert [bool(t.enabled) for t in trained_agent(cfg, tmp_path / "run").transforms] == [True]


def test_tests_do_not_mix(tmp_path: Path, command, refusal):
    """A folder of its own by default; a given one that holds a test is refused."""
    arguments = ("evaluate", "evaluate", "policy=blind", *EMPTY, "task=rt", "episodes=1")
    for _ in range(2):
        command(*arguments)
    first, second = (tmp_path / "evaluation/blind-rt-seed0").iterdir()
    assert {path.name for path in first.iterdir()} == {"metrics.json", "episodes.csv"}
    before = (second / "metrics.json").read_bytes()
    line = refusal(*arguments, "seed=3", f"out={second}")
    assert f"out: {second} holds a test already; take another folder." in line
    assert (second / "metrics.json").read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} == {"evaluation"}


def test_seeds_do_not_repeat():
    assert len(set(episode_seeds(0, 500).tolist()) | set(episode_seeds(1, 500).tolist())) == 1000
