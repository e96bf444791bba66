"""Names, kinds and ranges of the settings that belong to no part; Hydra checks names and kinds as it composes.

It needs no tensor: what is refused here is refused before torch is imported.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, is_dataclass
from importlib.util import find_spec
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf

from saferl.config.ranges import (
    DEVICES,
    EXPORTS,
    OBSERVATIONS,
    ORDERS,
    TRACED,
    above,
    at_least,
    drawing,
    limits,
    one_of,
    seeded,
    share,
)


@dataclass
class ActorCritic:
    """First and last learning rate of each group, linear in the spent budget."""

    actor: list[float] = MISSING
    critic: list[float] = MISSING

    def __post_init__(self):
        for each in fields(self):
            rates = getattr(self, each.name)
            if len(rates) != 2 or not all(0 <= rate < math.inf for rate in rates):
                raise ValueError(
                    f"learning.lr.{each.name} must be [first, last], both >= 0, got {rates}."
                )


@dataclass
class ActorCriticAlpha(ActorCritic):
    """Likewise, with the temperature's."""

    alpha: list[float] = MISSING


@dataclass
class Learning:
    """Settings that both families of algorithms have; conf/learning says what each is.

    Raises:
        ValueError: a number out of range.
    """

    batch_size: int = MISSING
    reward_scale: float = MISSING
    initial_std: float = MISSING

    def __post_init__(self):
        at_least(1, self, "batch_size", prefix="learning.")
        at_least(0.02, self, "initial_std", prefix="learning.")
        above(0, self, "reward_scale", prefix="learning.")


@dataclass
class OffPolicyLearning(Learning):
    """Settings of off-policy algorithms, conf/learning/off_policy.yaml."""

    lr: ActorCriticAlpha = MISSING
    buffer_size: int = MISSING
    frames_per_env: int = MISSING
    warmup_frames: int = MISSING
    demonstrations: int = MISSING
    updates_per_frame: float = MISSING
    update_order: str = MISSING
    tau: float = MISSING
    target_entropy: float = MISSING
    alpha_init: float = MISSING
    exploration: float = MISSING
    exploration_hold: int = MISSING

    def __post_init__(self):
        super().__post_init__()
        prefix = "learning."
        counts = ("buffer_size", "frames_per_env", "warmup_frames", "exploration_hold")
        at_least(1, self, *counts, prefix=prefix)
        at_least(0, self, "demonstrations", prefix=prefix)
        above(0, self, "updates_per_frame", "alpha_init", "tau", prefix=prefix)
        share(self, "tau", "exploration", prefix=prefix)
        one_of(ORDERS, self, "update_order", prefix=prefix)
        if not math.isfinite(self.target_entropy):
            raise ValueError(f"learning.target_entropy must be finite, got {self.target_entropy}.")
        for name in ("batch_size", "demonstrations"):
            if self.buffer_size < getattr(self, name):
                raise ValueError(
                    f"learning.buffer_size must be >= learning.{name}, got {self.buffer_size} and "
                    f"{getattr(self, name)}."
                )


@dataclass
class OnPolicyLearning(Learning):
    """Settings of on-policy algorithms, conf/learning/on_policy.yaml."""

    lr: ActorCritic = MISSING
    rollout_frames: int = MISSING
    epochs: int = MISSING
    gae_lambda: float = MISSING

    def __post_init__(self):
        super().__post_init__()
        at_least(1, self, "rollout_frames", "epochs", prefix="learning.")
        share(self, "gae_lambda", prefix="learning.")


@dataclass
class _OffPolicyNode(OffPolicyLearning):
    _target_: str = MISSING


@dataclass
class _OnPolicyNode(OnPolicyLearning):
    _target_: str = MISSING


@dataclass
class Lagrange:
    """A multiplier, and what moves it."""

    multiplier: dict[str, Any] = field(default_factory=dict)
    signal: dict[str, Any] = field(default_factory=dict)


@dataclass
class Logger:
    """TorchRL's loggers beside the CSV files."""

    sinks: list[Any] = field(default_factory=list)


@dataclass
class Critics:
    """A group of critics; the options are of action values alone."""

    members: int = MISSING
    outputs: int | None = None
    layer_norm: bool | None = None


@dataclass
class ClosingTest:
    """The test at the end of a training."""

    episodes: int = MISSING
    num_envs: int = MISSING
    drivers: list[str] = MISSING
    draw: str = MISSING
    draw_most: int = MISSING
    draw_format: str = MISSING

    def __post_init__(self):
        at_least(1, self, "episodes", "num_envs", prefix="evaluation.")
        drawing(self, prefix="evaluation.")


@dataclass
class Training:
    """The configuration of a training: its parts, which check themselves, and what belongs to none."""

    algo_name: str = MISSING
    task: dict[str, Any] = field(default_factory=dict)
    env: dict[str, Any] = field(default_factory=dict)
    encoder: dict[str, Any] = field(default_factory=dict)
    learning: Any = None
    critic: Critics = MISSING
    cost_critic: Critics = MISSING
    risk: dict[str, Any] = field(default_factory=dict)
    loss: dict[str, Any] = field(default_factory=dict)
    lagrange: Lagrange = field(default_factory=Lagrange)
    projector: dict[str, Any] = field(default_factory=dict)
    transform: dict[str, Any] = field(default_factory=dict)
    collector: dict[str, Any] = field(default_factory=dict)
    logger: Logger = field(default_factory=Logger)
    seed: int = MISSING
    device: str = MISSING
    threads: int = MISSING
    compile: bool = MISSING
    episodes: int | None = MISSING
    frames: int | None = MISSING
    gamma: float = MISSING
    cost_limit: Any = MISSING  # a number, or of several costs a list, or a mapping by their names
    risk_limit: Any = MISSING
    record_every: int = MISSING
    save_every: int = MISSING
    save_minutes: float | None = MISSING
    evaluation: ClosingTest = MISSING
    out: str | None = MISSING
    init: str | None = MISSING
    resume: str | None = MISSING

    def __post_init__(self):
        at_least(1, self.critic, "members", prefix="critic.")
        at_least(0, self.cost_critic, "members", prefix="cost_critic.")
        at_least(1, self.cost_critic, "outputs", prefix="cost_critic.")
        seeded(self)
        limits(self, "cost_limit", "risk_limit")
        at_least(1, self, "threads", "episodes", "frames", "record_every", "save_every")
        above(0, self, "save_minutes")
        share(self, "gamma")
        one_of(DEVICES, self, "device")
        if {"/", "\\"} & set(self.algo_name):
            raise ValueError(f"algo_name must be without / and \\, got {self.algo_name!r}.")


@dataclass
class Test:
    """The configuration of a test."""

    task: dict[str, Any] = field(default_factory=dict)
    env: dict[str, Any] = field(default_factory=dict)
    projector: dict[str, Any] = field(default_factory=dict)
    checkpoint: str | None = MISSING
    pretrained: str | None = MISSING
    policy: str | None = MISSING
    project: bool = MISSING
    episodes: int = MISSING
    seed: int = MISSING
    out: str | None = MISSING
    device: str = MISSING
    threads: int = MISSING
    compile: bool = MISSING
    draw: str = MISSING
    episode: Any = MISSING
    draw_most: int = MISSING
    draw_format: str = MISSING
    trace: str = MISSING
    why: bool = MISSING

    def __post_init__(self):
        at_least(1, self, "episodes", "threads")
        seeded(self)
        one_of(DEVICES, self, "device")
        one_of(TRACED, self, "trace")
        drawing(self)
        if self.episode is None:
            return
        if self.draw != "none":
            raise ValueError(f"Give one of draw and episode, got {self.draw} and {self.episode}.")
        numbers = self.episode if isinstance(self.episode, list) else [self.episode]
        if len(set(map(str, numbers))) < max(len(numbers), 1):
            raise ValueError(f"episode must be different numbers, got {self.episode}.")
        for number in numbers:
            if type(number) is not int or not 0 <= number < self.episodes:
                raise ValueError(
                    "episode must be a number or a list of numbers, each >= 0 and < "
                    f"episodes={self.episodes}, got {self.episode}."
                )


@dataclass
class Export:
    """The configuration of an export."""

    checkpoint: str | None = MISSING
    pretrained: str | None = MISSING
    out: str | None = MISSING
    format: str = MISSING
    project: bool = MISSING
    observation: str = MISSING

    def __post_init__(self):
        one_of(tuple(EXPORTS), self, "format")
        one_of(OBSERVATIONS, self, "observation")
        if missing := [name for name in EXPORTS[self.format] if find_spec(name) is None]:
            raise ValueError(
                f"format={self.format} needs {', '.join(missing)}: pip install 'saferl[onnx]'."
            )
        if self.observation == "state" and self.format == "torch":
            raise ValueError("observation=state is of format=pt2 or onnx, got format=torch.")


def _known(node: DictConfig, path: str = "") -> None:
    """Refuse keys that were added to settings whose names are known."""
    kind: Any = OmegaConf.get_type(node)
    names = [each.name for each in fields(kind)] if is_dataclass(kind) else list(node)
    for key in node:
        if key not in names:
            raise ValueError(
                f"unknown key {path}{key}; choose from {', '.join(n for n in names if n[0] != '_')}."
            )
        value = None if OmegaConf.is_missing(node, key) else node._get_node(key)
        if isinstance(value, DictConfig) and is_dataclass(OmegaConf.get_type(value)):
            _known(value, f"{path}{key}.")


def check(cfg: DictConfig) -> None:
    """Refuse numbers of a composed configuration that are out of range.

    Raises:
        ValueError: names the key, the value and what is allowed.
    """
    kind = OmegaConf.get_type(cfg)
    if kind not in (Training, Test, Export):
        return
    _known(cfg)
    own = {f.name: cfg[f.name] for f in fields(kind) if f.default is MISSING}
    OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(kind), own))  # pyright: ignore
    if kind is Export:
        return
    num_envs = cfg.env.get("num_envs")
    if isinstance(num_envs, int) and num_envs < 1:
        raise ValueError(f"env.num_envs must be >= 1, got {num_envs}.")
    learning: Any = OmegaConf.to_object(cfg.learning) if "learning" in cfg else None
    budget = cfg.frames if "frames" in cfg and cfg.frames is not None else math.inf
    if isinstance(learning, OffPolicyLearning) and budget < learning.warmup_frames:
        raise ValueError(
            f"learning.warmup_frames must be <= frames, or nothing is learned, got {learning.warmup_frames} and "
            f"{budget}."
        )


store = ConfigStore.instance()
store.store("schema", Training)
store.store("test_schema", Test)
store.store("export_schema", Export)
store.store("off_policy_schema", _OffPolicyNode, group="learning")
store.store("on_policy_schema", _OnPolicyNode, group="learning")
