"""From a Hydra configuration to built objects."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase, RewardScaling, RewardSum, TransformedEnv
from torchrl.envs.transforms import Compose, Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import LossModule, SoftUpdate

from saferl.checkpoint import latest, load_component, run_config
from saferl.components import Fitting, Networks
from saferl.envs.intersection import Scenario
from saferl.envs.intersection.drivers import CautiousDriver, Driver
from saferl.envs.transforms import ExecutedAction, SafetyProjector
from saferl.hooks import ProjectorProgress
from saferl.learner import Learner
from saferl.modules import compiled, tanh_gaussian_actor, value_operator, zero_output
from saferl.progress import Budget
from saferl.trainer import Trainer
from saferl.validation import check_training

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


def make(node: DictConfig, **objects: Any) -> Any:
    """Instantiate a node with live objects, which Hydra itself would turn into configurations."""
    return hydra.utils.instantiate(node, _partial_=True)(**objects)


def build_env(
    cfg: DictConfig, scenario: Scenario, num_envs: int, seed: int, *transforms: Transform
) -> EnvBase:
    """The configured backend with a scenario; transforms from the inside outwards."""
    env = make(cfg.env, scenario=scenario, num_envs=num_envs, seed=seed, device=device_of(cfg))
    return TransformedEnv(env, Compose(*transforms)) if transforms else env  # pyright: ignore


@torch.no_grad()
def demonstrate(cfg: DictConfig, scenario: Scenario) -> TensorDict:
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


def _check_parts(cfg: DictConfig) -> None:
    """Refuse parts that do not go together."""
    takes = inspect.signature(hydra.utils.get_object(cfg.loss._target_)).parameters
    constrained = "cost_critic" in takes
    parts = {
        "cost_critic": cfg.cost_critic.members > 0,
        "lagrange": cfg.lagrange.multiplier is not None,
    }
    for name, present in parts.items():
        if present and not constrained:
            raise ValueError(
                f"{cfg.loss._target_} takes no {name}: set {name}=none, or loss=sac_lag."
            )
        if constrained and not present:
            raise ValueError(f"{cfg.loss._target_} needs {name}, got {name}=none.")
    if cfg.projector._target_ is not None and not constrained:
        raise ValueError("projector needs cost critics: set projector=none, or loss=sac_lag.")


def build_agent(cfg: DictConfig) -> Agent:
    """Networks, loss and projector, on the configured device.

    Raises:
        ValueError: parts that do not go together.
    """
    _check_parts(cfg)
    device = device_of(cfg)
    width = cfg.encoder.policy.width
    actor = tanh_gaussian_actor(hydra.utils.instantiate(cfg.encoder.policy), width).to(device)

    def networks(members: int) -> list[torch.nn.Module]:
        return [hydra.utils.instantiate(cfg.encoder.value).to(device) for _ in range(members)]

    parts = {
        "actor_network": actor,
        "qvalue_network": [value_operator(network) for network in networks(cfg.critic.members)],
        "num_qvalue_nets": cfg.critic.members,
        "target_entropy": cfg.target_entropy,
        "alpha_init": cfg.alpha_init,
    }
    if cfg.cost_critic.members:
        parts |= {
            # At 0, or a projector would correct every action before the first cost was seen.
            "cost_critic": [
                value_operator(zero_output(network), out_key="state_action_cost_value")
                for network in networks(cfg.cost_critic.members)
            ],
            "num_cost_critics": cfg.cost_critic.members,
        }
    if cfg.lagrange.multiplier is not None:
        parts["lagrange"] = hydra.utils.instantiate(cfg.lagrange.multiplier)
    loss = make(cfg.loss, **parts).to(device)
    loss.make_value_estimator(gamma=cfg.gamma)
    projector = None
    if cfg.projector._target_ is not None:
        projector = make(cfg.projector, risk=loss.cost_value)
    return Agent(actor, loss, projector)


def load_agent(cfg: DictConfig, path: Path, name: str) -> Agent:
    """The agent of a run or checkpoint as it was; ``name`` is the option that gave it.

    Raises:
        FileNotFoundError: there is no checkpoint.
        ValueError: the checkpoint is of another architecture.
    """
    agent = build_agent(cfg)
    load_component(latest(path, name), Fitting(agent.loss))
    return agent


def _architecture(cfg: DictConfig) -> dict[str, Any]:
    """What decides whether the networks of two configurations fit, by option."""
    encoder = {f"encoder.policy.{key}": value for key, value in cfg.encoder.policy.items()}
    encoder.pop("encoder.policy.rows", None)  # it follows task.rows
    return {"algo_name": cfg.algo_name, "task.rows": cfg.task.rows, **encoder}


def begin_from(agent: Agent, cfg: DictConfig, path: Path) -> None:
    """Give an agent the networks of another run; all else stays as ``cfg`` says.

    Raises:
        FileNotFoundError: there is no checkpoint.
        ValueError: another architecture; names the options that differ.
    """
    try:
        load_component(latest(path, "init"), Networks(agent.loss))
    except ValueError as error:
        ours, theirs = _architecture(cfg), _architecture(run_config(path, "init"))
        differing = [
            f"{key} is {theirs[key]} there and {value} here"
            for key, value in ours.items()
            if key in theirs and theirs[key] != value
        ]
        if not differing:
            raise
        raise ValueError(
            f"init: the networks of {path} do not fit: {', '.join(differing)}."
        ) from error


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


def build_learner(cfg: DictConfig, loss: LossModule) -> Learner:
    """What makes an update of a loss: optimizer, targets, order, and whether it is compiled."""
    # A GPU would wait for Python between the many small kernels of a loss: CUDA graphs.
    mode = "reduce-overhead" if device_of(cfg).type == "cuda" else None
    return Learner(
        loss,
        build_optimizer(cfg, loss),
        SoftUpdate(loss, tau=cfg.tau),
        order=cfg.get("update_order", "joint"),  # a run from before this setting has none
        compile=partial(compiled, mode=mode) if cfg.compile else None,
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
    check_training(cfg)
    budget = Budget(cfg.episodes, cfg.frames)
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    scenario = hydra.utils.instantiate(cfg.task)
    agent = build_agent(cfg)
    if cfg.init:
        begin_from(agent, cfg, Path(cfg.init))

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
    device = device_of(cfg)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(cfg.buffer_size, device=device),
        batch_size=cfg.batch_size,
        generator=torch.Generator(device).manual_seed(cfg.seed),
    )
    buffer.append_transform(RewardScaling(0.0, cfg.reward_scale, in_keys=[("next", "reward")]))
    if agent.projector is not None:
        buffer.append_transform(ExecutedAction())
    trainer = Trainer(
        run=run,
        collector=collector,
        buffer=buffer,
        learner=build_learner(cfg, agent.loss),
        budget=budget,
        stored=STORED,
        updates_per_frame=cfg.updates_per_frame,
        warmup_frames=cfg.warmup_frames,
        record_every=cfg.record_every,
        save_every=cfg.save_every,
        save_minutes=cfg.get("save_minutes"),  # a run from before this setting has none
    )
    if cfg.lagrange.signal is not None:
        hydra.utils.instantiate(cfg.lagrange.signal).register(trainer)
    if agent.projector is not None:
        ProjectorProgress(agent.projector).register(trainer)
    if cfg.get("demonstrations"):
        trainer.demonstrate = lambda: demonstrate(cfg, scenario)
    trainer.open_loggers = lambda: build_loggers(cfg, run)
    return trainer
