"""What other people's environments may show, cost and be asked for: the contract of task=gym as a matrix."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete, Tuple
from small import SMALL, compose

from saferl.algorithms.assemble import build_trainer
from saferl.cli.train import closing_test
from saferl.envs import GymEnvs, GymTask
from saferl.evaluation.play import evaluate

PIXELS = Box(0, 255, (4, 4, 3), np.uint8)
SPACES = {
    "box": Box(-np.inf, np.inf, (3,), np.float32),
    "float64": Box(-1.0, 1.0, (2, 2), np.float64),
    "integers": Box(0, 9, (3,), np.int64),
    "pixels": PIXELS,
    "dictionary": Dict({"place": Box(-1, 1, (2,)), "gear": Discrete(3)}),
    "nested": Dict({"outer": Dict({"inner": Box(-1, 1, (2,))}), "pair": Tuple([Box(0, 1, (1,))])}),
    "counts": MultiDiscrete([2, 3]),
}
COSTS: dict[str, tuple[Any, float | None]] = {
    "number": (0.5, 0.5),
    "whole": (1, 1.0),
    "truth": (True, 1.0),
    "negative": (-2.0, -2.0),
    "numpy": (np.float64(0.25), 0.25),
    "array": (np.array([0.75]), 0.75),
    "scalar array": (np.array(0.75), 0.75),
    "tensor": (torch.tensor(0.5), 0.5),
    "two": (np.array([1.0, 2.0]), None),
    "nan": (np.nan, None),
    "text": ("high", None),
    "missing": (None, None),
}


class Whatever(gymnasium.Env):
    """Shows samples of a space, costs what it is told, and remembers the seeds that it was reset with."""

    seeds: ClassVar[list[int]] = []
    action_space = Box(-2.0, 2.0, (2,))

    def __init__(self, space: str = "box", cost: str = "number"):
        self.observation_space, self.cost = SPACES[space], COSTS[cost][0]

    def _show(self):
        self.observation_space.seed(int(self.np_random.integers(2**31)))
        sample = self.observation_space.sample()
        finite = isinstance(self.observation_space, Box) and sample.dtype.kind == "f"
        return np.clip(sample, -5, 5) if finite else sample

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seeds.append(seed)
        return self._show(), {}

    def step(self, action):
        info = {} if self.cost is None else {"cost": self.cost}
        return self._show(), float(action[0]), False, False, info


gymnasium.register("contract/Any-v0", Whatever, max_episode_steps=5)


def task(**settings) -> GymTask:
    chosen = {key: settings.pop(key) for key in ("space", "cost") if key in settings}
    return GymTask("contract/Any-v0", kwargs=chosen, **settings)


@pytest.mark.parametrize("space", SPACES)
def test_any_observation_becomes_one_vector(space: str):
    env = GymEnvs(task(space=space), num_envs=2, seed=0)
    seen = env.rollout(4)["next", "observation"]
    assert seen.shape == (2, 4, gymnasium.spaces.flatdim(SPACES[space]))
    assert seen.dtype == torch.float32 and seen.isfinite().all() and seen.std() > 0
    if space == "pixels":
        assert seen.min() >= 0 and 0.5 < seen.max() <= 1


@pytest.mark.parametrize("cost", COSTS)
def test_a_cost_is_one_finite_number(cost: str):
    expected = COSTS[cost][1]
    if expected is None:
        with pytest.raises(ValueError, match=r"task\.(cost_key|id): .*cost"):
            GymEnvs(task(cost=cost), seed=0).rollout(2)
        return
    costs = GymEnvs(task(cost=cost), num_envs=2, seed=0).rollout(3)["next", "cost"]
    assert costs.shape == (2, 3, 1) and (costs == expected).all()


def test_training_takes_its_scenarios_and_tests_take_others():
    """What a row reports is the seed that the environment was reset with."""
    train = task(seeds=(10, 3))
    env = GymEnvs(train, num_envs=2, seed=0)
    Whatever.seeds.clear()
    env.rollout(40, break_when_any_done=False)
    assert set(Whatever.seeds) == {10, 11, 12}
    for tested, numbers in (
        (train, [13, 14, 15]),
        (task(seeds=(10, 3), test_seeds=(7, 2)), [7, 8]),
    ):
        test = tested.as_test()
        Whatever.seeds.clear()

        def tried(count: int, test: GymTask = test) -> list[dict]:
            still = lambda td: td.set("action", torch.zeros(1, 2))  # noqa: E731
            return evaluate(still, GymEnvs(test, 1, 0), count, seed=9)

        assert [row["seed"] for row in tried(len(numbers))] == numbers
        assert Whatever.seeds[-len(numbers) :] == numbers
        with pytest.raises(ValueError, match=f"episodes must be <= {len(numbers)}, the scenarios"):
            tried(4)
    with pytest.raises(ValueError, match=r"task.seeds must be \[first, count\].*got \[-1, 3\]"):
        task(seeds=(-1, 3))
    with pytest.raises(ValueError, match="task.test_seeds needs task.seeds"):
        task(test_seeds=(1, 3))


@pytest.mark.parametrize("algo", ["sac_lag", "cpo"])
@pytest.mark.parametrize("space", ["float64", "pixels", "dictionary"])
def test_each_kind_trains_and_is_tested(space: str, algo: str, tmp_path: Path):
    options = ("task=gym", "task.id=contract/Any-v0", f"+task.kwargs.space={space}", "cost_limit=1")
    cfg = compose(*SMALL, f"algo={algo}", *options, "task.seeds=[0,4]")
    trainer = build_trainer(cfg, tmp_path)
    trainer.train()
    trainer.close()
    assert cfg.task.task == "Any-v0"
    closing_test(cfg, tmp_path)
    assert (tmp_path / "evaluation/episodes.csv").read_text().splitlines()[1].startswith("0,4,")
