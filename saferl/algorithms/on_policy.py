"""Algorithms that learn from fresh transitions alone: PPO, CPO and their kin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import EnvBase, InitTracker, Transform
from torchrl.objectives import LossModule, ValueEstimators

from saferl.algorithms.base import Agent, Algorithm
from saferl.algorithms.networks import NetworkBuilder, refuse_options
from saferl.algorithms.parts import Parts
from saferl.config.schema import OnPolicyLearning
from saferl.envs.task import Task
from saferl.modules import StateValue, value_operator
from saferl.objectives.advantages import score_actions
from saferl.training.experience import Epochs
from saferl.training.learner import Learner

#: What losses read besides, once their ``begin`` has seen a batch.
ADVANTAGES = (
    *("action_log_prob", "advantage", "value_target", "state_value"),
    *("cost_advantage", "cost_value_target"),
)


@dataclass
class OnPolicy(OnPolicyLearning, Algorithm):
    """Losses of state values V(s), by each batch of fresh transitions."""

    values: ClassVar[str] = "critic_network"
    risks: ClassVar[str] = "risk_critic"
    kept: ClassVar[str] = "learning.rollout_frames"

    def check(self, parts: Parts) -> None:
        super().check(parts)
        loss, has_risk = parts.loss._target_, self.risks in parts.takes
        # Of the action values: those of on-policy losses are for a projector alone.
        if has_risk and parts.cost_critic.members < 2:
            raise ValueError(
                f"{loss} needs several members of Q_c(s, a): set cost_critic=twin, "
                f"got {parts.cost_critic.members}."
            )
        for name in ("critic",) if has_risk else ("critic", "cost_critic"):
            critics = getattr(parts, name)
            if critics.members > 1:
                raise ValueError(
                    f"{loss} has one state value: set {name}=single, got {critics.members} members."
                )
            refuse_options(name, critics, f"is of action values, which {loss} has not")

    def loss_parts(self, networks: NetworkBuilder) -> dict[str, Callable[[], Any]]:
        def state_value(out_key: str, outputs: int = 1) -> torch.nn.Module:
            features = networks.encoder.policy()
            network = StateValue(features, networks.encoder.width, outputs)
            network = network.to(networks.parts.device)
            return value_operator(network, in_keys=networks.reads(features), out_key=out_key)

        costs = len(networks.parts.task.costs)
        return {
            "critic_network": lambda: state_value("state_value"),
            "cost_critic": lambda: state_value("state_cost_value", costs),
            "risk_critic": networks.risk_critics,
        }

    def estimate(self, loss: LossModule, gamma: float) -> None:
        loss.make_value_estimator(ValueEstimators.GAE, gamma=gamma, lmbda=self.gae_lambda)

    def learner(self, loss: LossModule, compile: bool) -> Learner:
        return Learner(loss, self.optimizer(loss), compile=compile)

    def decisions(self, num_envs: int) -> int:
        return -(-self.rollout_frames // num_envs)

    def transforms(self) -> list[Transform]:
        return [InitTracker()]

    def check_collecting(self, task: Task, num_envs: int) -> None:
        frames = self.decisions(num_envs) * num_envs
        if self.batch_size > frames:
            raise ValueError(
                f"learning.batch_size must be <= {frames}, the frames of a batch from one policy "
                f"(learning.rollout_frames), got {self.batch_size}."
            )

    def experience(
        self,
        agent: Agent,
        task: Task,
        build_env: Callable[[int, int], EnvBase],
        num_envs: int,
        seed: int,
    ) -> Epochs:
        frames = self.decisions(num_envs) * num_envs
        device = next(agent.loss.parameters()).device
        generator = torch.Generator(device).manual_seed(seed)
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(frames, device=device),
            # Without the rest of an epoch: a small batch would weigh as much as a whole one.
            sampler=SamplerWithoutReplacement(drop_last=True),
            batch_size=self.batch_size,
            generator=generator,
        )
        return Epochs(
            buffer,
            stored=(*agent.stored, *ADVANTAGES, *agent.loss.in_keys),
            begin=begin_of(agent.loss),
            epochs=self.epochs,
            reward_scale=self.reward_scale,
            generator=generator,
        )


def begin_of(loss: Any) -> Callable[[TensorDictBase], None]:
    """What an on-policy loss does with a whole batch: its advantages, and the step of its policy if it has one."""
    if hasattr(loss, "begin"):
        hooks = [loss.begin, *([loss.policy_step().step] if hasattr(loss, "policy_step") else [])]
    else:  # TorchRL's own losses leave their advantages to their estimator
        estimate = partial(
            loss.value_estimator,
            params=loss.critic_network_params.detach(),
            target_params=loss.target_critic_network_params,
        )
        hooks = [partial(score_actions, loss), estimate]

    def begin(data: TensorDictBase) -> None:
        for hook in hooks:
            hook(data)

    return begin
