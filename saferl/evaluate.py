"""Test a policy: ``python -m saferl.evaluate checkpoint=RUN task=gs episodes=500``."""

from __future__ import annotations

import logging
from pathlib import Path

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.transforms import Transform

from saferl.builders import build_env, load_agent
from saferl.cli import guard, run_config
from saferl.envs.intersection.drivers import CautiousDriver, Driver, RandomDriver
from saferl.evaluation import evaluate, write
from saferl.metrics import table
from saferl.paths import config_dir, pretrained_run

log = logging.getLogger(__name__)
DRIVERS = {"random": RandomDriver, "blind": Driver, "scripted": CautiousDriver}


def build_policy(cfg: DictConfig) -> tuple[TensorDictModuleBase, list[Transform], str]:
    """The policy, the transforms that it drives with, and its name.

    Raises:
        ValueError: not exactly one source, or an unknown name.
    """
    given = {key: cfg[key] for key in ("checkpoint", "pretrained", "policy") if cfg[key] is not None}
    if len(given) != 1:
        raise ValueError(
            "Give one of checkpoint=PATH, pretrained=NAME or policy=random|blind|scripted, "
            f"got {given or 'none of them'}."
        )
    ((source, value),) = given.items()
    if source == "policy":
        if value not in DRIVERS:
            raise ValueError(f"policy must be one of {', '.join(DRIVERS)}, got {value!r}.")
        seeds = {"seed": cfg.seed} if value == "random" else {}
        return DRIVERS[value](**seeds), [], value
    run = pretrained_run(value) if source == "pretrained" else Path(value)
    trained = run_config(run)
    trained.device = cfg.device
    agent = load_agent(trained, run)
    transforms: list[Transform] = []
    if agent.projector is not None and cfg.projector:
        agent.projector.set_progress(1.0)
        transforms = [agent.projector]
    if trained.encoder.policy.get("rows", cfg.task.rows) != cfg.task.rows:
        raise ValueError(
            f"task.rows must be {trained.encoder.policy.rows}, which the policy was trained with "
            f"(an MLP has a fixed number of rows), got {cfg.task.rows}."
        )
    return agent.actor, transforms, f"{trained.algo_name} {run}"


def run(cfg: DictConfig) -> None:
    """Play the episodes, write the files, report the table."""
    for key, least in (("episodes", 1), ("gif", 0), ("threads", 1)):
        if not isinstance(cfg[key], int) or cfg[key] < least:
            raise ValueError(f"{key} must be a whole number >= {least}, got {cfg[key]!r}.")
    torch.set_num_threads(cfg.threads)
    OmegaConf.resolve(cfg)
    out = Path(HydraConfig.get().runtime.output_dir)
    policy, transforms, name = build_policy(cfg)
    scenario = hydra.utils.instantiate(cfg.task)
    width = min(cfg.env.num_envs, cfg.episodes)
    env = build_env(cfg, scenario, width, cfg.seed, *transforms)
    rows = evaluate(policy, env, cfg.episodes, cfg.seed)
    backend = HydraConfig.get().runtime.choices.env
    about = {"policy": name, "task": cfg.task.task, "env": backend, "episodes": cfg.episodes}
    figures = write(rows, out, **about, seed=cfg.seed)
    log.info(
        "\n%s\nFiles: %s",
        table(figures, f"{name}: {cfg.episodes} episodes of {cfg.task.task} on {backend}"),
        out,
    )
    for row in rows[: cfg.gif]:
        draw(policy, build_env(cfg, scenario, 1, cfg.seed, *(t.clone() for t in transforms)), row, out)


def draw(policy: TensorDictModuleBase, env, row: dict, out: Path) -> None:
    """Replay one episode into ``episode_N.gif`` and ``episode_N.png``."""
    from saferl.plotting import record, save_figure, save_gif

    episode = record(policy, env, row["seed"])
    stem = out / f"episode_{row['episode']}"
    save_figure(episode, stem.with_suffix(".png"))
    if episode.frames:
        save_gif(episode, stem.with_suffix(".gif"))
    log.info("%s: %s", stem.with_suffix(".png"), episode.outcome)


@hydra.main(version_base="1.3", config_path=config_dir(), config_name="evaluate")
def main(cfg: DictConfig) -> None:
    guard(run, cfg)


if __name__ == "__main__":
    main()
