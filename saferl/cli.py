"""What the commands do once Hydra has composed their configuration."""

from __future__ import annotations

import dataclasses
import logging
import sys
from collections.abc import Callable
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from saferl.builders import build_env, build_trainer
from saferl.envs.transforms import SafetyProjector
from saferl.evaluation import evaluate, write
from saferl.metrics import table
from saferl.trainer import Trainer

log = logging.getLogger(__name__)
CONFIG = "config.yaml"


def guard(command: Callable[[DictConfig], None], cfg: DictConfig) -> None:
    """Run a command; a mistake in its input ends it with one clear line, and not with a trace."""
    try:
        command(cfg)
    except InstantiationException as error:
        raise SystemExit(f"error: {error.__cause__ or error} (in {_place(error)})") from error
    except (ValueError, FileNotFoundError, OmegaConfBaseException) as error:
        raise SystemExit(f"error: {error}") from error
    except KeyboardInterrupt:
        sys.exit(130)


def _place(error: InstantiationException) -> str:
    lines = str(error).splitlines()
    return lines[-1].removeprefix("full_key: ") if "full_key" in lines[-1] else "the configuration"


def run_config(run: Path) -> DictConfig:
    """The resolved configuration that a run was trained with.

    Raises:
        FileNotFoundError: the folder holds no config.yaml.
    """
    for folder in (run, *run.parents[:2]):
        if (folder / CONFIG).is_file():
            return OmegaConf.load(folder / CONFIG)
    raise FileNotFoundError(f"checkpoint: no {CONFIG} in {run} or above it; is it a saferl run?")


def train(cfg: DictConfig) -> None:
    """Train, or continue a run, then test the result."""
    if cfg.resume is not None:
        others = [
            o for o in HydraConfig.get().overrides.task if not o.startswith(("resume=", "out="))
        ]
        if others:
            raise ValueError(
                "resume continues a run as it was configured and takes no other option, "
                f"got {', '.join(others)}."
            )
        run = Path(cfg.resume)
        cfg = run_config(run)
        trainer = build_trainer(cfg, run)
        trainer.resume()
    else:
        run = Path(HydraConfig.get().runtime.output_dir)
        OmegaConf.resolve(cfg)
        trainer = build_trainer(cfg, run)
        run.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(cfg, run / CONFIG)
    log.info("%s on %s, seed %d. Files: %s", cfg.algo_name, cfg.task.task, cfg.seed, run)
    trainer.train()
    test(cfg, trainer, run)


def test(cfg: DictConfig, trainer: Trainer, run: Path) -> None:
    """Measure what was trained, under the conditions of a test, and report the table."""
    test_cfg = cfg.evaluation
    scenario = dataclasses.replace(
        trainer.collector.env.base_env.scenario,
        policy_frequency=test_cfg.policy_frequency,
        route_starts=0.0,
        standstill=None,
        reward=dataclasses.replace(
            trainer.collector.env.base_env.scenario.reward, risk_shaping=False
        ),
    )
    projectors = [t for t in trainer.collector.env.transform if isinstance(t, SafetyProjector)]
    for projector in projectors:
        projector.reset_parent()
    env = build_env(cfg, scenario, min(test_cfg.num_envs, test_cfg.episodes), cfg.seed, *projectors)
    rows = evaluate(trainer.collector.policy, env, test_cfg.episodes, cfg.seed)
    figures = write(rows, run / "evaluation", task=cfg.task.task, episodes=test_cfg.episodes)
    log.info(
        "\n%s\nFiles: %s",
        table(figures, f"{cfg.algo_name}: {test_cfg.episodes} test episodes of {cfg.task.task}"),
        run,
    )
