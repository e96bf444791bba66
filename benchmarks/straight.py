"""One gradient update of SAC-Lagrangian (E11 to E14) written straight in PyTorch, as CleanRL would.

The baseline that ``benchmarks/update.py`` times :class:`saferl.objectives.SACLagLoss` against:
plain modules, one optimizer for each kind of parameter, and every loss spelled out.
"""

from __future__ import annotations

import copy

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from saferl.modules import EGO_SCALE, VEHICLE_SCALE

ACTION_DIM = 2
LOG_STD_MIN, LOG_STD_MAX = -5.0, 2.0
LOG_SQRT_2PI = 0.9189385332046727

# The rates that the project's own training begins with.
ACTOR_LR, CRITIC_LR, ALPHA_LR, MULTIPLIER_LR = 3e-4, 1e-3, 3e-4, 1e-4


def mlp(inputs: int, width: int, outputs: int) -> nn.Sequential:
    """Three hidden layers with GELU."""
    return nn.Sequential(
        nn.Linear(inputs, width),
        nn.GELU(),
        nn.Linear(width, width),
        nn.GELU(),
        nn.Linear(width, width),
        nn.GELU(),
        nn.Linear(width, outputs),
    )


class Actor(nn.Module):
    """A tanh-squashed Gaussian policy over the flattened scene [B, 9 + 6 rows]."""

    def __init__(self, width: int = 256, rows: int = 11):
        super().__init__()
        self.net = mlp(len(EGO_SCALE) + rows * len(VEHICLE_SCALE), width, 2 * ACTION_DIM)

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log of the standard deviation, each [B, 2]."""
        mean, log_std = self.net(obs).chunk(2, dim=1)
        log_std = LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (torch.tanh(log_std) + 1)
        return mean, log_std

    def sample(self, obs: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Action [B, 2] that standard normal ``noise`` gives, and its log-probability [B, 1]."""
        mean, log_std = self(obs)
        action = torch.tanh(mean + log_std.exp() * noise)
        log_prob = -0.5 * noise.pow(2) - log_std - LOG_SQRT_2PI
        log_prob = log_prob - torch.log(1 - action.pow(2) + 1e-6)
        return action, log_prob.sum(1, keepdim=True)


class Critic(nn.Module):
    """The value [B, 1] of an action in a flattened scene."""

    def __init__(self, width: int = 256, rows: int = 11):
        super().__init__()
        self.net = mlp(len(EGO_SCALE) + rows * len(VEHICLE_SCALE) + ACTION_DIM, width, 1)

    def forward(self, obs: Tensor, action: Tensor) -> Tensor:
        return self.net(torch.cat([obs, action], dim=1))


class StraightSACLag:
    """Networks, optimizers and one update of SAC with a state-wise cost constraint.

    Args:
        width: units of each hidden layer.
        rows: M, the number of vehicle rows.
        gamma: discount of reward and cost.
        tau: step of the soft target update.
        risk_limit: d, the bound on the cost critics' value.
        compile: compile the losses of the critics and of the actor, which is faster than to compile
            ``update``: that breaks at every ``zero_grad``, ``backward`` and fused ``step``.
        tuned: freeze the critics in the actor's step and learn the temperature from its sample.
            CleanRL's SAC computes the critics' gradients there, to throw them away, and draws again.
    """

    def __init__(
        self,
        width: int = 256,
        rows: int = 11,
        gamma: float = 0.99,
        tau: float = 0.005,
        risk_limit: float = 0.05,
        compile: bool = False,
        tuned: bool = False,
    ):
        self.tuned = tuned
        self.gamma, self.tau, self.risk_limit = gamma, tau, risk_limit
        self.scale = torch.tensor(EGO_SCALE + rows * VEHICLE_SCALE)

        self.actor = Actor(width, rows)
        self.qf1, self.qf2 = Critic(width, rows), Critic(width, rows)
        self.cf1, self.cf2 = Critic(width, rows), Critic(width, rows)
        self.critics = nn.ModuleList([self.qf1, self.qf2, self.cf1, self.cf2])
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        self.qf1_target, self.qf2_target, self.cf1_target, self.cf2_target = self.targets
        self.critic_params = list(self.critics.parameters())
        self.target_params = list(self.targets.parameters())

        self.target_entropy = -float(ACTION_DIM)
        self.log_alpha = torch.zeros(1, requires_grad=True)
        self.multiplier = torch.ones(1)

        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=ACTOR_LR, fused=True)
        self.critic_optimizer = torch.optim.Adam(self.critic_params, lr=CRITIC_LR, fused=True)
        self.alpha_optimizer = torch.optim.Adam([self.log_alpha], lr=ALPHA_LR, fused=True)

        if compile:
            mode = "reduce-overhead" if self.scale.device.type == "cuda" else None  # as ours
            self.critic_loss = torch.compile(self.critic_loss, mode=mode)
            self.actor_loss = torch.compile(self.actor_loss, mode=mode)

    def flatten(self, ego: Tensor, vehicles: Tensor) -> Tensor:
        """The scene in one vector of scaled features, [B, 9 + 6 rows]."""
        return torch.cat([ego, vehicles.flatten(1)], dim=1) / self.scale

    def critic_loss(
        self, batch: dict[str, Tensor], obs: Tensor, alpha: Tensor, noise: Tensor
    ) -> tuple[Tensor, Tensor]:
        """E12 and E13, which share the next action."""
        with torch.no_grad():
            next_obs = self.flatten(batch["next_ego"], batch["next_vehicles"])
            next_action, next_log_prob = self.actor.sample(next_obs, noise)
            next_q = torch.min(
                self.qf1_target(next_obs, next_action), self.qf2_target(next_obs, next_action)
            )
            next_c = 0.5 * (
                self.cf1_target(next_obs, next_action) + self.cf2_target(next_obs, next_action)
            )
            discount = self.gamma * ~batch["terminated"]
            target_q = batch["reward"] + discount * (next_q - alpha * next_log_prob)
            target_c = batch["cost"] + discount * next_c

        action = batch["action"]
        loss_q = F.mse_loss(self.qf1(obs, action), target_q)
        loss_q = loss_q + F.mse_loss(self.qf2(obs, action), target_q)
        loss_c = F.mse_loss(self.cf1(obs, action), target_c)
        loss_c = loss_c + F.mse_loss(self.cf2(obs, action), target_c)
        return 0.5 * loss_q, 0.5 * loss_c

    def actor_loss(
        self, obs: Tensor, alpha: Tensor, multiplier: Tensor, noise: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """E11, with the log-probability [B, 1] and the mean violation that it found."""
        action, log_prob = self.actor.sample(obs, noise)
        q = torch.min(self.qf1(obs, action), self.qf2(obs, action))
        c = torch.max(self.cf1(obs, action), self.cf2(obs, action))
        violation = F.relu(c - self.risk_limit)
        loss = (alpha * log_prob - q + multiplier * violation).mean()
        return loss, log_prob.detach(), violation.detach().mean()

    def update(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """One step of everything that learns; returns the losses and what they were weighed with.

        Args:
            batch: ``ego`` [B, 9], ``vehicles`` [B, M, 6] and ``action`` [B, 2]; ``next_ego``,
                ``next_vehicles``; ``reward``, ``cost`` and ``terminated`` (bool) [B, 1].
        """
        # Drawn here, so that compiled losses see the same noise.
        noise, next_noise = torch.randn_like(batch["action"]), torch.randn_like(batch["action"])
        obs = self.flatten(batch["ego"], batch["vehicles"])
        alpha = self.log_alpha.detach().exp()

        loss_q, loss_c = self.critic_loss(batch, obs, alpha, next_noise)
        self.critic_optimizer.zero_grad()
        (loss_q + loss_c).backward()
        self.critic_optimizer.step()

        self.critics.requires_grad_(not self.tuned)
        loss_actor, log_prob, violation = self.actor_loss(obs, alpha, self.multiplier, noise)
        self.actor_optimizer.zero_grad()
        loss_actor.backward()
        self.actor_optimizer.step()
        self.critics.requires_grad_(True)

        if not self.tuned:
            with torch.no_grad():
                _, log_prob = self.actor.sample(obs, torch.randn_like(noise))
        loss_alpha = -(self.log_alpha.exp() * (log_prob + self.target_entropy)).mean()
        self.alpha_optimizer.zero_grad()
        loss_alpha.backward()
        self.alpha_optimizer.step()

        output = {
            "loss_qvalue": loss_q.detach(),
            "loss_cost": loss_c.detach(),
            "loss_actor": loss_actor.detach(),
            "loss_alpha": loss_alpha.detach(),
            "constraint_violation": violation,
            "alpha": alpha,
            "lagrange_multiplier": self.multiplier.clone(),
        }
        with torch.no_grad():
            self.multiplier.add_(MULTIPLIER_LR * violation).clamp_(min=0.0)
            torch._foreach_lerp_(self.target_params, self.critic_params, self.tau)
        return output
