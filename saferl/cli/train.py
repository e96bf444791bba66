"""Train, or continue a run, then test the result."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from saferl.algorithms.assemble import build_trainer, complete
from saferl.algorithms.parts import make
from saferl.algorithms.policy import compiling
from saferl.checkpoint.lock import alone
from saferl.checkpoint.run import CONFIG, begun, progress, run_config, run_folder
from saferl.cli.candidate import Candidate
from saferl.cli.evaluate import drawn, measure, pictures
from saferl.cli.launch import job_folder
from saferl.config.flat import MADE
from saferl.config.limits import check_limits
from saferl.evaluation.compare import TESTED, side_by_side
from saferl.evaluation.statistics import FIGURES, summarise
from saferl.training.crew import WorkerLost
from saferl.training.trainer import Trainer

log = logging.getLogger(__name__)


def train(cfg: DictConfig) -> None:
    """Train, or continue a run, then test the result."""
    hydra = HydraConfig.get()
    overrides = hydra.overrides.task
    if cfg.resume is None:
        train_into(Path(hydra.runtime.output_dir), cfg, overrides, job_folder() is not None)
        return
    run = run_folder(Path(str(cfg.resume)), "resume")
    _work(prolonged(run_config(run), cfg, overrides), run, resuming=True)


def train_into(
    run: Path,
    cfg: DictConfig,
    overrides: Sequence[str],
    repeated: bool = True,
    prepare: Callable[[Trainer], None] = lambda trainer: None,
) -> None:
    """Train in a folder, then test the result.

    Args:
        run: the folder.
        cfg: as composed, not resolved.
        overrides: of the command line.
        repeated: whether a run of this configuration that is there already goes on, or is left alone where it is finished.
        prepare: is given the trainer before it begins.

    Raises:
        ValueError: the folder holds another run, or something in the configuration cannot be meant.
        KeyboardInterrupt: after a checkpoint was left.
    """
    costs = complete(cfg.task).costs
    check_limits(cfg, overrides, costs)
    OmegaConf.resolve(cfg)
    resuming = False
    if repeated and (run / CONFIG).exists():
        if begun(run) or (run / TESTED).exists():  # a sweep that is run again
            resuming = composed(run_config(run)) == composed(cfg)
        else:  # killed before its first checkpoint, if nobody works on it
            with alone(run, "out"):
                (run / CONFIG).unlink()
    if resuming and (run / TESTED).exists():
        log.info("%s is there already.", run)
        return
    if not resuming:
        claim(run, cfg)
    _work(cfg, run, resuming, prepare)


def _work(
    cfg: DictConfig,
    run: Path,
    resuming: bool,
    prepare: Callable[[Trainer], None] = lambda trainer: None,
) -> None:
    """Train a run that is claimed, and test the result."""
    with alone(run, "resume" if resuming else "out"):
        for path in run.rglob("*"):
            if path.is_symlink():  # to write there would be to write elsewhere
                raise ValueError(f"{path} is a link, which no run has.")
        try:
            learn(cfg, run, resuming, prepare)
        finally:
            if not resuming and not begun(run):  # it never began
                (run / CONFIG).unlink(missing_ok=True)

        cfg = compiling(cfg, False)  # the closing test is over before compiling would pay
        try:
            closing_test(cfg, run)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"Interrupted in the closing test. Repeat it with resume={run}"
            ) from None


def learn(cfg: DictConfig, run: Path, resuming: bool, prepare: Callable[[Trainer], None]) -> None:
    """Train to the end of the budget; where a worker is killed, go on from the newest checkpoint with new ones, which ends in
    the same bits.

    Raises:
        WorkerLost: it was not killed, or one was killed after the same checkpoint before.
    """
    lost_at = -1
    while True:
        try:
            return _learn(cfg, run, resuming, prepare)
        except WorkerLost as lost:
            resuming = begun(run)
            saved = progress(run)["frames"] if resuming else -1
            if not lost.killed or saved == lost_at:
                way = f" Continue with resume={run}" if resuming else ""
                raise WorkerLost(f"{lost}{way}", lost.killed) from lost
            log.warning("%s The run goes on from its checkpoint of frame %d.", lost, saved)
            lost_at = saved


def _learn(cfg: DictConfig, run: Path, resuming: bool, prepare: Callable[[Trainer], None]) -> None:
    with closing(build_trainer(cfg, run)) as trainer:
        prepare(trainer)
        if resuming:
            trainer.resume()
            if cfg != run_config(run):  # a larger budget, of which no test is there yet
                (run / TESTED).unlink(missing_ok=True)
                part = run / f"{CONFIG}.part"
                OmegaConf.save(cfg, part)
                part.replace(run / CONFIG)
        log.info("%s on %s, seed %d. Files: %s", cfg.algo_name, cfg.task.task, cfg.seed, run)
        trainer.train()


def closing_test(cfg: DictConfig, run: Path) -> None:
    """Test what a run has learned, beside the scripted drivers that it names, and draw episodes of it."""
    settings = cfg.evaluation
    task = make(cfg.task).as_test()
    mine = Candidate.trained(cfg.algo_name, cfg, run)
    drivers = [Candidate(name, task.driver(name, cfg.seed)) for name in settings.drivers]
    out, results = run / "evaluation", {}
    for who in (mine, *drivers):
        results[who.name] = measure(
            cfg.env,
            task,
            who,
            out=out if who is mine else out / who.name,
            num_envs=settings.num_envs,
            episodes=settings.episodes,
            seed=cfg.seed,
            device=cfg.device,
        )
    if drivers:
        title = f"The same {settings.episodes} episodes of {task.task}"
        runs = [
            (
                {"algo_name": name, "task": {"task": task.task}},
                {"episodes": len(rows), **summarise(rows)},
            )
            for name, rows in results.items()
        ]
        log.info("\n%s\n%s", title, side_by_side(runs, tuple(FIGURES)))
    chosen = drawn(results[mine.name], settings)
    pictures(cfg.env, task, mine, chosen, out, cfg.device, settings.draw_format)


def composed(cfg: DictConfig) -> Any:
    """What a run is, whoever makes it where."""
    kept: Any = OmegaConf.to_container(cfg, resolve=True)
    return {key: value for key, value in kept.items() if key not in MADE}


def prolonged(own: DictConfig, asked: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """The configuration of a run that goes on, with a larger budget if one is asked for.

    Args:
        own: the run's.
        asked: as the command line composes it.
        overrides: of the command line.

    Raises:
        ValueError: anything else is asked for.
    """
    budget = "episodes" if own.frames is None else "frames"
    others = [each for each in overrides if not each.startswith(("resume=", f"{budget}="))]
    if others:
        raise ValueError(
            f"resume continues a run as it was configured and takes no other option than a larger {budget}=, "
            f"got {', '.join(others)}."
        )
    if any(each.startswith(f"{budget}=") for each in overrides):
        if asked[budget] is None or asked[budget] < own[budget]:
            raise ValueError(
                f"{budget} must be >= {own[budget]}, the run's own, got {asked[budget]}."
            )
        own[budget] = asked[budget]
    return own


def claim(run: Path, cfg: DictConfig) -> None:
    """Make a folder this run's own; of two runs that want it at once, one gets it.

    Raises:
        ValueError: it holds a run already.
    """
    run.mkdir(parents=True, exist_ok=True)
    try:
        if begun(run) or any(run.glob("policy.*")):
            raise FileExistsError
        with (run / CONFIG).open("x") as file:
            OmegaConf.save(cfg, file)
    except FileExistsError:
        way = f"continue it with resume={run}, or take another folder."
        if (run / TESTED).exists() and not begun(run):
            way = "its checkpoints are gone; take another folder."
        elif any(run.glob("policy.*")):
            raise ValueError(f"out: {run} holds a policy; take another folder.") from None
        elif not begun(run):
            way = "it has just begun, or was killed before its first checkpoint and can be deleted."
        raise ValueError(f"out: {run} holds a run already; {way}") from None
