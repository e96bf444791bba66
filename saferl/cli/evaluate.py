"""Test a policy, and draw its first episodes."""

from __future__ import annotations

import json
import logging
import statistics
from collections.abc import Sequence
from contextlib import closing
from datetime import datetime
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.transforms import Transform

from saferl.algorithms.assemble import build_env, load_agent
from saferl.algorithms.parts import device_of, make, offered
from saferl.checkpoint.run import progress, run_config
from saferl.cli.launch import job_folder
from saferl.config.check import check_targets
from saferl.config.locate import pretrained_run
from saferl.envs.task import Task
from saferl.evaluation.play import envs_at_once
from saferl.evaluation.play import evaluate as play_episodes
from saferl.evaluation.rows import write
from saferl.evaluation.statistics import table
from saferl.training.progress import Budget

log = logging.getLogger(__name__)


def pictures(
    env: DictConfig,
    task: Task,
    policy: TensorDictModuleBase,
    transforms: Sequence[Transform],
    rows: list[dict],
    out: Path,
    device: str,
) -> None:
    """An animation and a figure of each of these episodes of a test."""
    if not rows:
        return
    with closing(build_env(env, task, 1, 0, device_of(device), transforms)) as alone:
        for row in rows:
            log.info("%s", task.draw(policy, alone, row, out))


def evaluate(cfg: DictConfig) -> None:
    """Test a policy that the configuration names, and draw its first episodes."""
    check_targets(cfg)
    torch.set_num_threads(cfg.threads)
    OmegaConf.resolve(cfg)
    cfg, task, policy, transforms, name, about = choose_policy(cfg)
    if cfg.gif and not task.pictures:
        raise ValueError(f"gif must be 0, as task={task.task} draws no pictures, got {cfg.gif}.")
    title = f"{name.partition(' ')[0]}-{task.task}-seed{cfg.seed}"
    folder = f"evaluation/{title}/{datetime.now():%Y-%m-%d_%H-%M-%S-%f}"
    out = job_folder() or Path(folder if cfg.out is None else str(cfg.out))
    if (out / "metrics.json").exists():
        raise ValueError(f"out: {out} holds a test already; take another folder.")
    rows = measure(
        cfg.env,
        task,
        policy,
        transforms,
        out=out,
        num_envs=cfg.env.num_envs,
        episodes=cfg.episodes,
        seed=cfg.seed,
        device=cfg.device,
        policy_name=name,
        **about,
    )
    pictures(cfg.env, task, policy, transforms, rows[: cfg.gif], out, cfg.device)


def compiling(cfg: DictConfig, on: bool) -> DictConfig:
    """A run's configuration with the physics and the projection compiled or not, as far as it has them."""
    cfg = cfg.copy()
    for part, key in (("env", "compile_physics"), ("projector", "compile")):
        if key in cfg[part]:
            cfg[part][key] = on
    return cfg


def trained_policy(cfg: DictConfig, path: Path) -> tuple[TensorDictModuleBase, list[Transform]]:
    """The policy of a run or checkpoint, with the projector that it drives with.

    Args:
        cfg: the run's configuration.
        path: the run or checkpoint.
    """
    agent = load_agent(cfg, path, "checkpoint")
    if agent.projector is None:
        return agent.actor, []
    if hasattr(agent.projector, "set_progress"):
        spent = Budget(cfg.episodes, cfg.frames).spent(**progress(path))
        agent.projector.set_progress(spent)
    return agent.actor, [agent.projector]


def on_its_own_task(cfg: DictConfig, trained: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """A test's configuration with the task and environment that a policy was trained with, under the conditions of a test.

    Args:
        cfg: the test's configuration as composed.
        trained: the run's configuration.
        overrides: the command line; what it says of task and environment stands. Of a choice
            ``task=lt`` only the name counts.

    Raises:
        ValueError: the command line changes a task that is of another kind than its own.
    """
    keys = [override.partition("=")[0].lstrip("+") for override in overrides]
    given = [key for key in keys if key.partition(".")[0] in ("task", "env")]
    other = cfg.task._target_ != trained.task._target_
    if other and given and given != ["env.num_envs"]:
        raise ValueError(
            f"{given[0]}: this policy's task is {trained.task.task}, which a test does not change."
        )
    test = cfg.copy()
    OmegaConf.set_struct(test, False)
    said = {key: OmegaConf.select(cfg, key) for key in keys if key.startswith(("task.", "env."))}
    if "task" in keys:
        said["task.task"] = cfg.task.task
    test.task = trained.task.copy()
    OmegaConf.set_struct(test.task, False)
    for key, value in said.items():  # what a test changes may follow from it
        OmegaConf.update(test, key, value)
    test.task.merge_with(make(test.task).in_tests)
    if "env" not in keys:
        # The backend is the run's; what the backends set alike, or this one sets too, is the test's.
        shared = {k: v for k, v in cfg.env.items() if k in trained.env and k != "_target_"}
        test.env = OmegaConf.merge(trained.env, shared)
    for key, value in said.items():
        OmegaConf.update(test, key, value)
    return test


def choose_policy(
    cfg: DictConfig,
) -> tuple[DictConfig, Task, TensorDictModuleBase, list[Transform], str, dict[str, Any]]:
    """A test's own configuration and task, the policy that it names, the transforms that this drives with,
    what to call it, and what is known of its training.

    Raises:
        ValueError: not exactly one source, an unknown name, or a policy for other observations.
    """
    given = {
        key: cfg[key] for key in ("checkpoint", "pretrained", "policy") if cfg[key] is not None
    }
    if len(given) != 1:
        got = " and ".join(f"{key}={value}" for key, value in given.items()) or "none of them"
        raise ValueError(
            "Give one of checkpoint=PATH, pretrained=NAME or policy=random|blind|scripted, "
            f"got {got}."
        )
    ((source, name),) = given.items()
    overrides = HydraConfig.get().overrides.task
    if source == "policy":
        cfg = on_its_own_task(cfg, cfg, overrides)
        task = make(cfg.task)
        return cfg, task, task.driver(name, cfg.seed), [], name, {}
    path = pretrained_run(name) if source == "pretrained" else Path(name)
    trained = run_config(path, source)
    check_targets(trained)
    trained.device = cfg.device
    cfg = on_its_own_task(cfg, trained, overrides)
    task, learned = make(cfg.task), make(trained.task)
    task.check_policy_of(learned)
    for key, value in offered(trained.encoder, learned).items():
        if task.network[key] != value:
            raise ValueError(
                f"task.{key} must be {value}, the number that this policy's network was trained with, "
                f"got {task.network[key]}."
            )
    policy, transforms = trained_policy(compiling(trained, cfg.compile), path)
    if not cfg.project:
        transforms = []
    called = f"{trained.algo_name} ({name})"
    return cfg, task, policy, transforms, called, {"cost_limit": trained.cost_limit}


def measure(
    env: DictConfig,
    task: Task,
    policy: TensorDictModuleBase,
    transforms: Sequence[Transform],
    *,
    out: Path,
    num_envs: int,
    episodes: int,
    seed: int,
    device: str,
    policy_name: str,
    **about: Any,
) -> list[dict]:
    """Play, write ``metrics.json`` (with what ``about`` says) and ``episodes.csv``, report the table; returns the rows."""
    at_once = envs_at_once(episodes, num_envs)
    with closing(build_env(env, task, at_once, seed, device_of(device), transforms)) as several:
        rows = play_episodes(policy, several, episodes, seed)
    latencies: list[float] = []
    for transform in transforms:  # free for another environment
        transform.reset_parent()
        latencies += getattr(transform, "latencies", [])
    backend = env._target_.rpartition(".")[2]
    figures = write(
        rows,
        out,
        policy=policy_name,
        env=backend,
        **task.describe(),
        project=bool(transforms),
        episodes=episodes,
        seed=seed,
        **about,
    )
    title = f"{policy_name}: {episodes} episodes of {task.title}"
    log.info("\n%s", table(figures, title, about.get("cost_limit")))
    if latencies:  # in a file of its own: the others are the same each time
        took = {"median": statistics.median(latencies), "longest": max(latencies)}
        timing = {name: round(1e3 * seconds, 3) for name, seconds in took.items()}
        timing |= {"corrections": len(latencies), "episodes_at_once": at_once}
        (out / "latency_ms.json").write_text(json.dumps(timing, indent=2) + "\n")
        log.info("A correction took %.1f ms, the longest %.1f ms.", *list(timing.values())[:2])
    log.info("Files: %s", out)
    return rows
