"""Gymnasium environments with a cost, as others write them."""

from __future__ import annotations

import gymnasium
import numpy as np
import torch


class Walk(gymnasium.Env):
    """A walk on a line; reuses its observation array, as some do, and needs no checker."""

    observation_space = gymnasium.spaces.Dict(
        place=gymnasium.spaces.Box(-np.inf, np.inf, (1,)), time=gymnasium.spaces.Box(0, 99, (1,))
    )
    action_space = gymnasium.spaces.Box(-2.0, 4.0, (1,), np.float32)
    values, far = 5, 50.0
    priced = staticmethod(np.float64)

    def __init__(self, cost: str = "cost"):
        self.cost, self.place, self.time = cost, np.zeros(1, np.float32), 0

    def _observe(self):
        return {"place": self.place, "time": np.array([self.time], np.float32)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place[:], self.time = self.np_random.normal(), 0
        return self._observe(), {}

    def step(self, action):
        self.place += action
        self.time += 1
        ended = bool(self.place[0] > self.far)
        speed = float(abs(action[0]))
        values = [
            self._observe(),
            float(self.place[0]),
            ended,
            False,
            {self.cost: self.priced(speed)},
        ]
        if self.values == 6:
            values.insert(2, 2 * speed)
        return tuple(values)


class SixValues(Walk):
    values = 6


class Whole(Walk):
    action_space = gymnasium.spaces.Box(-2, 2, (1,), np.int32)


gymnasium.register("test/Whole-v0", Whole, max_episode_steps=5)
gymnasium.register("test/SixLimited-v0", SixValues, max_episode_steps=3)
gymnasium.register("test/Walk-v0", Walk, max_episode_steps=5)
gymnasium.register("test/Six-v0", SixValues)


def constant(value: float):
    return lambda td: td.set("action", torch.full((*td.batch_size, 1), value))
