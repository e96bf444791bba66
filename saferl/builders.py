"""From a Hydra configuration to built objects."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase, RewardScaling, RewardSum, TransformedEnv
from torchrl.envs.transforms import Compose, Transform
from torchrl.objectives import LossModule, SoftUpdate
from tensordict.nn import TensorDictModuleBase

from saferl.checkpoint import latest, load_component
from saferl.envs.intersection import Scenario
from saferl.envs.transforms import ExecutedAction, SafetyProjector
from saferl.hooks import ProjectorProgress
from saferl.modules import tanh_gaussian_actor, value_operator
from saferl.trainer import Budget, Learner, Trainer

#: What the replay buffer keeps of a transition.
STORED = (
    "ego",
    "vehicles",
    "action",
    *(("next", key) for key in ("ego", "vehicles", "reward", "cost", "done", "terminated")),
    ("next", "action_executed"),
)


def device_of(cfg: DictConfig) -> torch.device:
    """The configured device; ``auto`` is a GPU where there is one.

    Raises:
        ValueError: an unknown device, or CUDA without a GPU.
    """
    name = cfg.device
    if name not in ("auto", "cpu", "cuda"):
        raise ValueError(f"device must be one of auto, cpu, cuda, got {name!r}.")
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("device=cuda, but torch sees no GPU; use device=cpu or auto.")
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)


def check(cfg: DictConfig) -> None:
    """Refuse numbers out of range, before anything is built.

    Raises:
        ValueError: names the key, the value and what is allowed.
    """
    bounds = {
        "gamma": (0.0, 1.0),
        "tau": (0.0, 1.0),
        "cost_limit": (0.0, float("inf")),
        "reward_scale": (0.0, float("inf")),
        "updates_per_frame": (0.0, float("inf")),
        "batch_size": (1, float("inf")),
        "buffer_size": (1, float("inf")),
        "warmup_frames": (1, float("inf")),
        "threads": (1, float("inf")),
        "evaluation.episodes": (1, float("inf")),
        "evaluation.num_envs": (1, float("inf")),
    }
    for key, (low, high) in bounds.items():
        value = OmegaConf.select(cfg, key)
        if value is None:
            continue
        if not isinstance(value, (int, float)) or not low <= value <= high:
            allowed = f">= {low}" if high == float("inf") else f"in [{low}, {high}]"
            raise ValueError(f"{key} must be {allowed}, got {value!r}.")
    if cfg.buffer_size < cfg.batch_size:
        raise ValueError(
            f"buffer_size must be >= batch_size, got {cfg.buffer_size} and {cfg.batch_size}."
        )
    for name, rates in cfg.lr.items():
        if len(rates) != 2 or min(rates) < 0:
            raise ValueError(f"lr.{name} must be [first, last], both >= 0, got {list(rates)}.")


def make(node: DictConfig, **objects: Any) -> Any:
    """Instantiate a node with live objects, which Hydra itself would turn into configurations."""
    return hydra.utils.instantiate(node, _partial_=True)(**objects)


def build_env(
    cfg: DictConfig, scenario: Scenario, num_envs: int, seed: int, *transforms: Transform
) -> EnvBase:
    """The configured backend with a scenario; transforms from the inside outwards."""
    env = make(cfg.env, scenario=scenario, num_envs=num_envs, seed=seed, device=device_of(cfg))
    return TransformedEnv(env, Compose(*transforms)) if transforms else env


@dataclass
class Agent:
    """Networks and loss of one composition.

    Attributes:
        actor: the policy.
        loss: owns the live parameters of all networks, targets, temperature and multiplier.
        projector: a :class:`SafetyProjector` on the loss's live cost critics, or None.
    """

    actor: TensorDictModuleBase
    loss: LossModule
    projector: SafetyProjector | None


def build_agent(cfg: DictConfig) -> Agent:
    """Networks, loss and projector, on the configured device."""
    width = cfg.encoder.policy.width
    actor = tanh_gaussian_actor(hydra.utils.instantiate(cfg.encoder.policy), width)

    def critics(members: int, out_key: str) -> list[TensorDictModuleBase]:
        networks = (hydra.utils.instantiate(cfg.encoder.value) for _ in range(members))
        return [value_operator(network, out_key=out_key) for network in networks]

    parts = {
        "actor_network": actor,
        "qvalue_network": critics(cfg.critic.members, "state_action_value"),
        "num_qvalue_nets": cfg.critic.members,
        "target_entropy": cfg.target_entropy,
    }
    if cfg.cost_critic.members:
        parts |= {
            "cost_critic": critics(cfg.cost_critic.members, "state_action_cost_value"),
            "num_cost_critics": cfg.cost_critic.members,
        }
    if cfg.lagrange.multiplier is not None:
        parts["lagrange"] = hydra.utils.instantiate(cfg.lagrange.multiplier)
    loss = make(cfg.loss, **parts).to(device_of(cfg))
    loss.make_value_estimator(gamma=cfg.gamma)
    projector = None
    if cfg.projector._target_ is not None:
        projector = make(cfg.projector, risk=loss.cost_value)
    return Agent(actor, loss, projector)


def load_agent(cfg: DictConfig, path: Path) -> Agent:
    """An agent with the weights of a run or checkpoint."""
    agent = build_agent(cfg)
    load_component(latest(path), agent.loss, "loss")
    return agent


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


def build_trainer(cfg: DictConfig, run: Path) -> Trainer:
    """Everything of a training run, wired; fails before the first environment step if it must."""
    check(cfg)
    budget = Budget(cfg.episodes, cfg.frames)
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    scenario = hydra.utils.instantiate(cfg.task)
    agent = load_agent(cfg, Path(cfg.init)) if cfg.init else build_agent(cfg)

    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    transforms = [sums, agent.projector] if agent.projector else [sums]
    num_envs = cfg.env.num_envs
    env = build_env(cfg, scenario, num_envs, cfg.seed, *transforms)
    collector = Collector(
        env,
        agent.actor,
        frames_per_batch=cfg.collector.frames_per_env * num_envs,
        total_frames=-1,
        init_random_frames=0 if cfg.init else cfg.warmup_frames,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(cfg.buffer_size, device=device_of(cfg)), batch_size=cfg.batch_size
    )
    buffer.append_transform(RewardScaling(0.0, cfg.reward_scale, in_keys=[("next", "reward")]))
    if agent.projector is not None:
        buffer.append_transform(ExecutedAction())
    learner = Learner(
        agent.loss,
        build_optimizer(cfg, agent.loss),
        SoftUpdate(agent.loss, tau=cfg.tau),
        compile=cfg.compile,
    )
    trainer = Trainer(
        run=run,
        collector=collector,
        buffer=buffer,
        learner=learner,
        budget=budget,
        stored=STORED,
        updates_per_frame=cfg.updates_per_frame,
        warmup_frames=cfg.warmup_frames,
        record_every=cfg.record_every,
        save_every=cfg.save_every,
        loggers=[make(sink, log_dir=str(run)) for sink in cfg.logger.sinks],
    )
    if cfg.lagrange.signal is not None:
        hydra.utils.instantiate(cfg.lagrange.signal).register(trainer)
    if agent.projector is not None:
        ProjectorProgress(agent.projector).register(trainer)
    return trainer
