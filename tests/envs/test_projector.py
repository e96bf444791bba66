"""SafetyProjector and ExecutedAction: what is executed is what is reported and stored."""

from __future__ import annotations

import functools

import pytest
import torch
from echo import EchoEnv
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.data import (
    Bounded,
    LazyTensorStorage,
    ReplayBuffer,
    TensorDictReplayBuffer,
)
from torchrl.envs import ParallelEnv, SerialEnv, StepCounter, Transform, TransformedEnv
from torchrl.envs.utils import RandomPolicy, check_env_specs

from saferl.envs.transforms import ExecutedAction, SafetyProjector

LIMIT = 0.2
REPORT = {
    "action_executed",
    "risk_before",
    "risk_after",
    "projection_steps",
    "intervened",
    "feasible",
}


def risk_of(observation, action):
    """Grows with the first coordinate, from a level that depends on the observation."""
    return action[..., :1] - 0.3 * observation[..., :1]


def projector(**options):
    risk = TensorDictModule(risk_of, ["observation", "action"], ["state_action_cost_value"])
    return SafetyProjector(risk, LIMIT, **{"penalty": 10.0, **options})


ENVS = {
    "single": lambda: EchoEnv(),
    "batched": lambda: EchoEnv((4,)),
    "grid": lambda: EchoEnv((2, 3)),
    "serial": lambda: SerialEnv(2, EchoEnv),
    "serial_batched": lambda: SerialEnv(2, functools.partial(EchoEnv, (3,))),
}


@pytest.fixture(params=ENVS)
def env(request):
    env = TransformedEnv(ENVS[request.param](), projector())
    env.set_seed(0)
    yield env
    env.close(raise_if_closed=False)


def check(data, feasible=True):
    """The truth is what the environment felt."""
    step, proposed = data["next"], data["action"]
    torch.testing.assert_close(step["action_executed"], step["felt"], rtol=0, atol=0)
    observation = data["observation"]
    before, after = (risk_of(observation, a) for a in (proposed, step["felt"]))
    torch.testing.assert_close(step["risk_before"], before)
    torch.testing.assert_close(step["risk_after"], after)
    risky = step["risk_before"] > LIMIT
    assert risky.any() and not risky.all()
    assert torch.equal(step["feasible"], step["risk_after"] <= LIMIT)
    if feasible:
        assert torch.equal(step["intervened"], risky) and step["feasible"].all()
    assert torch.equal(step["projection_steps"] > 0, step["intervened"])
    moved = (step["felt"] != proposed).any(-1, keepdim=True)
    assert torch.equal(moved, step["intervened"])


@torch.no_grad()
def test_specs(env):
    check_env_specs(env)
    assert set(env.observation_spec.keys()) >= REPORT


@torch.no_grad()
def test_rollout_executes_and_reports(env):
    data = env.rollout(12, break_when_any_done=False)
    check(data)
    # After a reset nothing has been executed yet; else the root repeats the step before.
    first = (data["time"] == 0).squeeze(-1)
    assert first.sum() > 1
    for key in REPORT:
        assert not data[key][first].any()
        past, now = data["next", key][..., :-1, :], data[key][..., 1:, :]
        same = ~first[..., 1:]
        assert torch.equal(past[same], now[same])


def collect(env, policy=None, **options):
    collector = Collector(
        env,
        policy or RandomPolicy(env.action_spec),
        frames_per_batch=24,
        total_frames=48,
        **options,
    )
    try:
        return [data.clone() for data in collector if data is not None]
    finally:
        collector.shutdown()


@pytest.mark.parametrize("init_random_frames", [0, 24])
def test_collector(env, init_random_frames):
    """Policy frames and random warm-up frames alike."""
    policy = TensorDictModule(lambda x: (2 * x - 0.5).clamp(-1, 1), ["observation"], ["action"])
    batches = collect(env, policy, init_random_frames=init_random_frames)
    check(torch.cat([batch.reshape(-1) for batch in batches]))
    expected = policy(batches[-1].copy())["action"]
    torch.testing.assert_close(batches[-1]["action"], expected)  # stays the proposed one


@pytest.mark.parametrize("make", [TensorDictReplayBuffer, ReplayBuffer])
def test_buffer_stores_the_executed_action(env, make):
    """By extend after collecting; what was collected keeps the policy's action."""
    buffer = make(storage=LazyTensorStorage(100), transform=ExecutedAction(), batch_size=100)
    for data in collect(env):
        flat = data.reshape(-1)
        kept = flat.clone()
        buffer.extend(flat)
        assert set(flat.keys()) == set(kept.keys())
        torch.testing.assert_close(flat["action"], kept["action"])
    stored = buffer[:]
    torch.testing.assert_close(stored["action"], stored["next", "felt"], rtol=0, atol=0)
    proposed = stored["action_proposed"]
    assert (proposed != stored["action"]).any()
    check(stored.set("action", proposed))
    sample = buffer.sample()
    torch.testing.assert_close(sample["action"], sample["next", "felt"], rtol=0, atol=0)


@pytest.mark.parametrize("init_random_frames", [0, 24])
def test_collector_that_fills_the_buffer_itself(env, init_random_frames):
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(100), transform=ExecutedAction(), batch_size=100
    )
    collect(env, replay_buffer=buffer, init_random_frames=init_random_frames)
    assert len(buffer) * buffer[:].shape[1:].numel() == 48
    stored = buffer[:].reshape(-1)
    torch.testing.assert_close(stored["action"], stored["next", "felt"], rtol=0, atol=0)
    check(stored.set("action", stored["action_proposed"]))


def test_workers_in_other_processes():
    env = TransformedEnv(ParallelEnv(2, EchoEnv, mp_start_method="fork"), projector())
    try:
        check_env_specs(env)
        check(env.rollout(12, break_when_any_done=False))
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), transform=ExecutedAction())
        buffer.extend(torch.cat([batch.reshape(-1) for batch in collect(env)]))
    finally:
        env.close(raise_if_closed=False)
    torch.testing.assert_close(buffer[:]["action"], buffer[:]["next", "felt"], rtol=0, atol=0)
    check(buffer[:].set("action", buffer[:]["action_proposed"]))


def test_adding_one_transition():
    env = TransformedEnv(EchoEnv(), projector())
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10), transform=ExecutedAction())
    for transition in env.rollout(3).unbind(0):
        buffer.add(transition)
    stored = buffer[:]
    torch.testing.assert_close(stored["action"], stored["next", "felt"], rtol=0, atol=0)
    # Stored data that goes through the transform again keeps the policy's action.
    again = ExecutedAction().inv(stored.clone())
    torch.testing.assert_close(again["action_proposed"], stored["action_proposed"])
    torch.testing.assert_close(again["action"], stored["action"])


def test_no_executed_action_names_the_key():
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10), transform=ExecutedAction())
    with pytest.raises(KeyError, match=r"action_executed.*felt.*Append a SafetyProjector"):
        buffer.extend(EchoEnv().rollout(3))


class _Physical(Transform):
    """The environment below works in other units."""

    def __init__(self):
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])

    def _inv_apply_transform(self, action):
        return 5 * action


def test_report_is_in_policy_units():
    env = TransformedEnv(TransformedEnv(EchoEnv((4,)), _Physical()), projector())
    data = env.rollout(3)
    torch.testing.assert_close(data["next", "felt"], 5 * data["next", "action_executed"])
    composed = TransformedEnv(EchoEnv((4,)), _Physical())
    composed.append_transform(projector())
    check_env_specs(composed)
    data = composed.rollout(3)
    torch.testing.assert_close(data["next", "felt"], 5 * data["next", "action_executed"])
    assert data["next", "intervened"].any()


@pytest.mark.parametrize(("low", "high"), [((-2.0, -2.0), (2.0, 2.0)), ((-1.5, 0.5), (3.0, 2.0))])
def test_the_box_is_the_environments(low, high):
    """Whatever its size, equal or not in each coordinate: nothing moves further than the steps go."""
    low, high = torch.tensor(low).expand(4, 2), torch.tensor(high).expand(4, 2)
    inner = EchoEnv((4,))
    inner.action_spec = Bounded(low=low, high=high, shape=(4, 2))
    env = TransformedEnv(inner, projector(steps=3, step_size=0.02))
    data = env.rollout(20)
    step = data["next"]
    moved = (step["action_executed"] - data["action"]).abs()
    assert step["intervened"].any() and moved.max() <= 0.06 + 1e-6
    assert (data["action"].abs() > 1).any()
    far = TransformedEnv(inner, projector(steps=300, step_size=0.02, penalty=1e4)).rollout(20)
    executed = far["next", "action_executed"]
    assert (executed >= low[:, None]).all() and (executed <= high[:, None]).all()
    check(far)


def test_start_of_the_correction():
    env = TransformedEnv(EchoEnv((8,)), projector(start=0.5))
    for progress, acts in ((None, False), (0.49, False), (0.5, True), (1.0, True)):
        if progress is not None:
            env.transform.set_progress(progress)
        data = env.rollout(3)
        assert data["next", "intervened"].any() == acts
        assert (data["next", "risk_before"] > LIMIT).any()  # reported all the time
        check(data, feasible=acts)
    resumed = projector(start=0.5)
    assert projector().enabled and not resumed.enabled
    resumed.load_state_dict(env.transform.state_dict())
    assert resumed.enabled


def test_an_environment_that_is_wrapped_again_hears_the_start():
    """TorchRL makes one of both wrappings, of clones."""
    own = projector(start=0.5)
    env = TransformedEnv(TransformedEnv(EchoEnv((8,)), own), StepCounter())
    assert not env.rollout(3)["next", "intervened"].any()
    own.set_progress(1.0)
    assert env.rollout(3)["next", "intervened"].any()


@pytest.mark.parametrize("keep", ["last", "safest"])
def test_what_never_gets_feasible(keep):
    env = TransformedEnv(EchoEnv((8,)), projector(steps=2, keep=keep))
    data = env.rollout(3)
    check(data, feasible=False)
    assert (~data["next", "feasible"]).any()
    assert (data["next", "projection_steps"] <= 2).all()


def test_settings_are_checked_at_once():
    with pytest.raises(ValueError, match=r"fraction in \[0, 1\], got 1.5"):
        projector(start=1.5)
    with pytest.raises(ValueError, match="keep must be"):
        projector(keep="first")
    blind = TensorDictModule(lambda felt: felt[..., :1], ["felt"], ["risk"])
    for risk in (None, blind):
        with pytest.raises(ValueError, match="risk must be a TensorDictModule that reads 'action'"):
            SafetyProjector(risk, 0.5)


@torch.no_grad()
@pytest.mark.parametrize("shape", [(4,), (2, 3)])
def test_several_risks_each_have_their_limit(shape):
    """Each coordinate of the action is a risk; corrected where either passes its limit, and told apart."""
    risk = TensorDictModule(lambda _, action: action[..., :2], ["observation", "action"], ["risk"])
    both = SafetyProjector(risk, [0.2, 0.6], penalty=10.0, steps=100)
    env = TransformedEnv(EchoEnv(shape), both)
    check_env_specs(env)
    env.set_seed(0)
    step = (data := env.rollout(12, break_when_any_done=False))["next"]
    limit = torch.tensor([0.2, 0.6])
    torch.testing.assert_close(step["risk_before"], data["action"][..., :2])
    torch.testing.assert_close(step["risk_after"], step["felt"][..., :2])
    risky = step["risk_before"] > limit
    assert (risky.any(-1) & ~risky.all(-1)).any() and not risky.any(-1).all()
    assert torch.equal(step["intervened"], risky.any(-1, keepdim=True)) and step["feasible"].all()
    assert both.limit == [0.2, 0.6]
