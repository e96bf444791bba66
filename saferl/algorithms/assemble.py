"""From a run's configuration to a trainer, or to the agent that it holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, get_type_hints

import hydra
import torch
from omegaconf import DictConfig
from torchrl.envs import EnvBase, RewardSum, Transform, TransformedEnv
from torchrl.envs.transforms import Compose

from saferl.algorithms.base import Agent, Algorithm
from saferl.algorithms.parts import Parts, device_of, make
from saferl.checkpoint.run import begun, latest, load_component, run_config
from saferl.checkpoint.state import Fitting, Networks
from saferl.config.check import arguments, check, check_targets, check_task
from saferl.config.limits import order_limits
from saferl.envs.seeding import U31, mix
from saferl.envs.task import Task
from saferl.objectives.values import critic_values
from saferl.training.best import BestPolicy
from saferl.training.collector import Seat
from saferl.training.collectors import Plan
from saferl.training.experience import check_memory
from saferl.training.limit import watch_of
from saferl.training.progress import Budget
from saferl.training.records import EpisodeWindow
from saferl.training.trainer import Trainer
from saferl.training.watchdog import Watchdog


def build_env(
    node: DictConfig,
    task: Task,
    num_envs: int,
    seed: int,
    device: str | torch.device = "cpu",
    transforms: Sequence[Transform] = (),
) -> EnvBase:
    """A backend with a task; transforms from the inside outwards.

    Args:
        node: of the group ``env``.
        task: what it plays.
        num_envs: environments at once, in place of the node's number.
        seed: of the sequences of episodes.
        device: of the tensors.
        transforms: around it.

    Raises:
        ValueError: the backend is of another kind of task.
    """
    kind = get_type_hints(hydra.utils.get_object(node._target_).__init__).get("task", object)
    if not isinstance(task, kind):
        raise ValueError(
            f"{node._target_} plays a {kind.__name__}, but task={task.task} is a "
            f"{type(task).__name__}: leave env= to the task."
        )
    env = make(node, {"num_envs": num_envs}, task=task, seed=seed, device=device)
    return TransformedEnv(env, Compose(*transforms)) if transforms else env  # pyright: ignore


def complete(node: DictConfig) -> Task:
    """Write into a node of the group ``task`` what the task takes from the environment itself; returns the task.

    Raises:
        ValueError: the task's settings cannot be meant.
    """
    if "reward" in node and "reward" not in (arguments(node._target_) or {"reward"}):
        raise ValueError(
            f"shaping changes the road's reward, which task={node.task} has not: set shaping=none."
        )
    check_targets(node, "task")
    node.merge_with(make(node).complete())
    return make(node)


def build_loggers(sinks: Sequence[DictConfig], run: Path) -> list:
    """TorchRL loggers that write into the run's folder.

    Raises:
        ValueError: a logger's own package is not installed.
    """
    try:
        return [make(sink, log_dir=str(run)) for sink in sinks]
    except ImportError as error:
        names = ", ".join(sink._target_ for sink in sinks)
        raise ValueError(
            f"logger: {names} needs a package that is not installed ({error}); "
            "install it (pip install 'saferl[wandb]' for W&B), or use logger=tensorboard or none."
        ) from error


def algorithm_of(learning: DictConfig) -> Algorithm:
    """An algorithm of its family, from a node of the group ``learning``."""
    return make(learning, {"_convert_": "all"})


def build_agent(cfg: DictConfig) -> Agent:
    """Networks, loss and projector of a run, on its device.

    Raises:
        ValueError: parts that do not go together.
    """
    return algorithm_of(cfg.learning).agent(Parts.of(cfg))


def seat(cfg: DictConfig, agent: Agent, num_envs: int, seed: int) -> Seat:
    """What a process collects with: ``num_envs`` environments, and an agent that acts in them as in training."""
    algorithm, task = algorithm_of(cfg.learning), make(cfg.task)
    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    transforms = [sums, *algorithm.transforms(), *agent.transforms]
    env = build_env(cfg.env, task, num_envs, seed, device_of(cfg.device), transforms)
    return Seat(env, algorithm.behaviour(agent.actor, env), agent.take)


def worker_seat(cfg: DictConfig, index: int, workers: int) -> Seat:
    """The seat of a worker, which is built in its process from a run's configuration, on the CPU.

    Its episodes and its random numbers are those of no other worker and no other seed.
    """
    torch.set_num_threads(1)  # a core each
    cfg = cfg.copy()
    cfg.device = "cpu"
    torch.manual_seed(cfg.seed)
    agent = build_agent(cfg)  # begins as the learner's
    seed = int(mix(torch.tensor(cfg.seed), index + 1) & U31)
    torch.manual_seed(seed)
    return seat(cfg, agent, cfg.env.num_envs // workers, seed)


def load_agent(cfg: DictConfig, path: Path, name: str) -> Agent:
    """The agent of a run or checkpoint as it was; ``name`` is the option that gave it.

    Raises:
        FileNotFoundError: there is no checkpoint.
        ValueError: the checkpoint is of another architecture.
    """
    agent = build_agent(cfg)
    load_component(latest(path, name), Fitting(agent.loss))
    return agent


def begin_from(agent: Agent, architecture: Mapping[str, Any], path: Path, device: str) -> None:
    """Give an agent the networks of another run; all else stays as it is.

    Args:
        agent: that begins.
        architecture: what decides whether networks fit it (``Algorithm.architecture``).
        path: the run.
        device: the agent's.

    Raises:
        FileNotFoundError: there is no checkpoint.
        ValueError: another architecture; names the options that differ.
    """
    found, other = latest(path, "init"), run_config(path, "init")
    check_targets(other)
    other.device = device
    theirs = algorithm_of(other.learning).architecture(Parts.of(other))
    differing = {
        key: f"{key} is {theirs[key]} there and {value} here"
        for key, value in architecture.items()
        if key in theirs and theirs[key] != value
    }
    error = f"init: the networks of {path} do not fit: {', '.join(differing.values())}."
    if any(not key.startswith("task.") for key in differing):  # an activation has no shape
        raise ValueError(error)
    try:
        load_component(found, Networks(agent.loss))
    except ValueError as reason:
        if not differing:
            raise
        raise ValueError(error) from reason


def build_trainer(cfg: DictConfig, run: Path) -> Trainer:
    """Everything of a training run, wired; fails before the first environment step if it must.

    Args:
        cfg: as composed, or as a run's file has it.
        run: the run's folder.

    Raises:
        ValueError: something in the configuration cannot be meant; names the key.
        FileNotFoundError: ``init`` names no checkpoint.
    """
    costs = complete(cfg.task).costs
    order_limits(cfg, costs)
    check(cfg)
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    algorithm, parts = algorithm_of(cfg.learning), Parts.of(cfg)
    num_envs, collecting = cfg.env.num_envs, make(cfg.collector)
    check_task(cfg.evaluation, parts.task)
    collecting.check(num_envs)
    algorithm.check_collecting(parts.task, num_envs)
    agent = algorithm.agent(parts)
    if cfg.init and not begun(run):  # a run that goes on has its own networks
        begin_from(agent, algorithm.architecture(parts), Path(cfg.init), cfg.device)
    plan = Plan(
        agent,
        parts.device,
        own=partial(seat, cfg, agent, num_envs, cfg.seed),
        seat=partial(worker_seat, cfg),
        num_envs=num_envs,
        decisions=algorithm.decisions(num_envs),
        random_frames=0 if cfg.init else algorithm.random_frames(),
    )
    with ExitStack() as unless_built:
        collector = collecting.collect(plan)
        unless_built.callback(collector.shutdown)

        def make_env(num_envs: int, seed: int) -> EnvBase:
            wraps = [each.clone() for each in agent.wraps]  # a transform is of one environment
            return build_env(cfg.env, parts.task, num_envs, seed, parts.device, wraps)

        learner = algorithm.learner(agent.loss, cfg.compile)
        experience = algorithm.experience(agent, parts.task, make_env, num_envs, cfg.seed)
        stored = collector.example().select(*agent.stored, strict=False)
        capacity = experience.buffer.storage.max_size
        check_memory(algorithm.kept, capacity, stored, parts.device)
        trainer = Trainer(
            run=run,
            collector=collector,
            experience=experience,
            learner=learner,
            window=EpisodeWindow(parts.task.outcomes, costs=costs),
            watch=watch_of(cfg.cost_limit, costs),
            costs=costs,
            watchdog=Watchdog(agent.loss, cfg.gamma, cfg.learning.reward_scale, critic_values),
            best=BestPolicy(run, agent.loss, cfg, costs),
            budget=Budget(cfg.episodes, cfg.frames),
            record_every=cfg.record_every,
            save_every=cfg.save_every,
            save_minutes=cfg.save_minutes,
            open_loggers=partial(build_loggers, cfg.logger.sinks, run),
        )
        if cfg.lagrange.signal._target_ is not None:
            make(cfg.lagrange.signal).register(trainer)
        if (projector := agent.projector) is not None:  # it may begin later
            trainer.after_collect.append(lambda _, spent: projector.set_progress(spent))
        unless_built.pop_all()
    return trainer
