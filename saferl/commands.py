"""The commands, on configurations that Hydra has composed: train, evaluate, export."""

from __future__ import annotations

import dataclasses
import json
import logging
import statistics
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.transforms import Transform

from saferl import checkpoint
from saferl.agents import load_agent
from saferl.builders import build_env, build_trainer, complete
from saferl.checkpoint import CONFIG, run_config, run_folder
from saferl.envs.intersection import Scenario
from saferl.envs.intersection.drivers import driver
from saferl.evaluation import TEST, as_test, envs_at_once, write
from saferl.evaluation import evaluate as play_episodes
from saferl.metrics import FIGURES, summarise, table
from saferl.paths import pretrained_run
from saferl.progress import Budget
from saferl.summary import side_by_side
from saferl.validation import check_testing

log = logging.getLogger(__name__)


def train(cfg: DictConfig) -> None:
    """Train, or continue a run, then test the result."""
    resuming = cfg.resume is not None
    if not resuming:
        run = Path(HydraConfig.get().runtime.output_dir)
        complete(cfg)
        OmegaConf.resolve(cfg)
        claim(run, cfg)
    else:
        others = [o for o in HydraConfig.get().overrides.task if not o.startswith("resume=")]
        if others:
            raise ValueError(
                "resume continues a run as it was configured and takes no other option, "
                f"got {', '.join(others)}."
            )
        run = run_folder(Path(str(cfg.resume)), "resume")
        cfg = run_config(run)
    try:
        trainer = build_trainer(cfg, run)
        if resuming:
            trainer.resume()
        log.info("%s on %s, seed %d. Files: %s", cfg.algo_name, cfg.task.task, cfg.seed, run)
        trainer.train()
    finally:
        if not resuming and not (run / checkpoint.FOLDER).exists():  # it never began
            (run / CONFIG).unlink(missing_ok=True)

    cfg = compiling(cfg, False)  # the closing test is over before compiling would pay
    try:
        closing_test(cfg, run)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"Interrupted in the closing test. Repeat it with resume={run}"
        ) from None


def closing_test(cfg: DictConfig, run: Path) -> None:
    """Test what a run has learned, beside the scripted drivers that it names, and draw its first episodes."""
    settings = cfg.evaluation
    scenario = as_test(hydra.utils.instantiate(cfg.task), settings.policy_frequency)
    policy, transforms = trained_policy(cfg, run)

    def test(policy: TensorDictModuleBase, transforms: Sequence[Transform], name: str, out: Path):
        return measure(
            cfg,
            scenario,
            policy,
            transforms,
            out=out,
            num_envs=settings.num_envs,
            episodes=settings.episodes,
            seed=cfg.seed,
            policy_name=name,
        )

    out = run / "evaluation"
    results = {cfg.algo_name: test(policy, transforms, cfg.algo_name, out)}
    for name in settings.drivers:
        results[name] = test(driver(name, cfg.seed), [], name, out / name)
    if settings.drivers:
        title = f"The same {settings.episodes} episodes of {scenario.task}"
        runs = [
            (
                {"algo_name": name, "task": {"task": scenario.task}},
                {"episodes": len(rows), **summarise(rows)},
            )
            for name, rows in results.items()
        ]
        log.info("\n%s\n%s", title, side_by_side(runs, tuple(FIGURES)))
    pictures(cfg, scenario, policy, transforms, results[cfg.algo_name][: settings.gif], out)


def pictures(
    cfg: DictConfig,
    scenario: Any,
    policy: TensorDictModuleBase,
    transforms: Sequence[Transform],
    rows: list[dict],
    out: Path,
) -> None:
    """An animation and a figure of each of these episodes of a test."""
    if not rows:
        return
    from saferl.plotting import draw  # late: few tests want pictures

    env = build_env(cfg, scenario, 1, cfg.seed, *transforms)
    for row in rows:
        log.info("%s", draw(policy, env, row, out))


def claim(run: Path, cfg: DictConfig) -> None:
    """Make a folder this run's own; of two runs that want it at once, one gets it.

    Raises:
        ValueError: it holds a run already.
    """
    run.mkdir(parents=True, exist_ok=True)
    try:
        if (run / checkpoint.FOLDER).exists():
            raise FileExistsError
        with (run / CONFIG).open("x") as file:
            OmegaConf.save(cfg, file)
    except FileExistsError:
        way = f"continue it with resume={run}, or take another folder."
        if not (run / checkpoint.FOLDER).exists():
            way = "it has just begun, or was killed before its first checkpoint and can be deleted."
        raise ValueError(f"out: {run} holds a run already; {way}") from None


def evaluate(cfg: DictConfig) -> None:
    """Test a policy that the configuration names, and draw its first episodes."""
    if not _is_road(cfg.task):
        raise ValueError(
            f"task={cfg.task.task}: task= of a test is one of the road's; a policy that was trained on another task "
            "is tested there without it."
        )
    check_testing(cfg)
    torch.set_num_threads(cfg.threads)
    OmegaConf.resolve(cfg)
    cfg, policy, transforms, name = choose_policy(cfg)
    scenario = hydra.utils.instantiate(cfg.task)
    if cfg.gif and not isinstance(scenario, Scenario):
        raise ValueError(
            f"gif: pictures are of the road, and this policy's task is {cfg.task.task}."
        )
    about = f"{name.partition(' ')[0]}-{scenario.task}-seed{cfg.seed}"
    folder = f"evaluation/{about}/{datetime.now():%Y-%m-%d_%H-%M-%S-%f}"
    out = Path(folder if cfg.out is None else str(cfg.out))
    if (out / "metrics.json").exists():
        raise ValueError(f"out: {out} holds a test already; take another folder.")
    rows = measure(
        cfg,
        scenario,
        policy,
        transforms,
        out=out,
        num_envs=cfg.env.num_envs,
        episodes=cfg.episodes,
        seed=cfg.seed,
        policy_name=name,
    )
    pictures(cfg, scenario, policy, transforms, rows[: cfg.gif], out)


def export(cfg: DictConfig) -> None:
    """Reduce a run to its configuration and networks."""
    for key in ("checkpoint", "out"):
        if cfg[key] is None:
            raise ValueError(f"{key}=... is missing: give checkpoint=RUN and out=DIR.")
    folder = checkpoint.export(Path(str(cfg.checkpoint)), Path(str(cfg.out)))
    size = (folder / checkpoint.EXPORTED).stat().st_size / 2**20
    log.info("%s: %.1f MiB. Test it: python -m saferl.evaluate checkpoint=%s", folder, size, folder)


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
        counted = checkpoint.progress(path)
        spent = Budget(cfg.episodes, cfg.frames).spent(**counted) if counted else 1.0
        agent.projector.set_progress(spent)
    return agent.actor, [agent.projector]


def _is_road(task: DictConfig) -> bool:
    """Whether a task is of the intersection."""
    return "rows" in task


def on_its_own_task(cfg: DictConfig, trained: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """A test's configuration with the task and environment that a policy was trained with.

    Args:
        cfg: the test's configuration as composed.
        trained: the run's configuration.
        overrides: the command line; what it says of task and environment stands. Of a choice
            ``task=lt`` only the name counts.

    Raises:
        ValueError: the command line changes the task of a policy that was not trained on the road.
    """
    keys = [override.partition("=")[0].lstrip("+") for override in overrides]
    given = [key for key in keys if key.partition(".")[0] in ("task", "env")]
    if given and not _is_road(trained.task) and given != ["env.num_envs"]:
        raise ValueError(
            f"{given[0]}: this policy's task is {trained.task.task}, which a test does not change."
        )
    test = cfg.copy()
    OmegaConf.set_struct(test, False)
    changes = TEST | {"policy_frequency": trained.evaluation.policy_frequency}
    test.task = OmegaConf.merge(
        trained.task, {key: value for key, value in changes.items() if key in trained.task}
    )
    if "env" not in keys:
        # The backend is the run's; what the backends set alike, or this one sets too, is the test's.
        shared = {k: v for k, v in cfg.env.items() if k in trained.env and k != "_target_"}
        test.env = OmegaConf.merge(trained.env, shared)
    for key in keys:
        key = "task.task" if key == "task" else key
        if key.startswith(("task.", "env.")):
            OmegaConf.update(test, key, OmegaConf.select(cfg, key))
    return test


def choose_policy(
    cfg: DictConfig,
) -> tuple[DictConfig, TensorDictModuleBase, list[Transform], str]:
    """A test's own configuration, the policy that it names, the transforms that this drives with,
    and what to call it.

    Raises:
        ValueError: not exactly one source, an unknown name, or an MLP for other observations.
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
    if source == "policy":
        return cfg, driver(name, cfg.seed), [], name
    path = pretrained_run(name) if source == "pretrained" else Path(name)
    trained = run_config(path, source)
    trained.device = cfg.device
    cfg = on_its_own_task(cfg, trained, HydraConfig.get().overrides.task)
    rows = trained.encoder.policy.get("rows")
    if rows is not None and rows != cfg.task.get("rows", rows):
        raise ValueError(
            f"task.rows must be {rows}, the number that this policy's MLP was trained with, "
            f"got {cfg.task.rows}."
        )
    form = trained.task.get("observation")
    if form != cfg.task.get("observation"):
        raise ValueError(
            f"task.observation must be {form}, by which this policy was trained, got {cfg.task.observation}."
        )
    policy, transforms = trained_policy(compiling(trained, cfg.compile), path)
    return cfg, policy, transforms if cfg.project else [], f"{trained.algo_name} ({name})"


def describe(scenario: Any) -> dict[str, Any]:
    """What a test's file says of its task."""
    if not isinstance(scenario, Scenario):
        return dataclasses.asdict(scenario)
    return {
        "task": scenario.task,
        "vehicles": scenario.traffic.vehicles[1],
        "rows": scenario.rows,
        "scenario": scenario.scenario,
        "traffic": dataclasses.asdict(scenario.traffic),
        "reading": scenario.reward.reading,
        "policy_frequency": scenario.policy_frequency,
    }


def measure(
    cfg: DictConfig,
    scenario: Any,
    policy: TensorDictModuleBase,
    transforms: Sequence[Transform],
    *,
    out: Path,
    num_envs: int,
    episodes: int,
    seed: int,
    policy_name: str,
) -> list[dict]:
    """Play, write ``metrics.json`` and ``episodes.csv``, report the table; returns the rows."""
    env = build_env(cfg, scenario, envs_at_once(episodes, num_envs), seed, *transforms)
    rows = play_episodes(policy, env, episodes, seed)
    latencies: list[float] = []
    for transform in transforms:  # free for another environment
        transform.reset_parent()
        latencies += getattr(transform, "latencies", [])
    backend = cfg.env._target_.rpartition(".")[2]
    figures = write(
        rows,
        out,
        policy=policy_name,
        env=backend,
        **describe(scenario),
        project=bool(transforms),
        episodes=episodes,
        seed=seed,
    )
    title = f"{policy_name}: {episodes} episodes of {scenario.task}"
    if isinstance(scenario, Scenario):
        title += f", {scenario.traffic.vehicles[1]} vehicles"
    log.info("\n%s", table(figures, title))
    if latencies:  # in a file of its own: the others are the same each time
        took = {"median": statistics.median(latencies), "longest": max(latencies)}
        timing = {name: round(1e3 * seconds, 3) for name, seconds in took.items()}
        timing |= {"corrections": len(latencies), "episodes_at_once": env.batch_size[0]}
        (out / "latency_ms.json").write_text(json.dumps(timing, indent=2) + "\n")
        log.info("A correction took %.1f ms, the longest %.1f ms.", *list(timing.values())[:2])
    log.info("Files: %s", out)
    return rows
