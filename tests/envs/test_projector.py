"""SafetyProjector and ExecutedAction: what is executed is what is reported and stored."""

from __future__ import annotations

import functools

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.data import (
    Binary,
    Bounded,
    Composite,
    LazyTensorStorage,
    ReplayBuffer,
    TensorDictReplayBuffer,
    Unbounded,
)
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, Transform, TransformedEnv
from torchrl.envs.utils import RandomPolicy, check_env_specs

from saferl.envs.transforms import ExecutedAction, SafetyProjector
from saferl.envs.transforms import projector as transform
from saferl.modules import CriticEnsemble, MLPValue, MMAMValue, projection, value_operator

LIMIT = 0.2
REPORT = {
    "action_executed",
    "risk_before",
    "risk_after",
    "projection_steps",
    "intervened",
    "feasible",
}


class EchoEnv(EnvBase):
    """Writes the action it executed into `felt`; each episode takes `horizon` + its index steps."""

    def __init__(self, batch_size=(), horizon=3):
        super().__init__(batch_size=batch_size)
        batch = self.batch_size
        self.horizon = horizon + torch.arange(batch.numel()).reshape(*batch, 1)
        self.observation_spec = Composite(
            observation=Unbounded((*batch, 2)),
            felt=Unbounded((*batch, 2)),
            time=Unbounded((*batch, 1), dtype=torch.int64),
            shape=batch,
        )
        self.action_spec = Bounded(-1.0, 1.0, (*batch, 2))
        self.reward_spec = Unbounded((*batch, 1))
        self.done_spec = Composite(
            {
                key: Binary(1, (*batch, 1), dtype=torch.bool)
                for key in ("done", "terminated", "truncated")
            },
            shape=batch,
        )
        self.generator = torch.Generator().manual_seed(0)

    def _reset(self, tensordict=None, **kwargs):
        observation = torch.rand(*self.batch_size, 2, generator=self.generator)
        felt, time = torch.zeros_like(observation), torch.zeros(*self.batch_size, 1).long()
        return TensorDict(observation=observation, felt=felt, time=time, batch_size=self.batch_size)

    def _step(self, tensordict):
        action = tensordict["action"]
        time = tensordict["time"] + 1
        over = time >= self.horizon
        return TensorDict(
            observation=torch.rand(*self.batch_size, 2, generator=self.generator),
            felt=action.clone(),
            time=time,
            reward=action.sum(-1, keepdim=True),
            done=over,
            terminated=torch.zeros_like(over),
            truncated=over.clone(),
            batch_size=self.batch_size,
        )

    def _set_seed(self, seed):
        self.generator.manual_seed(seed)


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


def test_start_of_the_correction():
    env = TransformedEnv(EchoEnv((8,)), projector(start=0.5))
    for progress, acts in ((None, False), (0.49, False), (0.5, True), (1.0, True)):
        if progress is not None:
            env.transform.set_progress(progress)
        data = env.rollout(3)
        assert data["next", "intervened"].any() == acts
        assert (data["next", "risk_before"] > LIMIT).any()  # reported all the time
        check(data, feasible=acts)
    assert env.transform.state_dict()["enabled"]
    assert projector().enabled


@pytest.mark.parametrize("keep", ["last", "safest"])
def test_what_never_gets_feasible(keep):
    env = TransformedEnv(EchoEnv((8,)), projector(steps=2, keep=keep))
    data = env.rollout(3)
    check(data, feasible=False)
    assert (~data["next", "feasible"]).any()
    assert (data["next", "projection_steps"] <= 2).all()


def test_reads_the_live_critic():
    """An ensemble's change is felt at the next step; its parameters stay without gradient."""
    torch.manual_seed(0)
    critics = [
        value_operator(
            MLPValue(2, 8, ego_scale=[1.0] * 2, vehicle_scale=[1.0] * 2),
            in_keys=["ego", "vehicles", "action"],
            out_key="state_action_cost_value",
        )
        for _ in range(2)
    ]
    ensemble = CriticEnsemble(critics)
    view = CriticEnsemble(critics[0], ensemble.params)

    class Scene(Transform):
        """The toy observation under the names and shapes of the driving environment."""

        def _call(self, next_tensordict):
            observation = next_tensordict["observation"]
            rows = observation.unsqueeze(-2).expand(*observation.shape[:-1], 2, 2).clone()
            return next_tensordict.update({"ego": observation.clone(), "vehicles": rows})

        def _reset(self, tensordict, tensordict_reset):
            return self._call(tensordict_reset)

        def transform_observation_spec(self, observation_spec):
            batch = observation_spec.shape
            observation_spec["ego"] = Unbounded((*batch, 2))
            observation_spec["vehicles"] = Unbounded((*batch, 2, 2))
            return observation_spec

    env = TransformedEnv(EchoEnv((6,)), Scene())
    env.append_transform(SafetyProjector(view, limit=-1e9, penalty=1e3, keep="safest"))
    check_env_specs(env)
    assert not list(env.transform.parameters())
    for _ in range(2):
        data = env.rollout(2)
        expected = ensemble(data.copy())["state_action_cost_value"]
        torch.testing.assert_close(data["next", "risk_before"], expected)
        executed = data.copy().set("action", data["next", "action_executed"])
        after = ensemble(executed)["state_action_cost_value"]
        torch.testing.assert_close(data["next", "risk_after"], after)
        assert (after <= expected).all() and (after < expected).any()
        assert all(p.grad is None for p in ensemble.parameters())
        with torch.no_grad():
            for p in ensemble.parameters():
                p.add_(0.3 * torch.randn_like(p))


@pytest.mark.parametrize(
    "backend",
    # The capture alone takes seconds; generating code takes up to a minute.
    ["eager", pytest.param("inductor", marks=pytest.mark.slow)],
)
@pytest.mark.parametrize("batch", [1, 8, 40])
def test_compiled_in_parts(monkeypatch, request, backend, batch):
    """More states than one part holds, some of them safe, corrected as without compiling."""
    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend=backend))
    for once in (projection._compiled, transform._compiled_risk):
        once.cache_clear()
        request.addfinalizer(once.cache_clear)
    torch.manual_seed(0)
    ensemble = CriticEnsemble([value_operator(MMAMValue(16), out_key="risk") for _ in range(2)])
    states = TensorDict(
        ego=torch.randn(batch, 9), vehicles=torch.ones(batch, 3, 6), batch_size=batch
    )
    states["action"] = torch.rand(batch, 2) * 2 - 1
    limit = ensemble(states.copy())["risk"].mean().item() - (batch == 1)
    forms = [SafetyProjector(ensemble, limit, penalty=10.0, compile=c) for c in (False, True)]
    plain, compiled = (form._inv_call(states.copy())["_safety_projection"] for form in forms)
    changed = int(plain["intervened"].sum())
    assert changed == 1 if batch == 1 else batch / 4 < changed < batch
    for key, value in plain.items():
        torch.testing.assert_close(compiled[key], value, rtol=0, atol=1e-5)
    assert [len(form.latencies) for form in forms] == [1, 1]


def test_settings_are_checked_at_once():
    with pytest.raises(ValueError, match=r"fraction in \[0, 1\], got 1.5"):
        projector(start=1.5)
    with pytest.raises(ValueError, match="keep must be"):
        projector(keep="first")
