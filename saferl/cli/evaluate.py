"""Test a policy, and draw episodes of the test."""

from __future__ import annotations

import csv
import json
import logging
import statistics
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from saferl.algorithms.assemble import build_env
from saferl.algorithms.base import chain
from saferl.algorithms.parts import device_of, make, offered, takes
from saferl.algorithms.policy import compiling
from saferl.checkpoint.run import run_config
from saferl.cli.again import asked, is_there, keep
from saferl.cli.candidate import Candidate
from saferl.cli.launch import job_folder
from saferl.config.check import check_targets
from saferl.config.locate import pretrained_run
from saferl.envs.intersection import Scenario
from saferl.envs.intersection.true_scene import TrueScene
from saferl.envs.task import Task
from saferl.evaluation.crashes import COLUMNS as CRASH
from saferl.evaluation.crashes import explain
from saferl.evaluation.crashes import table as crash_table
from saferl.evaluation.play import envs_at_once
from saferl.evaluation.play import evaluate as play_episodes
from saferl.evaluation.progress import bar
from saferl.evaluation.rows import write
from saferl.evaluation.statistics import table
from saferl.evaluation.trace import record

log = logging.getLogger(__name__)


def pictures(
    env: DictConfig,
    task: Task,
    who: Candidate,
    rows: list[dict],
    out: Path,
    device: str,
    form: str,
) -> None:
    """A figure of each of these episodes of a test, and an animation unless ``form`` is ``png``."""
    if not rows:
        return
    with (
        closing(build_env(env, task, len(rows), 0, device_of(device), who.transforms)) as several,
        bar(total=len(rows), desc="draw", unit="episode") as shown,
    ):
        made = []
        for path in task.draw(who.policy, several, rows, out, who.name, form):
            made.append(path)
            shown.update()
    for transform in who.transforms:
        transform.reset_parent()
    log.info("Pictures: %s", ", ".join(map(str, made)))


def drawn(rows: list[dict], cfg: DictConfig) -> list[dict]:
    """Those of a test's episodes that ``draw`` and ``draw_most`` or ``episode`` ask for."""
    if (numbers := cfg.get("episode")) is not None:
        return [rows[number] for number in ([numbers] if isinstance(numbers, int) else numbers)]
    draw, most = cfg.draw, cfg.draw_most
    if draw == "none":
        return []
    column = {"collisions": "collision"}.get(draw, draw)
    found = [row for row in rows if column == "all" or row[column]]
    if len(found) > most or not found:
        few = f"the first {most} are drawn (draw_most)" if found else "none is drawn"
        log.info("draw=%s: %d of %d episodes, %s.", draw, len(found), len(rows), few)
    return found[:most]


def evaluate(cfg: DictConfig) -> None:
    """Test a policy that the configuration names, and draw, trace and explain those episodes that it asks for."""
    for node in chain(cfg.projector):
        if takes(node, "risk"):
            raise ValueError(
                f"projector: {node._target_} corrects by a policy's own critics, with which it drives already if it was "
                "trained so (project=true); a test takes one that needs none, such as projector=shield."
            )
    check_targets(cfg)
    torch.set_num_threads(cfg.threads)
    OmegaConf.resolve(cfg)
    cfg, task, who = choose_policy(cfg)
    if not task.pictures and (cfg.draw != "none" or cfg.episode is not None):
        raise ValueError(
            f"draw must be none and episode null, as task={task.task} draws no pictures."
        )
    if (cfg.trace != "none" or cfg.why) and not isinstance(task, Scenario):
        raise ValueError(f"trace must be none and why false, as task={task.task} is not the road.")
    called = who.name.partition(" (")[0].replace(" ", "")
    title = f"{called}-{task.task}-seed{cfg.seed}"
    folder = f"evaluation/{title}/{datetime.now():%Y-%m-%d_%H-%M-%S-%f}"
    out = job_folder() or Path(folder if cfg.out is None else str(cfg.out))
    test = asked(cfg) if job_folder() else None
    if is_there(out, test):
        log.info("%s is there already.", out)
        return
    keep(out, test, finished=False)
    rows = measure(
        cfg.env,
        task,
        who,
        out=out,
        num_envs=cfg.env.num_envs,
        episodes=cfg.episodes,
        seed=cfg.seed,
        device=cfg.device,
        changed=changed(HydraConfig.get().overrides.task),
    )
    pictures(cfg.env, task, who, drawn(rows, cfg), out, cfg.device, cfg.draw_format)
    if isinstance(task, Scenario):
        look_into(cfg, task, who, rows, out)
    keep(out, test, finished=True)


def look_into(cfg: DictConfig, task: Scenario, who: Candidate, rows: list[dict], out: Path) -> None:
    """Write ``trace.npz`` and ``crashes.csv`` of a test, as far as ``trace`` and ``why`` ask for them."""
    chosen = rows if cfg.trace == "all" else [row for row in rows if row["collision"]]
    traced = None
    if chosen and (cfg.trace != "none" or cfg.why):
        transforms = [TrueScene(), *who.transforms]
        at_once = envs_at_once(len(chosen), cfg.env.num_envs)
        about = {"policy": who.name, "env": cfg.env._target_.rpartition(".")[2], **who.origin}
        device = device_of(cfg.device)
        with closing(build_env(cfg.env, task, at_once, 0, device, transforms)) as several:
            traced = record(who.policy, several, chosen, who.critics, who.limit, **about)
        for transform in who.transforms:
            transform.reset_parent()
    if cfg.trace != "none":
        log.info("Trace: %s", traced.save(out) if traced else "none, as there was no crash")
    if cfg.why:
        crashes = explain(traced, task) if traced else []
        with (out / "crashes.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, CRASH, lineterminator="\n")
            writer.writeheader()
            writer.writerows(crashes)
        log.info("\n%s", crash_table(crashes, len(rows)))


def changed(overrides: Sequence[str]) -> dict[str, str]:
    """What a command line says of single settings of task and environment.

    >>> changed(["task=lt", "+task.traffic.respawn=true", "env.num_envs=3"])
    {'task.traffic.respawn': 'true'}
    """
    told = dict(override.lstrip("+").split("=", 1) for override in overrides if "=" in override)
    told.pop("env.num_envs", None)  # no figure depends on it
    return {key: value for key, value in told.items() if key.startswith(("task.", "env."))}


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
) -> tuple[DictConfig, Task, Candidate]:
    """A test's own configuration and task, and who is tested.

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
        driver = task.driver(name, cfg.seed)
        who = Candidate(name, driver, origin={"algo": name})
        return cfg, task, who.behind(cfg.projector)
    path = pretrained_run(name) if source == "pretrained" else Path(name)
    trained = run_config(path, source)
    check_targets(trained)
    trained.device = cfg.device
    cfg = on_its_own_task(cfg, trained, overrides)
    task, learned = make(cfg.task), make(trained.task)
    task.check_policy_of(learned)
    for key, value in offered(trained.encoder, learned.network).items():
        if task.network[key] != value:
            raise ValueError(
                f"task.{key} must be {value}, the number that this policy's network was trained with, "
                f"got {task.network[key]}."
            )
    called = f"{trained.algo_name} ({name})"
    who = Candidate.trained(called, compiling(trained, cfg.compile), path, cfg.project)
    if tuple(task.costs) != tuple(learned.costs):  # its limits are on others
        who = replace(who, about={})
    return cfg, task, who.behind(cfg.projector)


def measure(
    env: DictConfig,
    task: Task,
    who: Candidate,
    *,
    out: Path,
    num_envs: int,
    episodes: int,
    seed: int,
    device: str,
    **about: Any,
) -> list[dict]:
    """Play, write ``metrics.json`` (with what ``about`` says) and ``episodes.csv``, report the table; returns the rows."""
    at_once = envs_at_once(episodes, num_envs)
    with closing(build_env(env, task, at_once, seed, device_of(device), who.transforms)) as several:
        rows = play_episodes(who.policy, several, episodes, seed)
    latencies: list[float] = []
    for transform in who.transforms:  # free for another environment
        transform.reset_parent()
        latencies += getattr(transform, "latencies", [])
    backend = env._target_.rpartition(".")[2]
    figures = write(
        rows,
        out,
        policy=who.name,
        env=backend,
        **task.describe(),
        project=who.projects,
        episodes=episodes,
        seed=seed,
        **who.about,
        **about,
    )
    title = f"{who.name}: {episodes} episodes of {task.title}"
    log.info("\n%s", table(figures, title, who.about.get("cost_limit")))
    if latencies:  # in a file of its own: the others are the same each time
        took = {"median": statistics.median(latencies), "longest": max(latencies)}
        timing = {name: round(1e3 * seconds, 3) for name, seconds in took.items()}
        timing |= {"corrections": len(latencies), "episodes_at_once": at_once}
        (out / "latency_ms.json").write_text(json.dumps(timing, indent=2) + "\n")
        log.info("A correction took %.1f ms, the longest %.1f ms.", *list(timing.values())[:2])
    log.info("Files: %s", out)
    return rows
