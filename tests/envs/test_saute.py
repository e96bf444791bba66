"""The budget as part of the state: by hand, around every kind of task, in training and in tests."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from small import EMPTY, SMALL, compose
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from saferl.algorithms.assemble import build_env, build_trainer
from saferl.algorithms.policy import trained_agent
from saferl.envs import Cart, CartEnv
from saferl.envs.transforms import Saute


def played(env: EnvBase, actions: list[float]) -> TensorDict:
    """Steps with these actions, the same in all environments."""
    left = iter(actions)

    def policy(td: TensorDict) -> TensorDict:
        return td.set("action", torch.full((*td.shape, 1), next(left)))

    return env.rollout(len(actions), policy, break_when_any_done=False)


def test_budget_and_reward_by_hand():
    """A cost of 0.16 of an allowed 0.4, then of 0.25, then one more: the last step is beyond the budget."""
    env = TransformedEnv(CartEnv(Cart(), 2, seed=0), Saute(0.4, penalty=7.0))
    plain = played(CartEnv(Cart(), 2, seed=0), [0.4, 0.5, 0.0, 0.4])
    steps = played(env, [0.4, 0.5, 0.0, 0.4])
    spent = torch.tensor([0.0, 0.16, 0.41, 0.41, 0.57])
    budget = torch.cat([steps["budget"][0], steps["next", "budget"][0, -1:]]).squeeze(-1)
    torch.testing.assert_close(budget, 1 - spent / 0.4)
    torch.testing.assert_close(
        steps["budgeted"], torch.cat([steps["observation"], steps["budget"]], -1)
    )
    torch.testing.assert_close(steps["next", "cost"], plain["next", "cost"])
    reward = steps["next", "reward"]
    torch.testing.assert_close(reward[:, 0], plain["next", "reward"][:, 0])
    assert (reward[:, 1:] == -7).all()


def test_the_limit_itself_may_be_spent():
    env = TransformedEnv(CartEnv(Cart(), 1, seed=0), Saute(0.25))
    steps = played(env, [0.5, 0.0])
    assert (steps["next", "budget"] == 0).all() and (steps["next", "reward"] != -1).all()


@pytest.mark.parametrize("steps", [3, 10, 25])
def test_it_may_be_spent_in_parts_that_floats_cannot_hold(steps: int):
    env = TransformedEnv(CartEnv(Cart(horizon=30), 1, seed=0), Saute(0.25 * steps, penalty=9.0))
    rewards = played(env, [0.5] * (steps + 1))["next", "reward"].flatten()
    assert (rewards[:steps] != -9).all() and rewards[steps] == -9


def test_an_environment_that_is_wrapped_again_hears_the_switch():
    saute = Saute(0.01, penalty=7.0)
    env = TransformedEnv(TransformedEnv(CartEnv(Cart(), 2, seed=0), saute), StepCounter())
    assert (played(env, [0.4])["next", "reward"] == -7).all()
    saute.enabled = False
    assert (played(env, [0.4])["next", "reward"] != -7).all()


def test_demonstrations_have_a_budget(tmp_path: Path):
    """Learned from as what is collected is: as states with what is left, and with the rewards that it learns from."""
    cfg = compose(
        *SMALL,
        "task=gs",
        "algo=sac",
        "transform=saute",
        "learning.demonstrations=300",
        "learning.buffer_size=400",
        "cost_limit=0.001",
    )
    shown = build_trainer(cfg, tmp_path).experience.demonstrate()
    budget, after = shown["budgeted"][:, -1:], shown["next", "budgeted"][:, -1:]
    torch.testing.assert_close(after, budget - shown["next", "cost"] / 0.001)
    assert (budget == 1).any() and ((after < -1e-5) == (shown["next", "reward"] == -5)).all()


def test_in_a_test_the_reward_is_what_was_earned():
    saute = Saute(0.01, penalty=7.0)
    saute.enabled = False
    env = TransformedEnv(CartEnv(Cart(), 2, seed=0), saute)
    plain = played(CartEnv(Cart(), 2, seed=0), [0.4, 0.5])
    torch.testing.assert_close(played(env, [0.4, 0.5])["next", "reward"], plain["next", "reward"])


def test_an_episode_begins_with_a_whole_budget_while_others_go_on():
    env = TransformedEnv(CartEnv(Cart(horizon=3), 2, seed=0), Saute(1.0))
    steps = played(env, [0.5] * 5)
    torch.testing.assert_close(
        steps["budget"][0].squeeze(-1), torch.tensor([1.0, 0.75, 0.5, 1.0, 0.75])
    )
    td = env.rollout(1, lambda td: td.set("action", torch.ones(2, 1)))[:, -1]["next"]
    one = env.reset(td.set("_reset", torch.tensor([[True], [False]])))
    assert one["budget"].flatten().tolist() == [1.0, 0.0]
    assert one["budgeted"][:, -1].tolist() == [1.0, 0.0]


class TwoCosts(EnvBase):
    """One environment whose costs are the action and its negative."""

    def __init__(self):
        super().__init__(batch_size=[])
        self.observation_spec = Composite(observation=Unbounded((3,)))
        self.action_spec = Unbounded((1,))
        self.reward_spec = Composite(reward=Unbounded((1,)), cost=Unbounded((2,)))

    def _reset(self, tensordict=None, **kwargs):
        return TensorDict({"observation": torch.zeros(3)})

    def _step(self, tensordict):
        cost = torch.cat([tensordict["action"], -tensordict["action"]])
        end = torch.zeros(1, dtype=torch.bool)
        found = {"reward": torch.ones(1), "cost": cost, "done": end, "terminated": end}
        return TensorDict({"observation": torch.zeros(3), **found})

    def _set_seed(self, seed):
        torch.manual_seed(0 if seed is None else seed)


def test_every_one_of_several_budgets_counts():
    env = TransformedEnv(TwoCosts(), Saute([2.0, 1.0], penalty=3.0))
    check_env_specs(env)
    steps = played(env, [2.0, -2.0, -2.0])
    torch.testing.assert_close(
        steps["next", "budget"], torch.tensor([[0.0, 3.0], [1.0, 1.0], [2.0, -1.0]])
    )
    assert steps["next", "reward"].flatten().tolist() == [1.0, 1.0, -3.0]
    with pytest.raises(
        ValueError, match="cost_limit must be 2 numbers, one for each cost .* got 1"
    ):
        TransformedEnv(TwoCosts(), Saute(1.0)).rollout(1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"cost_limit": 0.0},
            "cost_limit must be > 0, as costs are counted in shares of it, got 0",
        ),
        ({"cost_limit": 1.0, "penalty": -1.0}, "penalty must be >= 0, got -1"),
    ],
)
def test_refuses(settings, message: str):
    with pytest.raises(ValueError, match=message):
        Saute(**settings)


TASKS = {
    "road": (*EMPTY, "task=gs"),
    "cart": ("task=cart", "cost_limit=0.2"),
    "gym": ("task=gym", "task.id=Pendulum-v1", "task.cost_key=null", "cost_limit=1"),
}


@pytest.mark.parametrize("task", TASKS)
def test_policies_see_their_budget_on_every_kind_of_task(task: str, tmp_path: Path):
    """In training, in its test, and with an algorithm that keeps transitions, too."""
    algo = "sac" if task == "cart" else "ppo_saute"
    cfg = compose(*SMALL, *TASKS[task], f"algo={algo}", "transform=saute")
    trainer = build_trainer(cfg, tmp_path)
    trainer.train()
    agent = trained_agent(cfg, tmp_path)
    assert "budgeted" in agent.observed and not agent.transform.enabled
    env = build_env(cfg.env, trainer.collector.env.task, 2, 0, "cpu", agent.transforms)
    check_env_specs(env)
    with torch.no_grad():
        assert (env.rollout(2, agent.actor)["budget"][:, 0] == 1).all()


def test_a_run_goes_on_with_the_budget_that_is_left(tmp_path: Path):
    cfg = compose(*SMALL, *TASKS["cart"], "algo=ppo_saute")
    stopped, resumed = build_trainer(cfg, tmp_path), build_trainer(cfg, tmp_path)
    stopped.train()
    resumed.resume()
    left = [trainer.collector._carrier["budgeted"] for trainer in (stopped, resumed)]
    assert torch.equal(*left) and (left[0][:, -1] < 1).all()


def test_a_run_reports_what_was_earned(tmp_path: Path):
    """The penalty is the learner's; the episodes' returns are the task's."""
    cfg = compose(*SMALL, *TASKS["cart"], "algo=ppo_saute", "transform.penalty=1000", "frames=48")
    trainer = build_trainer(cfg, tmp_path)
    seen = []
    begin = trainer.experience.begin
    trainer.experience.begin = lambda data: (seen.append(data["next", "reward"].min()), begin(data))
    trainer.train()
    assert min(seen) == -100  # times learning.reward_scale
    assert trainer.window.values["return"].min() > -100
