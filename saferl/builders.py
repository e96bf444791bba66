"""From a Hydra configuration to built objects."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, get_type_hints

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import EnvBase, InitTracker, RewardScaling, RewardSum, TransformedEnv
from torchrl.envs.transforms import Compose, Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import LossModule, SoftUpdate

from saferl.agents import Agent, begin_from, build_agent, device_of, make, observed, on_policy
from saferl.checkpoint import FOLDER
from saferl.envs.intersection import Scenario
from saferl.envs.intersection.drivers import CautiousDriver, Driver
from saferl.envs.transforms import ExecutedAction
from saferl.experience import Epochs, Replay
from saferl.hooks import ProjectorProgress
from saferl.learner import Learner
from saferl.modules import HeldActions
from saferl.progress import Budget
from saferl.trainer import Trainer
from saferl.validation import arguments, check_targets, check_training

#: What is kept of a transition besides the observation.
STORED = (
    "action",
    *(("next", key) for key in ("reward", "cost", "done", "terminated")),
    ("next", "action_executed"),
)
#: What on-policy losses read besides, once their ``begin`` has seen it.
ADVANTAGES = (
    *("action_log_prob", "advantage", "value_target", "state_value"),
    *("cost_advantage", "cost_value_target"),
)


def complete(cfg: DictConfig) -> None:
    """Write into a configuration what its task takes from the environment itself.

    Raises:
        ValueError: the task's settings cannot be meant.
    """
    if "reward" in cfg.task and "reward" not in (arguments(cfg.task._target_) or {"reward"}):
        raise ValueError(
            f"shaping changes the road's reward, which task={cfg.task.task} has not: set shaping=none."
        )
    check_targets(cfg.task, "task")
    task = hydra.utils.instantiate(cfg.task)
    if hasattr(task, "complete"):
        OmegaConf.update(cfg, "task", task.complete())


def build_env(
    cfg: DictConfig, scenario: Any, num_envs: int, seed: int, *transforms: Transform
) -> EnvBase:
    """The configured backend with a scenario; transforms from the inside outwards.

    Raises:
        ValueError: the backend is of another kind of task.
    """
    backend = hydra.utils.get_object(cfg.env._target_)
    kind = get_type_hints(backend.__init__).get("scenario", object)
    if not isinstance(scenario, kind):
        raise ValueError(
            f"{cfg.env._target_} plays a {kind.__name__}, but task={scenario.task} is a "
            f"{type(scenario).__name__}: leave env= to the task."
        )
    # A test has a number of environments of its own.
    settings = {"num_envs": num_envs}
    env = make(cfg.env, settings, scenario=scenario, seed=seed, device=device_of(cfg))
    return TransformedEnv(env, Compose(*transforms)) if transforms else env  # pyright: ignore


@torch.no_grad()
def demonstrate(cfg: DictConfig, scenario: Any) -> TensorDict:
    """Transitions [N] of scripted drivers for the replay buffer, N at least ``cfg.demonstrations``.

    Half of them are a cautious driver's and half a blind one's, all with Gaussian noise of 0.2 on
    the action, so that crashes and arrivals are both among them.
    """
    num_envs, parts = cfg.env.num_envs, []
    steps = -(-cfg.demonstrations // (2 * num_envs))
    for number, driver in enumerate((CautiousDriver(), Driver())):
        env = build_env(cfg, scenario, num_envs, cfg.seed + 1 + number)
        noise = AdditiveGaussianModule(env.action_spec, sigma_init=0.2, sigma_end=0.2)
        policy = TensorDictSequential([driver, noise.to(env.device)])
        with set_exploration_type(ExplorationType.RANDOM):
            data = env.rollout(steps, policy, break_when_any_done=False).reshape(-1)
        parts.append(data.set(("next", "action_executed"), data["action"].clone()))
        env.close()
    return TensorDict.cat(parts)  # pyright: ignore[reportReturnType]


def build_optimizer(cfg: DictConfig, loss: LossModule) -> torch.optim.Optimizer:
    """Adam with one group each for actor, critics and temperature, and their schedules."""
    groups: dict[str, list[torch.nn.Parameter]] = {"actor": [], "critic": [], "alpha": []}
    for name, parameter in loss.named_parameters():
        kind = {"actor_network_params": "actor", "log_alpha": "alpha"}.get(
            name.split(".")[0], "critic"
        )
        groups[kind].append(parameter)
    return torch.optim.Adam(
        [
            {
                "params": parameters,
                "name": name,
                "lr": cfg.lr[name][0],
                "schedule": tuple(cfg.lr[name]),
            }
            for name, parameters in groups.items()
            if parameters
        ],
        fused=True,
    )


def _has_targets(loss: LossModule) -> bool:
    """Whether some network has target parameters of its own."""
    return any(name.startswith("target_") for name, _ in loss.named_buffers())


def build_learner(cfg: DictConfig, loss: LossModule) -> Learner:
    """What makes an update of a loss: optimizer, targets, order, and whether it is compiled."""
    return Learner(
        loss,
        build_optimizer(cfg, loss),
        SoftUpdate(loss, tau=cfg.tau) if _has_targets(loss) else None,
        order=cfg.update_order,
        compile=cfg.compile,
        before_updates=_before_updates(loss) if on_policy(cfg) else (),
    )


def _before_updates(loss: Any) -> list[Callable[[TensorDictBase], Any]]:
    """What an on-policy loss does with a whole batch: its advantages, and the step of its policy if it has one."""
    # TorchRL's own losses leave their advantages to their estimator.
    begin = getattr(loss, "begin", None) or partial(
        loss.value_estimator,
        params=loss.critic_network_params.detach(),
        target_params=loss.target_critic_network_params,
    )
    return [begin, loss.policy_step().step] if hasattr(loss, "policy_step") else [begin]


def build_experience(
    cfg: DictConfig, agent: Agent, scenario: Any, learner: Learner
) -> Replay | Epochs:
    """What the learner updates from: a replay buffer, or each batch of fresh transitions.

    Raises:
        ValueError: the loss cannot learn from what is configured.
    """
    fresh, loss_name = on_policy(cfg), cfg.loss._target_
    if fresh != issubclass(hydra.utils.get_class(cfg.experience._target_), Epochs):
        name = "epochs" if fresh else "replay"
        raise ValueError(
            f"{loss_name} learns from experience={name}, got {cfg.experience._target_}."
        )
    demonstrations = cfg.demonstrations
    if demonstrations and fresh:
        raise ValueError(
            f"demonstrations are for a replay buffer, which {loss_name} has not: "
            f"set demonstrations=0, got {demonstrations}."
        )
    if demonstrations and not isinstance(scenario, Scenario):
        raise ValueError(
            f"demonstrations are of drivers on a road, which task={scenario.task} has not: "
            f"set demonstrations=0, got {demonstrations}."
        )
    device = device_of(cfg)
    generator = torch.Generator(device).manual_seed(cfg.seed)
    keys = (*observed(cfg), *(("next", key) for key in observed(cfg)))
    if fresh:
        frames = cfg.collector.frames_per_env * cfg.env.num_envs
        if cfg.batch_size > frames:
            raise ValueError(
                f"batch_size must be <= {frames}, the frames of a batch from one policy (collector=rollout, "
                f"rollout_frames), got {cfg.batch_size}."
            )
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(frames, device=device),
            # Without the rest of an epoch: a small batch would weigh as much as a whole one.
            sampler=SamplerWithoutReplacement(drop_last=True),
            batch_size=cfg.batch_size,
            generator=generator,
        )
        stored = (*keys, *STORED, *ADVANTAGES)
        return make(
            cfg.experience,
            buffer=buffer,
            stored=stored,
            begin=learner.begin,
            reward_scale=cfg.reward_scale,
        )
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(cfg.buffer_size, device=device),
        batch_size=cfg.batch_size,
        generator=generator,
    )
    buffer.append_transform(RewardScaling(0.0, cfg.reward_scale, in_keys=[("next", "reward")]))
    if agent.projector is not None:
        buffer.append_transform(ExecutedAction())
    return make(
        cfg.experience,
        buffer=buffer,
        stored=(*keys, *STORED),
        updates_per_frame=cfg.updates_per_frame,
        warmup_frames=cfg.warmup_frames,
        demonstrate=partial(demonstrate, cfg, scenario) if demonstrations else None,
    )


def build_loggers(cfg: DictConfig, run: Path) -> list:
    """TorchRL loggers that write into the run's folder.

    Raises:
        ValueError: a logger's own package is not installed.
    """
    try:
        return [make(sink, log_dir=str(run)) for sink in cfg.logger.sinks]
    except ImportError as error:
        names = ", ".join(sink._target_ for sink in cfg.logger.sinks)
        raise ValueError(
            f"logger: {names} needs a package that is not installed ({error}); "
            "install it (pip install 'saferl[wandb]' for W&B), or use logger=tensorboard or none."
        ) from error


def build_trainer(cfg: DictConfig, run: Path) -> Trainer:
    """Everything of a training run, wired; fails before the first environment step if it must.

    Raises:
        ValueError: something in the configuration cannot be meant; names the key.
        FileNotFoundError: ``init`` names no checkpoint.
    """
    complete(cfg)
    check_training(cfg)
    budget = Budget(cfg.episodes, cfg.frames)
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    scenario = hydra.utils.instantiate(cfg.task)
    agent = build_agent(cfg)
    if cfg.init and not (run / FOLDER).exists():  # a run that goes on has its own networks
        begin_from(agent, cfg, Path(cfg.init))

    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    transforms: list[Transform] = [sums]
    if on_policy(cfg):
        transforms.append(InitTracker())
    if agent.projector is not None:
        transforms.append(agent.projector)
    num_envs = cfg.env.num_envs
    env = build_env(cfg, scenario, num_envs, cfg.seed, *transforms)
    policy: Any = agent.actor
    if cfg.exploration and not on_policy(cfg):
        explore: Any = HeldActions(env.action_spec, cfg.exploration, cfg.exploration_hold)
        policy = TensorDictSequential(policy, explore)
    collector = Collector(
        env,
        policy,
        frames_per_batch=cfg.collector.frames_per_env * num_envs,
        total_frames=-1,
        init_random_frames=0 if cfg.init or on_policy(cfg) else cfg.warmup_frames,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    learner = build_learner(cfg, agent.loss)
    trainer = Trainer(
        run=run,
        collector=collector,
        experience=build_experience(cfg, agent, scenario, learner),
        learner=learner,
        budget=budget,
        record_every=cfg.record_every,
        save_every=cfg.save_every,
        save_minutes=cfg.get("save_minutes"),  # a run from before this setting has none
    )
    if cfg.lagrange.signal is not None:
        hydra.utils.instantiate(cfg.lagrange.signal).register(trainer)
    if agent.projector is not None and hasattr(agent.projector, "set_progress"):
        ProjectorProgress(agent.projector).register(trainer)
    trainer.open_loggers = lambda: build_loggers(cfg, run)
    return trainer
