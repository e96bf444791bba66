"""Algorithms that keep transitions and sample them again: SAC and its kin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase, RewardScaling
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import LossModule, SoftUpdate

from saferl.algorithms.base import Agent, Algorithm
from saferl.algorithms.networks import NetworkBuilder
from saferl.config.schema import OffPolicyLearning
from saferl.envs.task import Task
from saferl.envs.transforms import ExecutedAction
from saferl.modules import HeldActions
from saferl.training.experience import Replay
from saferl.training.learner import Learner


@dataclass
class OffPolicy(OffPolicyLearning, Algorithm):
    """Losses of action values Q(s, a), by a replay buffer."""

    values: ClassVar[str] = "qvalue_network"
    risks: ClassVar[str] = "cost_critic"
    kept: ClassVar[str] = "learning.buffer_size"

    def loss_parts(self, networks: NetworkBuilder) -> dict[str, Callable[[], Any]]:
        critic = networks.parts.critic
        return {
            "qvalue_network": lambda: networks.action_values(critic, "state_action_value"),
            "cost_critic": networks.risk_critics,
            "target_entropy": lambda: self.target_entropy * networks.parts.task.action_dim,
            "alpha_init": lambda: self.alpha_init,
        }

    def estimate(self, loss: LossModule, gamma: float) -> None:
        loss.make_value_estimator(gamma=gamma)

    def learner(self, loss: LossModule, compile: bool) -> Learner:
        targets = any(name.startswith("target_") for name, _ in loss.named_buffers())
        return Learner(
            loss,
            self.optimizer(loss),
            SoftUpdate(loss, tau=self.tau) if targets else None,
            order=self.update_order,
            compile=compile,
        )

    def decisions(self, num_envs: int) -> int:
        return self.frames_per_env

    def behaviour(self, actor: Any, env: EnvBase) -> Any:
        if not self.exploration:
            return actor
        held: Any = HeldActions(env.action_spec, self.exploration, self.exploration_hold)
        return TensorDictSequential(actor, held)

    def random_frames(self) -> int:
        return self.warmup_frames

    def check_collecting(self, task: Task, num_envs: int) -> None:
        if self.demonstrations and not task.demonstrators:
            raise ValueError(
                f"learning.demonstrations are of scripted drivers, which task={task.task} has not: "
                f"set learning.demonstrations=0, got {self.demonstrations}."
            )
        collected = num_envs * self.frames_per_env
        if self.buffer_size < collected:
            raise ValueError(
                f"learning.buffer_size must be >= env.num_envs * learning.frames_per_env, got {self.buffer_size} "
                f"and {collected}."
            )

    def experience(
        self,
        agent: Agent,
        task: Task,
        build_env: Callable[[int, int], EnvBase],
        num_envs: int,
        seed: int,
    ) -> Replay:
        device = next(agent.loss.parameters()).device
        generator = torch.Generator(device).manual_seed(seed)
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(self.buffer_size, device=device),
            batch_size=self.batch_size,
            generator=generator,
        )
        buffer.append_transform(RewardScaling(0.0, self.reward_scale, in_keys=[("next", "reward")]))
        if agent.projector is not None:
            buffer.append_transform(ExecutedAction())
        return Replay(
            buffer,
            stored=agent.stored,
            updates_per_frame=self.updates_per_frame,
            warmup_frames=self.warmup_frames,
            demonstrate=partial(self.demonstrate, task, build_env, num_envs, seed)
            if self.demonstrations
            else None,
            generator=generator,
        )

    @torch.no_grad()
    def demonstrate(
        self, task: Task, build_env: Callable[[int, int], EnvBase], num_envs: int, seed: int
    ) -> TensorDict:
        """Transitions [N] of the task's demonstrators, N at least ``demonstrations``.

        Each gives a share (on the road half are a cautious driver's and half a blind one's), all with Gaussian noise
        of 0.2 on the action, so that failures and successes are both among them.
        """
        parts = []
        steps = -(-self.demonstrations // (len(task.demonstrators) * num_envs))
        for number, name in enumerate(task.demonstrators):
            env, driver = build_env(num_envs, seed + 1 + number), task.driver(name)
            noise = AdditiveGaussianModule(env.action_spec, sigma_init=0.2, sigma_end=0.2)
            policy = TensorDictSequential([driver, noise.to(env.device)])
            with set_exploration_type(ExplorationType.RANDOM):
                data = env.rollout(steps, policy, break_when_any_done=False).reshape(-1)
            parts.append(data.set(("next", "action_executed"), data["action"].clone()))
            env.close()
        return TensorDict.cat(parts)  # pyright: ignore[reportReturnType]
