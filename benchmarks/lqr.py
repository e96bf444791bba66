"""Constrained linear-quadratic problems as gymnasium environments, with their optima."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from scipy.optimize import brentq

HORIZON = 50


class LQR(gymnasium.Env):
    """x' = A x + B u + w, reward -(x Q x + u R u), cost x M x + u N u, for 50 steps.

    Args:
        A, B, Q, R, M, N: matrices.
        spread: starts are normal with this standard deviation.
        noise: w likewise.
    """

    def __init__(self, A, B, Q, R, M, N, spread: float = 1.0, noise: float = 0.1):
        self.A, self.B, self.Q, self.R, self.M, self.N = (
            np.asarray(matrix, float) for matrix in (A, B, Q, R, M, N)
        )
        self.spread, self.noise = spread, noise
        states, actions = self.B.shape
        self.observation_space = Box(-np.inf, np.inf, (states,))
        self.action_space = Box(-1.0, 1.0, (actions,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.spread * self.np_random.normal(size=len(self.A))
        return self.x.astype(np.float32), {}

    def step(self, action):
        x, u = self.x, np.asarray(action, float)
        reward = -(x @ self.Q @ x + u @ self.R @ u)
        cost = x @ self.M @ x + u @ self.N @ u
        self.x = self.A @ x + self.B @ u + self.noise * self.np_random.normal(size=len(x))
        return self.x.astype(np.float32), reward, False, False, {"cost": cost}

    def gains(self, multiplier: float) -> list[np.ndarray]:
        """What is best for reward - multiplier * cost, u = -K_t x (backward Riccati recursion)."""
        state, effort = self.Q + multiplier * self.M, self.R + multiplier * self.N
        ahead, gains = np.zeros_like(state), []
        for _ in range(HORIZON):
            gain = np.linalg.solve(effort + self.B.T @ ahead @ self.B, self.B.T @ ahead @ self.A)
            closed = self.A - self.B @ gain
            ahead = state + gain.T @ effort @ gain + closed.T @ ahead @ closed
            gains.append(gain)
        return gains[::-1]

    def sums(self, gains: list[np.ndarray]) -> tuple[float, float]:
        """Expected reward and cost of an episode under u = -K_t x, as if forces had no bounds."""
        moment = self.spread**2 * np.eye(len(self.A))
        reward = cost = 0.0
        for gain in gains:
            reward -= np.trace((self.Q + gain.T @ self.R @ gain) @ moment)
            cost += np.trace((self.M + gain.T @ self.N @ gain) @ moment)
            closed = self.A - self.B @ gain
            moment = closed @ moment @ closed.T + self.noise**2 * np.eye(len(self.A))
        return float(reward), float(cost)

    def played(self, gains: list[np.ndarray], episodes: int = 20_000) -> tuple[float, float]:
        """The means of so many episodes, the same each time, with forces cut off at 1."""
        draw, size = np.random.default_rng(0), (episodes, len(self.A))
        x, reward, cost = self.spread * draw.normal(size=size), 0.0, 0.0
        for gain in gains:
            u = np.clip(-x @ gain.T, -1.0, 1.0)
            reward -= ((x @ self.Q) * x).sum(1).mean() + ((u @ self.R) * u).sum(1).mean()
            cost += ((x @ self.M) * x).sum(1).mean() + ((u @ self.N) * u).sum(1).mean()
            x = x @ self.A.T + u @ self.B.T + self.noise * draw.normal(size=size)
        return float(reward), float(cost)

    def optimum(self, limit: float) -> tuple[float, float]:
        """The return of an episode whose expected cost is ``limit``, and its multiplier.

        Of the policies that are best without bounds (Riccati) and cut off at them, which is best of all where bounds do not bind.
        """

        def excess(log: float) -> float:
            return self.played(self.gains(math.exp(log)))[1] - limit

        multiplier = math.exp(brentq(excess, -12.0, 12.0, xtol=1e-3))  # pyright: ignore[reportArgumentType]
        return self.played(self.gains(multiplier))[0], multiplier


#: A state of one and of two dimensions; a budget of effort, and one of distance.
EFFORT = dict(A=[[1.0]], B=[[0.5]], Q=[[1.0]], R=[[0.01]], M=[[0.0]], N=[[4.0]], noise=0.2)
DISTANCE = dict(
    A=[[0.95, 0.2], [0.0, 0.9]], B=[[0.0], [0.3]], Q=[[0.1, 0.0], [0.0, 0.05]], R=[[2.0]],
    M=[[1.0, 0.0], [0.0, 0.0]], N=[[0.0]], spread=0.5, noise=0.1,
)  # fmt: skip


@dataclass(frozen=True)
class Problem:
    """A constrained problem: its matrices, and the limit on an episode's cost."""

    matrices: dict[str, Any]
    limit: float

    @property
    def best(self) -> float:
        """The best return under the limit."""
        return LQR(**self.matrices).optimum(self.limit)[0]


PROBLEMS = {"Effort": Problem(EFFORT, 20.0), "Distance": Problem(DISTANCE, 6.0)}
for name, problem in PROBLEMS.items():
    gymnasium.register(f"{name}-v0", LQR, max_episode_steps=HORIZON, kwargs=problem.matrices)
