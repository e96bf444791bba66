"""The batched environment: specs, seeds, partial resets, state."""

from __future__ import annotations

import pytest
import torch
from batch import (
    COAST,
    OBSERVATION,
    equal,
    make,
    noise,
    reset,
    reset_rows,
    step,
)
from torchrl.envs.utils import check_env_specs

from saferl.envs.intersection import BatchedIntersection, CollisionCost, Scenario
from saferl.envs.intersection.base import OUTCOMES
from saferl.envs.intersection.batched import vehicles_of
from saferl.envs.seeding import episode_seeds, mix, uniform

# --- specs ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("num_envs", [1, 64])
@pytest.mark.parametrize("task", ["lt", "gs", "rt", "mixed"])
def test_specs(task, num_envs):
    env = make(num_envs, task=task, observation="route")
    check_env_specs(env, seed=0)
    rewards = env.full_reward_spec
    assert set(rewards.keys()) == {"reward", "cost"}
    for key in ("reward", "cost"):
        assert rewards[key].shape == (num_envs, 1) and rewards[key].dtype == torch.float32
    assert set(env.observation_spec.keys()) == set(OBSERVATION)
    assert env.observation_spec["ego"].shape == (num_envs, 12)
    assert env.observation_spec["vehicles"].shape == (num_envs, 11, 12)
    assert env.action_spec.space.low.unique().item() == -1.0
    assert env.action_spec.space.high.unique().item() == 1.0
    fresh = env.reset()
    assert not any(fresh[key].any() for key in OUTCOMES)


def test_rows_are_a_setting():
    env = make(2, rows=4)
    check_env_specs(env, seed=0)
    assert env.reset()["vehicles"].shape == (2, 4, 6)


def test_the_observation_is_a_setting():
    env = make(2, observation="world")
    check_env_specs(env, seed=0)
    fresh = env.reset()
    assert fresh["ego"].shape == (2, 9) and fresh["vehicles"].shape == (2, 11, 6)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"task": "uturn"}, "task must be one of lt, gs, rt, mixed, got 'uturn'"),
        ({"vehicles": -1}, "vehicles must be >= 0, got -1"),
        ({"rows": 0}, "rows must be >= 1, got 0"),
        ({"observation": "map"}, "observation must be one of route, world, got 'map'"),
        ({"policy_frequency": 0}, "policy_frequency must be > 0, got 0"),
        ({"duration": 0.0}, r"duration must be at least a decision, 0.2 seconds, got 0.0"),
        ({"route_starts": 1.5}, r"route_starts must be in \[0, 1\], got 1.5"),
        ({"standstill": -2.0}, "standstill must be null or > 0 seconds, got -2.0"),
    ],
)
def test_bad_settings_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        Scenario(**settings)


def test_no_environment_is_refused():
    with pytest.raises(ValueError, match="num_envs must be >= 1, got 0"):
        make(0)


# --- seeds ---------------------------------------------------------------------------------------


def test_an_episode_is_a_function_of_its_seed_whatever_the_batch():
    seeds = episode_seeds(5, 7)
    actions = noise(30, 7)
    together = make(7, task="mixed", seed=1)
    views = [reset(together, seeds)] + [step(together, action) for action in actions]
    for k in (0, 3, 6):
        alone = make(1, task="mixed", seed=8)
        assert equal(reset(alone, seeds[k : k + 1, None]), views[0][k : k + 1])
        for action, view in zip(actions, views[1:], strict=True):
            single = step(alone, action[k : k + 1])
            for key in (*OBSERVATION, "reward", "cost", "done", "terminated", "truncated"):
                expected = view[key][k : k + 1]
                if expected.is_floating_point():
                    # Vectorised arithmetic may round the last bit by the size of the batch.
                    assert torch.allclose(single[key], expected, rtol=1e-5, atol=1e-4), key
                else:
                    assert torch.equal(single[key], expected), key
    assert len({tuple(row.tolist()) for row in views[0]["ego"]}) == 7


def test_set_seed_starts_the_same_sequence_of_episodes_again():
    env = make(3, task="mixed", seed=4)
    first = [reset(env)["ego"] for _ in range(4)]
    env.set_seed(4)
    again = [reset(env)["ego"] for _ in range(4)]
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    env.set_seed(5)
    assert not torch.equal(reset(env)["ego"], first[0])
    starts = torch.cat(first)[:, [2, 3]]  # y and v_x
    assert len(torch.unique(starts, dim=0)) == 12, "every environment and episode is another one"


def test_two_instances_share_no_generator_and_leave_the_global_one_alone():
    def episodes(env, neighbour=None):
        out = []
        for k in range(3):
            out.append(reset(env)["ego"])
            if neighbour is not None:
                reset(neighbour)
                step(neighbour, COAST)
                torch.rand(3, generator=torch.Generator().manual_seed(k))
            out.append(step(env, (0.3, 0.1))["ego"])
        return out

    state = torch.get_rng_state()
    alone = episodes(make(2, seed=3))
    beside = episodes(make(2, seed=3), make(2, seed=3))
    assert torch.equal(torch.get_rng_state(), state)
    assert all(torch.equal(a, b) for a, b in zip(alone, beside, strict=True))


def test_given_seeds_do_not_move_the_own_sequence():
    plain, guided = make(2, seed=3), make(2, seed=3)
    reset(guided, episode_seeds(0, 2))
    assert equal(reset(plain), reset(guided))


def test_hashed_numbers_are_uniform_and_independent():
    seeds = episode_seeds(0, 20000)
    assert len(seeds.unique()) > 19900 and seeds.min() >= 0 and seeds.max() < 2**31
    first, second = uniform(seeds, 0), uniform(seeds, 1)
    for numbers in (first, second, uniform(torch.arange(20000), 0)):
        assert numbers.min() >= 0 and numbers.max() < 1
        ordered = numbers.sort().values
        expected = (torch.arange(20000, dtype=torch.float64) + 0.5) / 20000
        assert (ordered - expected).abs().max() < 0.015  # Kolmogorov-Smirnov, p far below 1e-3
    assert torch.corrcoef(torch.stack([first, second]))[0, 1].abs() < 0.03
    assert torch.corrcoef(torch.stack([first[1:], first[:-1]]))[0, 1].abs() < 0.03


def test_mix_is_splitmix64():
    """The published first outputs of SplitMix64 seeded with 1234567."""
    ours = [mix(torch.tensor(1234567), stream).item() % 2**64 for stream in range(5)]
    assert ours == [
        6457827717110365317,
        3203168211198807973,
        9817491932198370423,
        4593380528125082431,
        16408922859458223821,
    ]


# --- partial resets ------------------------------------------------------------------------------


def test_a_partial_reset_touches_only_its_rows():
    env, twin = make(4, task="mixed", seed=6), make(4, task="mixed", seed=6)
    rows = torch.tensor([False, True, False, True])
    actions = noise(6, 4, seed=1) * 0.2
    reset(env), reset(twin)
    for action in actions[:3]:
        before = step(env, action)
        step(twin, action)
    after = reset_rows(env, before, rows)
    assert equal(after[~rows], before[~rows])
    assert (after["ego"][rows] != before["ego"][rows]).any(-1).all()
    fresh = make(4, task="mixed", seed=6)
    reset(fresh)
    second = reset(fresh)
    assert equal(after[rows], second[rows]), "the next episode of its own sequence"
    for action in actions[3:]:
        here, there = step(env, action), step(twin, action)
        assert equal(here[~rows], there[~rows])
        assert torch.equal(here["reward"][~rows], there["reward"][~rows])
    # The others' sequences of episodes have not moved either.
    assert equal(reset(env)[~rows], second[~rows])


def test_a_partial_reset_restarts_the_clock_and_the_last_action_of_its_rows():
    env = make(2, task="gs", duration=2.0, seed=6)
    reset(env)
    for _ in range(4):
        view = step(env, (0.5, 0.0))
    reset_rows(env, view, [True, False])
    ends = [step(env, COAST)["truncated"].squeeze(-1).tolist() for _ in range(10)]
    assert ends.index([False, True]) == 5  # its tenth decision
    assert ends[9][0] and not any(end[0] for end in ends[:9])


def test_rollout_resets_what_has_ended():
    env = make(8, task="mixed", seed=6, duration=3.0)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        data = env.rollout(40, break_when_any_done=False)
    done = data["next", "done"].squeeze(-1)
    assert done.sum() >= 16
    follows = torch.isclose(data["ego"][:, 1:], data["next", "ego"][:, :-1]).all(-1)
    assert torch.equal(follows, ~done[:, :-1])
    assert (data["ego"][:, 1:][done[:, :-1]][:, 2] >= 50.0).all()


# --- state ---------------------------------------------------------------------------------------


def test_state_dict_continues_exactly_across_resets():
    actions = noise(20, 3, seed=2) * 0.5
    env = make(3, task="mixed", seed=9, route_starts=0.5)
    reset(env)
    for action in actions[:7]:
        view = step(env, action)
    reset_rows(env, view, [True, False, False])
    stored = {key: value.clone() for key, value in env.state_dict().items()}

    def onwards(env):
        out = [step(env, action) for action in actions[7:12]]
        out.append(reset_rows(env, out[-1], [False, True, True]))
        out += [step(env, action) for action in actions[12:]]
        return [*out, reset(env)]

    expected = onwards(env)
    assert not torch.equal(env.state_dict()["ego"], stored["ego"])
    other = make(3, task="mixed", seed=77, route_starts=0.5)
    other.load_state_dict(stored)
    for here, there in zip(onwards(other), expected, strict=True):
        assert set(here.keys()) == set(there.keys())
        assert equal(here, there, there.keys())
    # What was loaded is not the caller's memory.
    other.load_state_dict(stored)
    onwards(other)
    again = make(3, task="mixed", seed=1, route_starts=0.5)
    again.load_state_dict(stored)
    assert equal(onwards(again)[-1], expected[-1])


def test_snapshot_is_the_state_of_one_environment():
    env = make(3, task="mixed")
    view = reset(env)
    ego, others = env.snapshot(1)
    assert ego.shape == (6,) and others.shape == (0, 6)
    assert torch.allclose(torch.tensor(ego).float(), view["ego"][1, 1:7])
    assert env.render(0).shape == (600, 600, 3)


@pytest.mark.parametrize("num_envs", [1, 5])
@pytest.mark.parametrize("scenario", ["nominal", "dense", "noisy"])
def test_the_state_is_always_laid_out_alike(scenario, num_envs):
    """Scenes side by side, after steps and resets: other strides would be compiled once more."""
    env, strides = BatchedIntersection(Scenario(scenario=scenario), num_envs, seed=0), set()
    view, resets = env.reset(), 0
    for action in noise(40, num_envs):
        step, view = env.step_and_maybe_reset(view.set("action", action))
        resets += int(step["next", "done"].sum())
        strides.add(tuple((key, value.stride()) for key, value in env._state.items()))
    assert resets and len(strides) == 1
    assert all(value.movedim(0, -1).is_contiguous() for value in env._state.values())


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "num_envs"), [("nominal", 1), ("dense", 4)])
@torch._dynamo.config.patch(error_on_recompile=True)
def test_compiled_is_eager(scenario, num_envs):
    """Steps and partial resets, with traffic, each compiled once; a compiler may order sums otherwise."""
    torch.compiler.reset()
    envs = [
        BatchedIntersection(Scenario(scenario=scenario), num_envs, seed=3, compile_physics=compiled)
        for compiled in (False, True)
    ]
    views = [env.reset() for env in envs]
    actions, resets = noise(40, num_envs), 0
    for action in actions:
        for view in views:
            view["action"] = action
        steps, views = zip(
            *(env.step_and_maybe_reset(view) for env, view in zip(envs, views, strict=True)),
            strict=True,
        )
        eager, compiled = (step["next"] for step in steps)
        for key in ("ego", "vehicles", "reward", "cost"):
            torch.testing.assert_close(compiled[key], eager[key], rtol=1e-4, atol=1e-3)
        assert equal(compiled, eager, ("done", "route", *OUTCOMES))
        resets += int(eager["done"].sum())
    assert resets


def test_respawning_keeps_the_number_that_was_drawn():
    """Vehicles that leave are replaced; an episode never has more than it was drawn with."""
    fixed = Scenario(task="lt", scenario="dense", traffic={"vehicles": (6, 6)})
    env = BatchedIntersection(fixed, 16, seed=0)
    numbers = []
    data = env.reset()
    for _ in range(60):
        data["action"] = torch.zeros(16, 2)
        _, data = env.step_and_maybe_reset(data)
        numbers.append(vehicles_of(env._state).present.sum(0))
    numbers = torch.stack(numbers)
    assert numbers.max() == 6 and numbers.float().mean() > 4.5


def test_an_action_of_another_precision_changes_no_type():
    env = BatchedIntersection(Scenario(task="gs"), 2, seed=0)
    data = env.reset().set("action", torch.zeros(2, 2, dtype=torch.float64))
    after = env.step(data)["next"]
    assert all(after[key].dtype == torch.float32 for key in ("ego", "vehicles", "reward", "cost"))


@pytest.mark.parametrize("crash", [0.0, 1.0])
def test_a_crash_costs_what_its_setting_says(crash):
    """Off the road at full lock, with nobody to be predicted to hit."""
    env = make(1, task="gs", cost=CollisionCost(crash=crash))
    view, costs = reset(env), []
    while not view["done"].any():
        view = step(env, (0.5, 1.0))
        costs.append(float(view["cost"]))
    assert view["offroad"].all() and costs[-1] == crash and not any(costs[:-1])
