"""Several policies in the same traffic side by side: where they drive, and how fast they are inside the box.

    python benchmarks/trajectories.py RUN RUN ... [--task lt] [--scenario dense] [--seed 0] [--episode N ...] [--out DIR]

A RUN is a run, a checkpoint, an exported policy, or one of the drivers scripted, blind and random. Each is tested on ``--task``, with
the observation and the projector that it was trained with. ``--episode`` are numbers of episodes in a test with ``--seed``, as those of
``python -m saferl.evaluate``; without it the first of 50 is taken in which not all of them end alike. Writes
``trajectories_TASK_N.png`` and ``.pdf``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig

from saferl.algorithms.assemble import build_env
from saferl.algorithms.policy import compiling, trained_agent
from saferl.checkpoint.run import run_config
from saferl.cli.evaluate import on_its_own_task
from saferl.config.locate import config_dir
from saferl.envs.intersection.comparison import save_comparison
from saferl.envs.intersection.drivers import DRIVERS
from saferl.envs.intersection.episode import Episode, record
from saferl.envs.intersection.scenario import Scenario

LOOKED_AT = 50  # episodes


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="+", metavar="RUN")
    parser.add_argument("--task", choices=("lt", "gs", "rt"), default="lt")
    parser.add_argument("--scenario", default="nominal", help="the traffic")
    parser.add_argument("--seed", type=int, default=0, help="of the test")
    parser.add_argument("--episode", type=int, nargs="+", help="numbers of episodes in the test")
    parser.add_argument("--out", type=Path, default=Path("."))
    options = parser.parse_args()
    torch.set_num_threads(1)
    overrides = [f"task={options.task}", f"task.scenario={options.scenario}"]
    with hydra.initialize_config_dir(config_dir(), version_base="1.3"):
        cfg = hydra.compose("evaluate", overrides)
    numbers = options.episode or list(range(LOOKED_AT))
    played = {
        name: test(cfg, run, overrides, options.seed, numbers)
        for name, run in named(options.runs).items()
    }
    if not options.episode:
        numbers = [first_that_differs([*played.values()])]
    options.out.mkdir(parents=True, exist_ok=True)
    for number in numbers:
        episodes = {
            name: next(each for each in several if each.number == number)
            for name, several in played.items()
        }
        for ending in ("png", "pdf"):
            path = options.out / f"trajectories_{options.task}_{number}.{ending}"
            print(save_comparison(episodes, path))


def named(runs: Sequence[str]) -> dict[str, str]:
    """What to call them: their algorithms; where two have the same, with their folders' names, or their paths."""
    called = [run if run in DRIVERS else run_config(Path(run), "RUN").algo_name for run in runs]
    pairs = [*zip(called, runs, strict=True)]
    forms = (
        called,
        [f"{name} ({Path(run).name})" for name, run in pairs],
        [f"{name} ({run})" for name, run in pairs],
    )
    return {
        next((form[i] for form in forms if form.count(form[i]) == 1), run): run
        for i, run in enumerate(runs)
    }


def test(
    cfg: DictConfig, run: str, overrides: Sequence[str], seed: int, numbers: Sequence[int]
) -> list[Episode]:
    """These episodes of a test of one policy."""
    trained = cfg if run in DRIVERS else compiling(run_config(Path(run), "RUN"), False)
    trained.device = "cpu"
    own = on_its_own_task(cfg, trained, overrides)
    task: Scenario = hydra.utils.instantiate(own.task)
    if run in DRIVERS:
        policy, transforms = task.driver(run, seed), []
    else:
        agent = trained_agent(trained, Path(run))
        policy, transforms = agent.actor, agent.transforms
    seeds = task.episodes(seed, max(numbers) + 1)[numbers].tolist()
    with closing(build_env(own.env, task, len(seeds), seed, "cpu", transforms)) as env:
        episodes = record(policy, env, seeds)
    for number, episode in zip(numbers, episodes, strict=True):
        episode.number = number
    return episodes


def first_that_differs(played: Sequence[Sequence[Episode]]) -> int:
    """The number of the first episode in which not all end alike; 0 if there is none."""
    for several in zip(*played, strict=True):
        if len({episode.outcome for episode in several}) > 1:
            return several[0].number or 0
    return 0


if __name__ == "__main__":
    main()
