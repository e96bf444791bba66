"""The commands as a user types them."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hydra
import pytest
import torch
from omegaconf import OmegaConf
from small import EMPTY, SMALL, compose

from saferl.algorithms.assemble import build_agent, build_trainer, load_agent
from saferl.checkpoint.lock import alone
from saferl.checkpoint.run import CONFIG, run_config

TRAIN, TEST, EXPORT = ("train", "config"), ("evaluate", "evaluate"), ("export", "export")


def mistakes() -> Iterator[Any]:
    """Commands, arguments and messages of mistakes.txt."""
    command = ""
    for row in Path(__file__).with_name("mistakes.txt").read_text().splitlines()[1:]:
        if row.startswith("["):
            command = row.strip("[]")
        elif row and not row.startswith("#"):
            arguments, message = row.split("->", 1)
            given = arguments.replace("(nothing)", "").split()
            yield pytest.param(command, given, message.strip(), id=" ".join([command, *given]))


@pytest.mark.parametrize(("command_name", "arguments", "message"), [*mistakes()])
def test_mistake_is_one_line_and_leaves_nothing(
    command_name, arguments, message, refusal, tmp_path: Path
):
    config = "config" if command_name == "train" else command_name
    assert message in refusal(command_name, config, *arguments)
    assert not list(tmp_path.iterdir())


def test_missing_logger_is_named(refusal, monkeypatch):
    """Whether or not W&B is installed here."""

    def instantiate(node, **kwargs):
        if "Wandb" in str(node.get("_target_")):
            raise ImportError("wandb could not be imported")
        return real(node, **kwargs)

    real = hydra.utils.instantiate
    monkeypatch.setattr(hydra.utils, "instantiate", instantiate)
    line = refusal(*TRAIN, "logger=wandb", "encoder.width=16")
    assert "WandbLogger needs a package that is not installed" in line and "pip install" in line


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of SAC on an empty road."""
    folder = tmp_path_factory.mktemp("run")
    cfg = compose(*SMALL, *EMPTY, "algo=sac", "task.rows=2")
    build_trainer(cfg, folder).train()
    OmegaConf.save(cfg, folder / CONFIG, resolve=True)
    return folder


def test_a_run_is_not_written_over_nor_reconfigured(run: Path, refusal):
    assert "holds a run already; continue it with resume=" in refusal(*TRAIN, f"out={run}")
    line = refusal(*TRAIN, f"resume={run}", "gamma=0.9", "out=x")
    assert "takes no other option than a larger frames=, got gamma=0.9, out=x" in line
    line = refusal(*TRAIN, *SMALL, *EMPTY, f"init={run}", "algo=sac", "encoder.width=24")
    assert "task.rows is 2 there and 11 here, encoder.width is 16 there and 24 here" in line
    assert "task.rows must be 2" in refusal(*TEST, f"checkpoint={run}", "task.rows=3")


@pytest.mark.parametrize("algo", ["sac", "rsac"])
def test_init_begins_from_the_networks_alone(algo: str, run: Path, tmp_path: Path):
    """Of a run without cost critics too; the settings are those of the new configuration."""
    options = (
        "gamma=0.5",
        "risk_limit=0.3",
        "learning.alpha_init=0.7",
        "learning.target_entropy=-1",
    )
    new = compose(*SMALL, *EMPTY, f"algo={algo}", "task.rows=2", "seed=9", *options, f"init={run}")
    trainer = build_trainer(new, tmp_path)
    ours = trainer.learner.loss.state_dict()
    theirs = load_agent(run_config(run), run, "x").loss.state_dict()
    fresh = build_agent(new).loss.state_dict()
    for name in (key for key in ours if isinstance(ours[key], torch.Tensor)):
        if "network_params" in name:  # a new run's targets begin as copies of the networks
            assert (ours[name] == theirs[name.removeprefix("target_")]).all(), name
        elif "cost_critic_params" not in name:  # these begin at random
            assert (ours[name] == fresh[name]).all(), name
    assert float(ours["log_alpha"].exp()) == pytest.approx(0.7)
    assert ours["_value_estimator.gamma"] == 0.5
    assert algo == "sac" or ours["risk_limit"] == pytest.approx(0.3)
    assert trainer.progress.frames == 0 and trainer.collector.init_random_frames == 0


def test_init_among_on_policy_algorithms(tmp_path: Path, refusal):
    """Both values are taken over; weights that were trained with another activation are not."""
    first = tmp_path / "first"
    tanh, limits = "encoder.activation.path=torch.nn.Tanh", ("cost_limit=1", "risk_limit=1")
    cfg = compose(*SMALL, "algo=ppo_lag", tanh, "task=cart", *limits)
    build_trainer(cfg, first).train()
    OmegaConf.save(cfg, first / CONFIG, resolve=True)
    theirs = load_agent(run_config(first), first, "x").loss.state_dict()

    options = ("algo=cpo", tanh, "task=cart", *limits, "seed=9", f"init={first}")
    ours = build_trainer(compose(*SMALL, *options), tmp_path / "x").learner.loss.state_dict()
    networks = [key for key in ours if "_params." in key and "target_" not in key]
    assert {key.split(".")[0] for key in networks} == {
        "actor_network_params", "critic_network_params", "cost_critic_params"
    }  # fmt: skip
    for key in networks:
        assert not isinstance(ours[key], torch.Tensor) or torch.equal(ours[key], theirs[key]), key
    for algo in ("cpo", "sac"):
        line = refusal(*TRAIN, *SMALL, f"algo={algo}", "task=cart", "cost_limit=1", f"init={first}")
        assert "do not fit: encoder." in line and "torch.nn.Tanh" in line


def test_two_processes_do_not_work_on_one_run(tmp_path: Path, refusal, spawn):
    """The second is told who holds it; a process that was killed holds nothing."""
    options = (*SMALL, *EMPTY, "algo=sac", "frames=1000000", "save_every=8", "out=run")
    first = spawn("saferl", *options)
    while not list((tmp_path / "run/checkpoints").glob("checkpoint-*")):
        assert first.poll() is None, first.communicate()
        time.sleep(0.05)
    line = refusal(*TRAIN, "resume=run")
    assert f"resume: process {first.pid} on " in line and "wait until it ends, or stop it" in line
    first.kill()
    first.wait()
    with alone(tmp_path / "run", "resume"):
        assert f"process {os.getpid()} on" in refusal(*TRAIN, "resume=run")
    assert not (tmp_path / "run/.holder").exists()


def test_the_file_of_a_run_is_checked_again_when_it_goes_on(tmp_path: Path, refusal):
    """Somebody may have edited it."""
    run = tmp_path / "run"
    cfg = compose(*SMALL, "algo=sac", "task=cart")
    build_trainer(cfg, run).save()
    for key, value, words in (
        ("gamma", 2.0, "gamma must be >= 0 and <= 1, got 2.0"),
        ("seed", "one", "seed must be a whole number, got 'one'"),
        ("learning.tau", 3.0, "learning.tau must be >= 0 and <= 1, got 3.0"),
        ("gamma", "0.9", "gamma must be a number, got '0.9'"),
        ("record_every", "8", "record_every must be a whole number, got '8'"),
        ("learning.tau", "0.1", "learning.tau must be a number, got '0.1'"),
        ("gama", 0.5, "unknown key gama; did you mean gamma?"),
        ("learning.tua", 0.5, "unknown key learning.tua"),
        ("gamma", None, "gamma is missing"),
        ("learning.tau", None, "learning.tau is missing"),
        ("encoder._target_", None, "encoder._target_ is missing"),
    ):
        edited = OmegaConf.create(OmegaConf.to_container(cfg, resolve=True))
        OmegaConf.update(edited, key, value)
        if value is None:
            parent, _, name = f".{key}".rpartition(".")
            (OmegaConf.select(edited, parent.strip(".")) if parent else edited).pop(name)
        OmegaConf.save(edited, run / CONFIG)
        assert words in refusal(*TRAIN, f"resume={run}")


def test_a_test_does_not_change_a_task_that_is_not_the_roads(tmp_path: Path, refusal):
    run = tmp_path / "run"
    cfg = compose(*SMALL, "algo=sac", "task=cart")
    build_trainer(cfg, run).save()
    OmegaConf.save(cfg, run / CONFIG, resolve=True)
    for option, words in (
        ("task=lt", "task: this policy's task is cart, which a test does not change"),
        ("task.scenario=dense", "task.scenario: this policy's task is cart"),
        ("draw=all", "draw must be none and episode null, as task=cart draws no pictures"),
        ("episode=1", "draw must be none and episode null, as task=cart draws no pictures"),
        ("trace=all", "trace must be none and why false, as task=cart is not the road"),
    ):
        assert words in refusal(*TEST, f"checkpoint={run}", option, "episodes=2", "out=test")
    assert not (tmp_path / "test").exists()


def test_init_of_another_algorithm(run: Path, tmp_path: Path, refusal):
    """SAC begun from a constrained run; an MLP from attention is refused by the options."""
    constrained = tmp_path / "constrained"
    cfg = compose(*SMALL, *EMPTY, "algo=rsac", "task.rows=2")
    build_trainer(cfg, constrained).save()
    OmegaConf.save(cfg, constrained / CONFIG, resolve=True)
    trainer = build_trainer(
        compose(*SMALL, *EMPTY, "algo=sac", "task.rows=2", f"init={constrained}"), tmp_path / "x"
    )
    ours, theirs = trainer.learner.loss, load_agent(cfg, constrained, "x").loss
    assert (ours.actor_network_params == theirs.actor_network_params).all()

    options = (*TRAIN, *SMALL, *EMPTY, "algo=rsac", "task.rows=2", f"init={constrained}")
    for option, told in (
        ("critic.layer_norm=true", "critic.layer_norm is False there and True here."),
        ("cost_critic=quantile", "cost_critic.outputs is 1 there and 16 here."),
        ("critic=ensemble", "critic.members is 2 there and 4 here."),
    ):
        assert f"do not fit: {told}" in refusal(*options, option)

    line = refusal(*TRAIN, *SMALL, *EMPTY, f"init={run}", "algo=asac", "task.rows=3")
    assert "task.rows is 2 there and 3 here" in line
    assert "encoder._target_ is saferl.modules.MLP there and" in line


def test_run_folder_has_a_name_that_shells_like(command, tmp_path: Path):
    command(*TRAIN, *SMALL, *EMPTY, "algo=sac", "frames=8", "seed=3")
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name == "sac-gs-seed3"
    (run,) = folder.iterdir()
    assert "=" not in str(run.relative_to(tmp_path)) and (run / "metrics.csv").is_file()


@pytest.mark.parametrize("policy", ["random", "blind", "scripted"])
def test_evaluate_a_driver(policy: str, command, tmp_path: Path):
    command(*TEST, f"policy={policy}", *EMPTY, "episodes=3", "seed=2", "task=rt", "out=there")
    figures = json.loads((tmp_path / "there/metrics.json").read_text())
    assert "intervention_rate" not in figures  # there is no projector
    for name in (
        "collision_rate", "success_rate", "frozen_rate", "return", "speed", "cost_return",
    ):  # fmt: skip
        assert set(figures[name]) == {"mean", "low", "high"}
        assert figures[name]["low"] <= figures[name]["mean"] <= figures[name]["high"]
        assert not name.endswith("_rate") or 0 <= figures[name]["low"] <= figures[name]["high"] <= 1
    assert figures["success_rate"]["mean"] == (0.0 if policy == "random" else 1.0)
    assert (tmp_path / "there/episodes.csv").read_text().count("\n") == 4


def test_help_lists_groups_and_settings(command, capsys):
    with pytest.raises(SystemExit) as left:
        command(*TRAIN, "--help")
    assert not left.value.code
    text = capsys.readouterr().out
    assert "python -m saferl algo=arsac task=gs" in text and "gamma: 0.99" in text
    assert "algo: arppo, arsac, arsac_plus, arsac_signed, arsac_unprojected, asac, cat, cpo" in text


def test_a_mistake_in_a_process_of_its_own(spawn, tmp_path: Path):
    process = spawn("saferl", "gamma=1.2", "out=run")
    out, err = process.communicate(timeout=300)
    assert process.returncode == 1 and out == ""
    assert err == "error: gamma must be >= 0 and <= 1, got 1.2.\n"
    assert list(tmp_path.iterdir()) == []


def test_a_buffer_that_cannot_fit_is_refused(refusal, monkeypatch):
    """With what a transition takes: 9 + 66 numbers of either state and what else is kept of it."""
    monkeypatch.setattr("saferl.training.experience.memory", lambda: 2**20)
    options = (*TRAIN, *SMALL, *EMPTY, "algo=sac", "task.observation=world", "task.rows=11")
    line = refusal(*options, "learning.buffer_size=3000")
    found = re.search(
        r"learning.buffer_size must be <= (\d+), got 3000: a transition takes (\d+)", line
    )
    assert found and int(found[1]) == 2**20 // int(found[2]) and "cpu has 0.0 GiB" in line
    assert 4 * 2 * (9 + 66) < int(found[2]) < 4 * 2 * (9 + 66) + 100
    line = refusal(*TRAIN, *SMALL, *EMPTY, "algo=ppo", "learning.rollout_frames=9000")
    assert "learning.rollout_frames must be <= " in line
