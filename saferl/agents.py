"""From a Hydra configuration to an agent: networks, loss and projector."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from torchrl.objectives import LossModule, ValueEstimators

from saferl.checkpoint import latest, load_component, run_config
from saferl.components import Fitting, Networks
from saferl.envs.intersection.observation import FORMS
from saferl.envs.transforms import SafetyProjector
from saferl.modules import (
    CVaR,
    Largest,
    MeanStd,
    StateValue,
    tanh_gaussian_actor,
    value_operator,
    zero_output,
)
from saferl.validation import arguments

#: Options of a critic of action values, and what they are where nothing is said.
USUAL = {"outputs": 1, "layer_norm": False}


def _critic_options(critics: DictConfig) -> dict[str, Any]:
    given = {key: critics.get(key) for key in USUAL}
    return {key: USUAL[key] if value is None else value for key, value in given.items()}


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


def make(node: DictConfig, settings: Mapping[str, Any] | None = None, **objects: Any) -> Any:
    """Instantiate a node with live objects, which Hydra itself would turn into configurations.

    Args:
        node: with a ``_target_``.
        settings: in place of the node's own.
        **objects: arguments that the node may not set.

    Raises:
        ValueError: the node sets what the composition gives.
    """
    for key in set(node) & set(objects):
        raise ValueError(
            f"{node._get_full_key(key)} cannot be set: it follows from the rest of the configuration."
        )
    return hydra.utils.instantiate(node, _partial_=True, **(settings or {}))(**objects)


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


def _scales(cfg: DictConfig, network: str) -> dict[str, tuple[float, ...]]:
    """The scales of what is observed, and with them its sizes, as far as a network takes them and its
    configuration says none."""
    if "observation" not in cfg.task:
        return {}
    node, scales = cfg.encoder[network], FORMS[cfg.task.observation].scales
    accepted = arguments(node._target_)
    return {
        key: value
        for key, value in scales.items()
        if key not in node and (accepted is None or key in accepted)
    }


def _takes(cfg: DictConfig) -> set[str]:
    """Names of what the configured loss is built from."""
    return set(inspect.signature(hydra.utils.get_object(cfg.loss._target_)).parameters)


def on_policy(cfg: DictConfig) -> bool:
    """Whether the configured loss has state values, and so learns from fresh transitions alone."""
    return "critic_network" in _takes(cfg)


def _check_parts(cfg: DictConfig) -> None:
    """Refuse parts that do not go together."""
    takes, fresh, loss = _takes(cfg), on_policy(cfg), cfg.loss._target_
    parts = {
        "cost_critic": cfg.cost_critic.members > 0,
        "lagrange": cfg.lagrange.multiplier is not None,
    }
    for name, present in parts.items():
        if present and name not in takes:
            raise ValueError(f"{loss} takes no {name}: set {name}=none, or another loss.")
        if name in takes and not present:
            raise ValueError(f"{loss} needs {name}, got {name}=none.")
    # Of the action values: those of on-policy losses are for a projector alone.
    if "risk_critic" in takes and cfg.cost_critic.members < 2:
        raise ValueError(
            f"{loss} needs several members of Q_c(s, a): set cost_critic=twin, "
            f"got {cfg.cost_critic.members}."
        )
    has_risk = "risk_critic" in takes or (not fresh and "cost_critic" in takes)
    if cfg.projector._target_ is not None and not has_risk:
        raise ValueError(
            f"projector needs cost critics Q_c(s, a), which {loss} has not: "
            "set projector=none, or loss=sac_lag or ppo_risk."
        )
    risk = hydra.utils.get_object(cfg.risk._target_)

    def risk_is(kind: type) -> bool:
        return isinstance(risk, type) and issubclass(risk, kind)

    if not risk_is(Largest) and "risk" not in takes:
        raise ValueError(
            f"{loss} takes no risk, got {cfg.risk._target_}: set risk=largest, or loss=sac_lag."
        )
    if risk_is(CVaR) and cfg.cost_critic.get("outputs", 1) == 1:
        raise ValueError("risk=cvar is of quantiles: set cost_critic=quantile.")
    if risk_is(MeanStd) and cfg.cost_critic.members == 1:
        raise ValueError("risk=mean_std is of several members: set cost_critic=ensemble.")
    if cfg.get("cost_backup", "sum") != "sum" and "cost_backup" not in takes:
        raise ValueError(
            f"{loss} learns no Q_c(s, a): set cost_backup=sum, or loss=sac_lag, "
            f"got cost_backup={cfg.cost_backup}."
        )
    for name in ("critic", "cost_critic"):
        if not fresh or (name == "cost_critic" and "risk_critic" in takes):
            continue
        if cfg[name].members > 1:
            raise ValueError(
                f"{loss} has one state value: set {name}=single, got {cfg[name].members} members."
            )
        for key, value in _critic_options(cfg[name]).items():
            if value != USUAL[key]:
                raise ValueError(
                    f"{name}.{key} is of action values, which {loss} has not, got {value}."
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
        return hydra.utils.instantiate(cfg.encoder.policy, **_scales(cfg, "policy"))

    def action_values(critics: DictConfig) -> list[torch.nn.Module]:
        # Only what differs, so that an encoder need not know of options that it is not asked for.
        options = {k: v for k, v in _critic_options(critics).items() if v != USUAL[k]}
        return [
            hydra.utils.instantiate(cfg.encoder.value, **_scales(cfg, "value"), **options).to(
                device
            )
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

    def risk_critic() -> Any:
        # At 0, or a projector would correct every action before the first cost was seen.
        return alone_or_all(
            [
                action_value(zero_output(network), "state_action_cost_value")
                for network in action_values(cfg.cost_critic)
            ]
        )

    def cost_critic() -> Any:
        return state_value("state_cost_value") if on_policy(cfg) else risk_critic()

    encoder = policy_encoder()
    wanted: Any = encoder.in_keys
    if tuple(wanted) != keys:
        raise ValueError(
            f"{cfg.encoder.policy._target_} reads {', '.join(wanted)}, but task={cfg.task.task} observes "
            f"{', '.join(keys)}: set encoder=mlp, or an algorithm with one (rsac, sac, ...)."
        )
    actor = tanh_gaussian_actor(encoder, width, action_dim, keys, scale_init=cfg.initial_std).to(
        device
    )
    parts = {
        "actor_network": lambda: actor,
        "qvalue_network": lambda: alone_or_all(
            [action_value(network, "state_action_value") for network in action_values(cfg.critic)]
        ),
        "num_qvalue_nets": lambda: cfg.critic.members,
        "critic_network": lambda: state_value("state_value"),
        "cost_critic": cost_critic,
        "risk_critic": risk_critic,
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
    options = {
        f"task.{key}": cfg.task.get(key) for key in ("rows", "size", "action_dim", "observation")
    }
    takes = _takes(cfg)
    # Of the critics those of action values: state values have no options.
    critics = {"critic": "qvalue_network" in takes}
    critics["cost_critic"] = "risk_critic" in takes or (
        "cost_critic" in takes and not on_policy(cfg)
    )
    for network in ("policy", "value") if any(critics.values()) else ("policy",):
        for key, value in cfg.encoder[network].items():
            if key not in ("rows", "size"):  # the task
                options[f"encoder.{network}.{key}"] = value
    for name in ("critic", "cost_critic"):
        if critics[name] and cfg[name].members > 0:
            own = {"members": cfg[name].members, **_critic_options(cfg[name])}
            options |= {f"{name}.{key}": value for key, value in own.items()}
    return options


def begin_from(agent: Agent, cfg: DictConfig, path: Path) -> None:
    """Give an agent the networks of another run; all else stays as ``cfg`` says.

    Raises:
        FileNotFoundError: there is no checkpoint.
        ValueError: another architecture; names the options that differ.
    """
    found, theirs = latest(path, "init"), _architecture(run_config(path, "init"))
    differing = {
        key: f"{key} is {theirs[key]} there and {value} here"
        for key, value in _architecture(cfg).items()
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
