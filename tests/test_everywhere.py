"""Each public part as a copy, in other processes, and with other numbers."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
import torch
from small import EMPTY, SMALL, compose
from tensordict import TensorDict
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import ParallelEnv, SerialEnv
from torchrl.envs.utils import check_env_specs

from saferl.algorithms.assemble import build_agent, build_trainer
from saferl.envs import Cart, CartEnv, GymEnvs, GymTask
from saferl.envs.intersection import (
    BatchedIntersection,
    HighwayIntersection,
    IntersectionEnv,
    Scenario,
)
from saferl.modules import CVaR, DualAscent, LagrangeMultiplier, Largest, MeanStd, PIDMultiplier

ENVS = {
    "batched": partial(BatchedIntersection, Scenario(task="gs"), num_envs=2),
    "highway": partial(HighwayIntersection, Scenario(task="gs"), num_envs=1),
    "cart": partial(CartEnv, Cart(), num_envs=2),
    "gym": partial(GymEnvs, GymTask("Pendulum-v1", cost_key=None), num_envs=2),
}
COPIES = {"deepcopy": copy.deepcopy, "pickle": lambda part: pickle.loads(pickle.dumps(part))}
#: With a projector on the critics, with action values alone, and on-policy.
ALGOS = ("arsac", "sac_lag", "arppo", "cpo")


@pytest.fixture(params=["float32", "float64"])
def numbers(request: pytest.FixtureRequest) -> Iterator[torch.dtype]:
    """Torch's default."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(getattr(torch, request.param))
    yield torch.get_default_dtype()
    torch.set_default_dtype(before)


@pytest.mark.parametrize("name", ENVS)
def test_environments_have_the_default_numbers(name: str, numbers: torch.dtype):
    env = ENVS[name](seed=0)
    check_env_specs(env)
    played = env.rollout(3)
    for key in (*env.observation_keys, ("next", "reward"), ("next", "cost")):
        value = played[key]
        assert not value.is_floating_point() or value.dtype == numbers, key


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("name", ENVS)
def test_a_copy_of_an_environment_goes_on_by_itself(name: str, how: str):
    """From the middle of an episode, as the original does; neither moves the other."""
    env = ENVS[name](seed=0)
    last = env.rollout(3, break_when_any_done=False)[:, -1]["next"]
    other = COPIES[how](env)
    steps = TensorDict({"action": torch.full(env.action_spec.shape, 0.3)}, env.batch_size)
    for _ in range(3):
        ours, theirs = (each.step(last.clone().update(steps))["next"] for each in (env, other))
        assert all((ours[key] == theirs[key]).all() for key in ours.keys())  # noqa: SIM118


@pytest.mark.parametrize("how", COPIES)
def test_a_drawn_scene_can_be_copied(how: str):
    env = IntersectionEnv(task="gs", render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    other = COPIES[how](env)
    assert (other.render() == picture).all()
    other.step(other.action_space.sample())
    assert (env.render() == picture).all() and not (other.render() == picture).all()


@pytest.mark.parametrize("name", ENVS)
def test_environments_side_by_side(name: str):
    env = SerialEnv(2, ENVS[name])
    assert env.rollout(2).shape == (2, *ENVS[name]().batch_size, 2)
    env.close()


@pytest.mark.parametrize("name", ["batched", "gym"])
def test_environments_in_processes(name: str):
    env = ParallelEnv(2, ENVS[name], mp_start_method="spawn")
    start = env.reset()
    floats = [v for v in start.values(True, True) if v.is_floating_point()]
    assert not torch.equal(floats[0][0], floats[0][1])  # not the same episodes
    env.close()


def test_a_policy_collects_in_processes():
    actor = build_agent(compose(*SMALL, *EMPTY, "algo=sac")).actor
    collector = MultiSyncCollector([ENVS["batched"]] * 2, actor, frames_per_batch=8, total_frames=8)
    (data,) = collector
    assert data.numel() == 8 and data["action"].isfinite().all()
    collector.shutdown()


@pytest.mark.parametrize("algo", ALGOS)
def test_agents_train_with_the_default_numbers(algo: str, numbers: torch.dtype, tmp_path: Path):
    trainer = build_trainer(compose(*SMALL, *EMPTY, f"algo={algo}"), tmp_path)
    trainer.train()
    networks = [v for k, v in trainer.learner.loss.named_parameters() if "network" in k]
    assert {parameter.dtype for parameter in networks} == {numbers}


@pytest.mark.parametrize("algo", ALGOS)
def test_a_copy_of_an_agent_is_its_own(algo: str):
    """The loss, its policy and what the projector acts by; TorchRL's own SAC loss cannot be pickled."""
    agent = build_agent(compose(*SMALL, *EMPTY, f"algo={algo}"))
    actor, loss = copy.deepcopy(agent.actor), copy.deepcopy(agent.loss)
    pickled = pickle.loads(pickle.dumps(agent.actor))
    parameter = next(agent.loss.actor_network_params.values(True, True))
    kept = [next(part.parameters()).clone() for part in (actor, pickled)]
    before = next(loss.actor_network_params.values(True, True)).clone()
    parameter.data.add_(1.0)
    assert torch.equal(next(loss.actor_network_params.values(True, True)), before)
    for part, value in zip((actor, pickled), kept, strict=True):
        assert torch.equal(next(part.parameters()), value)
    loss.to("cpu").load_state_dict(agent.loss.state_dict())
    assert torch.equal(next(loss.actor_network_params.values(True, True)), parameter)


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize(
    "part",
    [
        LagrangeMultiplier(2.0), DualAscent(2.0, lr=0.1), PIDMultiplier(init=2.0), Largest(), MeanStd(), CVaR(),
    ],
    ids=lambda part: type(part).__name__,
)  # fmt: skip
def test_small_parts_can_be_copied(part, how: str):
    other = COPIES[how](part)
    if isinstance(part, LagrangeMultiplier):
        other.update(torch.tensor(1.0))
        assert float(part.value) == 2.0
    else:
        values = torch.rand(4, 3, 1)
        assert torch.equal(other(values), part(values))
