"""From a Hydra configuration to built objects."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, get_type_hints

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import EnvBase, InitTracker, RewardScaling, RewardSum, TransformedEnv
from torchrl.envs.transforms import Compose, Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import LossModule, SoftUpdate, ValueEstimators

from saferl.checkpoint import latest, load_component, run_config
from saferl.components import Fitting, Networks
from saferl.envs.intersection.drivers import CautiousDriver, Driver
from saferl.envs.transforms import ExecutedAction, SafetyProjector
from saferl.experience import Epochs, Replay
from saferl.hooks import ProjectorProgress
from saferl.learner import Learner
from saferl.modules import (
    StateValue,
    compiled,
    tanh_gaussian_actor,
    value_operator,
    zero_output,
)
from saferl.progress import Budget
from saferl.trainer import Trainer
from saferl.validation import check_targets, check_training

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
    env = make(cfg.env, scenario=scenario, num_envs=num_envs, seed=seed, device=device_of(cfg))
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


def observed(cfg: DictConfig) -> tuple[str, ...]:
    """Keys of what the configured task observes."""
    return ("observation",) if "size" in cfg.task else ("ego", "vehicles")


def complete(cfg: DictConfig) -> None:
    """Write into a configuration what its task takes from the environment itself.

    Raises:
        ValueError: the task's settings cannot be meant.
    """
    check_targets(cfg.task, "task")
    task = hydra.utils.instantiate(cfg.task)
    if hasattr(task, "complete"):
        OmegaConf.update(cfg, "task", task.complete())


def _takes(cfg: DictConfig) -> set[str]:
    """Names of what the configured loss is built from."""
    return set(inspect.signature(hydra.utils.get_object(cfg.loss._target_)).parameters)


def on_policy(cfg: DictConfig) -> bool:
    """Whether the configured loss has state values, and so learns from fresh transitions alone."""
    return "critic_network" in _takes(cfg)


def _check_parts(cfg: DictConfig) -> None:
    """Refuse parts that do not go together."""
    takes, loss = _takes(cfg), cfg.loss._target_
    fresh = "critic_network" in takes
    parts = {
        "cost_critic": cfg.cost_critic.members > 0,
        "lagrange": cfg.lagrange.multiplier is not None,
    }
    for name, present in parts.items():
        if present and name not in takes:
            raise ValueError(f"{loss} takes no {name}: set {name}=none, or loss=sac_lag.")
        if name in takes and not present:
            raise ValueError(f"{loss} needs {name}, got {name}=none.")
    if cfg.projector._target_ is not None and (fresh or "cost_critic" not in takes):
        raise ValueError(
            f"projector needs cost critics Q_c(s, a), which {loss} has not: "
            "set projector=none, or loss=sac_lag."
        )
    for name in ("critic", "cost_critic"):
        if fresh and cfg[name].members > 1:
            raise ValueError(
                f"{loss} has one state value: set {name}=single, got {cfg[name].members} members."
            )


def build_agent(cfg: DictConfig) -> Agent:
    """Networks, loss and projector, on the configured device.

    Raises:
        ValueError: parts that do not go together.
    """
    _check_parts(cfg)
    device, takes, keys = device_of(cfg), _takes(cfg), observed(cfg)
    width, action_dim = cfg.encoder.policy.width, cfg.task.get("action_dim", 2)

    def policy_encoder() -> torch.nn.Module:
        return hydra.utils.instantiate(cfg.encoder.policy)

    def action_values(critics: DictConfig) -> list[torch.nn.Module]:
        # Only what differs, so that an encoder need not know of options that it is not asked for.
        asked = {"outputs": critics.get("outputs", 1), "layer_norm": critics.get("layer_norm")}
        options = {key: value for key, value in asked.items() if value not in (1, False, None)}
        return [
            hydra.utils.instantiate(cfg.encoder.value, **options).to(device)
            for _ in range(critics.members)
        ]

    def state_value(out_key: str) -> torch.nn.Module:
        network = StateValue(policy_encoder(), width).to(device)
        return value_operator(network, in_keys=keys, out_key=out_key)

    def action_value(network: torch.nn.Module, out_key: str) -> torch.nn.Module:
        return value_operator(network, in_keys=(*keys, "action"), out_key=out_key)

    def alone_or_all(members: list[torch.nn.Module]) -> Any:
        # Of a list of one TorchRL makes parameters that no optimizer sees.
        return members[0] if len(members) == 1 else members

    def cost_critic() -> Any:
        if on_policy(cfg):
            return state_value("state_cost_value")
        # At 0, or a projector would correct every action before the first cost was seen.
        return alone_or_all(
            [
                action_value(zero_output(network), "state_action_cost_value")
                for network in action_values(cfg.cost_critic)
            ]
        )

    encoder = policy_encoder()
    wanted: Any = encoder.in_keys
    if tuple(wanted) != keys:
        raise ValueError(
            f"{cfg.encoder.policy._target_} reads {', '.join(wanted)}, but task={cfg.task.task} observes "
            f"{', '.join(keys)}: set encoder=mlp, or an algorithm without attention (rsac, sac, ...)."
        )
    actor = tanh_gaussian_actor(encoder, width, action_dim, keys).to(device)
    parts = {
        "actor_network": lambda: actor,
        "qvalue_network": lambda: alone_or_all(
            [action_value(network, "state_action_value") for network in action_values(cfg.critic)]
        ),
        "num_qvalue_nets": lambda: cfg.critic.members,
        "critic_network": lambda: state_value("state_value"),
        "cost_critic": cost_critic,
        "num_cost_critics": lambda: cfg.cost_critic.members,
        "lagrange": lambda: hydra.utils.instantiate(cfg.lagrange.multiplier),
        "target_entropy": lambda: cfg.target_entropy,
        "alpha_init": lambda: cfg.alpha_init,
    }
    loss = make(cfg.loss, **{k: part() for k, part in parts.items() if k in takes}).to(device)
    if on_policy(cfg):
        loss.make_value_estimator(ValueEstimators.GAE, gamma=cfg.gamma, lmbda=cfg.gae_lambda)
    else:
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


def _has_targets(loss: LossModule) -> bool:
    """Whether some network has target parameters of its own."""
    return any(name.startswith("target_") for name, _ in loss.named_buffers())


def build_learner(cfg: DictConfig, loss: LossModule) -> Learner:
    """What makes an update of a loss: optimizer, targets, order, and whether it is compiled."""
    # A GPU would wait for Python between the many small kernels of a loss: CUDA graphs.
    mode = "reduce-overhead" if device_of(cfg).type == "cuda" else None
    return Learner(
        loss,
        build_optimizer(cfg, loss),
        SoftUpdate(loss, tau=cfg.tau) if _has_targets(loss) else None,
        order=cfg.get("update_order", "joint"),  # a run from before this setting has none
        compile=partial(compiled, mode=mode) if cfg.compile else None,
    )


def build_experience(cfg: DictConfig, agent: Agent, scenario: Any) -> Replay | Epochs:
    """What the learner updates from: a replay buffer, or each batch of fresh transitions.

    Raises:
        ValueError: the loss cannot learn from what is configured.
    """
    fresh = on_policy(cfg)
    if fresh != cfg.experience._target_.endswith("Epochs"):
        name, loss = "epochs" if fresh else "replay", cfg.loss._target_
        raise ValueError(f"{loss} learns from experience={name}, got {cfg.experience._target_}.")
    device = device_of(cfg)
    generator = torch.Generator(device).manual_seed(cfg.seed)
    keys = (*observed(cfg), *(("next", key) for key in observed(cfg)))
    if fresh:
        loss: Any = agent.loss
        frames = cfg.collector.frames_per_env * cfg.env.num_envs
        # TorchRL's own losses leave their advantages to their estimator.
        begin = getattr(loss, "begin", None) or partial(
            loss.value_estimator,
            params=loss.critic_network_params.detach(),
            target_params=loss.target_critic_network_params,
        )
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(frames, device=device),
            sampler=SamplerWithoutReplacement(),
            batch_size=cfg.batch_size,
            generator=generator,
        )
        stored = (*keys, *STORED, *ADVANTAGES)
        return make(
            cfg.experience, buffer=buffer, stored=stored, begin=begin, reward_scale=cfg.reward_scale
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
        demonstrate=partial(demonstrate, cfg, scenario) if cfg.get("demonstrations") else None,
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
    if cfg.init:
        begin_from(agent, cfg, Path(cfg.init))

    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    transforms: list[Transform] = [sums]
    if on_policy(cfg):
        transforms.append(InitTracker())
    if agent.projector is not None:
        transforms.append(agent.projector)
    num_envs = cfg.env.num_envs
    env = build_env(cfg, scenario, num_envs, cfg.seed, *transforms)
    collector = Collector(
        env,
        agent.actor,
        frames_per_batch=cfg.collector.frames_per_env * num_envs,
        total_frames=-1,
        init_random_frames=0 if cfg.init or on_policy(cfg) else cfg.warmup_frames,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    trainer = Trainer(
        run=run,
        collector=collector,
        experience=build_experience(cfg, agent, scenario),
        learner=build_learner(cfg, agent.loss),
        budget=budget,
        record_every=cfg.record_every,
        save_every=cfg.save_every,
        save_minutes=cfg.get("save_minutes"),  # a run from before this setting has none
    )
    if cfg.lagrange.signal is not None:
        hydra.utils.instantiate(cfg.lagrange.signal).register(trainer)
    if agent.projector is not None:
        ProjectorProgress(agent.projector).register(trainer)
    trainer.open_loggers = lambda: build_loggers(cfg, run)
    return trainer
