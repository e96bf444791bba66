"""The reward, term by term, against Er_1 and Er_2 by hand."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from saferl.envs.intersection import BatchedIntersection, IntersectionEnv, Scenario
from saferl.envs.intersection.geometry import ROUTES, line_pose, reference_lines
from saferl.envs.intersection.reward import Reward

NORTH = -math.pi / 2
Q = np.array([400.0, 400.0, 20.0, 20.0, 2.0, 0.5])
UNITS = {"raw": np.ones(6), "normalised": np.array([100.0, 100.0, 20.0, 20.0, 1.0, 1.0])}
CHOICE = {"raw": max, "normalised": min}


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def call(reward, state, route="gs_inner", control=(0.0, 0.0), previous=None, d_veh=70.0,
         d_des=0.0, observed=False, collided=False, success=False, terms=False):  # fmt: skip
    function = reward.terms if terms else reward
    return function(
        torch.as_tensor(np.array(state), dtype=torch.float64),
        torch.tensor(ROUTES.index(route)),
        tensor(*control),
        tensor(*(control if previous is None else previous)),
        torch.tensor(d_veh, dtype=torch.float64),
        torch.tensor(d_des, dtype=torch.float64),
        torch.tensor(observed),
        torch.tensor(collided),
        torch.tensor(success),
    )


def r_ref(reading, *errors):
    """Weighted square of the error to each line, and the reading's choice among the lines."""
    return CHOICE[reading](float((Q * (np.array(e) / UNITS[reading]) ** 2).sum()) for e in errors)


@pytest.mark.parametrize("reading", UNITS)
@pytest.mark.parametrize(
    ("state", "route", "errors"),
    [
        # On the approach both lines are one.
        ((2.0, 60.0, 9.0, 0.0, NORTH, 0.0), "gs_inner", [(0, 0, 0, 0, 0, 0)] * 2),
        ((2.5, 60.0, 7.0, 0.3, NORTH + 0.2, -0.4), "lt", [(0.5, 0, -2, 0.3, 0.2, -0.4)] * 2),
        # On the exits they are 4 m apart: own lane first, the other one second.
        ((3.0, -30.0, 8.0, 0.1, NORTH, 0.0), "gs_inner",
         [(1, 0, -1, 0.1, 0, 0), (-3, 0, -1, 0.1, 0, 0)]),
        ((3.0, -30.0, 8.0, 0.1, NORTH, 0.0), "gs_outer",
         [(-3, 0, -1, 0.1, 0, 0), (1, 0, -1, 0.1, 0, 0)]),
        ((-30.0, -1.0, 9.0, 0.0, math.pi - 0.1, 0.2), "lt",
         [(0, 1, 0, 0, -0.1, 0.2), (0, 5, 0, 0, -0.1, 0.2)]),
        ((30.0, 2.0, 9.0, 0.0, 0.1, 0.2), "rt", [(0, -4, 0, 0, 0.1, 0.2), (0, 0, 0, 0, 0.1, 0.2)]),
        # Headings differ by what is left after whole turns.
        ((2.0, 60.0, 9.0, 0.0, NORTH + 2 * math.pi + 0.3, 0.0), "lt", [(0, 0, 0, 0, 0.3, 0)] * 2),
    ],
)  # fmt: skip
def test_reference_term_by_hand(reading, state, route, errors):
    reward = Reward(reading=reading)
    expected = r_ref(reading, *errors)
    ours = reward.reference(tensor(*state), torch.tensor(ROUTES.index(route)))
    assert ours.item() == pytest.approx(expected, abs=1e-9)
    terms = call(reward, state, route, terms=True)
    assert terms["reference"].item() == pytest.approx(2.0 / (1.0 + expected), abs=1e-9)


@pytest.mark.parametrize("reading", UNITS)
def test_reference_term_in_the_bends_by_sampled_lines(reading):
    rng = np.random.default_rng(1)
    reward = Reward(reading=reading)
    s = torch.arange(85.0, 155.0, 0.002, dtype=torch.float64)
    for route in range(4):
        lines = reference_lines(torch.tensor(route), s)
        poses = [line_pose(lines[k].expand(len(s), 4, 6), s).numpy() for k in range(2)]
        for _ in range(10):
            state = rng.uniform([-2, -2, 4, -1, -0.5, -0.5], [2, 2, 12, 1, 0.5, 0.5])
            state[[0, 1, 4]] += poses[0][rng.integers(2000, len(s) - 2000)]
            errors = []
            for pose in poses:
                near = pose[np.hypot(*(pose[:, :2] - state[:2]).T).argmin()]
                errors.append(state - [near[0], near[1], 9.0, 0.0, near[2], 0.0])
            ours = reward.reference(tensor(*state), torch.tensor(route)).item()
            # The samples are 2 mm apart.
            assert ours == pytest.approx(r_ref(reading, *errors), rel=2e-3)


@pytest.mark.parametrize(
    ("control", "previous", "expected"),
    [
        ((0.0, 0.0), (0.0, 0.0), 0.0),
        ((2.0, 0.5), (2.0, 0.5), -(0.05 * 4 + 0.02 * 0.25)),
        ((0.0, 0.0), (3.0, -0.4), -(0.10 * 3 + 0.10 * 0.4)),
        ((-5.0, 0.6), (5.0, -0.6), -(0.05 * 25 + 0.02 * 0.36) - (0.10 * 10 + 0.10 * 1.2)),
        ((5.0, -0.6), (-5.0, 0.6), -(0.05 * 25 + 0.02 * 0.36) - (0.10 * 10 + 0.10 * 1.2)),
    ],
)
def test_action_term_by_hand(control, previous, expected):
    state = (2.0, 60.0, 9.0, 0.0, NORTH, 0.0)
    terms = call(Reward(), state, control=control, previous=previous, terms=True)
    assert terms["action"].item() == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(("scale", "d_des"), [(100.0, 0.0), (100.0, 74.0), (150.0, 105.0)])
def test_destination_term_by_hand(scale, d_des):
    state = (2.0, 60.0, 9.0, 0.0, NORTH, 0.0)
    terms = call(Reward(destination_scale=scale), state, d_des=d_des, terms=True)
    assert terms["destination"].item() == pytest.approx(-((d_des / scale) ** 2), abs=1e-12)


@pytest.mark.parametrize(
    ("d_veh", "observed", "expected"),
    [
        (0.51, True, 0.0),
        (0.5, True, -0.5),
        (0.3, True, -0.7),
        (0.201, True, -0.799),
        (0.2, True, -2.4),
        (0.0, True, -3.0),
        (-1.0, True, -6.0),
        (70.0, True, 0.0),
        (0.1, False, 0.0),
    ],
)
def test_safety_term_by_hand(d_veh, observed, expected):
    state = (2.0, 60.0, 9.0, 0.0, NORTH, 0.0)
    shaped = Reward(risk_shaping=True)
    terms = call(shaped, state, d_veh=d_veh, observed=observed, terms=True)
    assert terms["safety"].item() == pytest.approx(expected, abs=1e-12)
    plain = call(Reward(), state, d_veh=d_veh, observed=observed)
    total = call(shaped, state, d_veh=d_veh, observed=observed)
    assert (total - plain).item() == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    ("collided", "success", "expected"),
    [(False, False, 0.0), (True, False, -50.0), (False, True, 100.0)],
)
def test_sparse_terms(collided, success, expected):
    state = (2.0, 60.0, 9.0, 0.0, NORTH, 0.0)
    # On the line at 9 m/s, at rest in the action, 0 m to go: 2 / (1 + 0).
    total = call(Reward(), state, collided=collided, success=success)
    assert total.item() == pytest.approx(2.0 + expected)


@pytest.mark.parametrize("reading", UNITS)
def test_reward_is_the_sum_of_its_terms(reading):
    state = (3.0, -30.0, 8.0, 0.1, NORTH, 0.2)
    reward = Reward(reading=reading, risk_shaping=True, destination_scale=100.0)
    ours = call(reward, state, "gs_inner", (2.0, 0.1), (1.0, -0.1), d_veh=0.4, d_des=11.0,
                observed=True, collided=True)  # fmt: skip
    reference = r_ref(reading, (1, 0, -1, 0.1, 0, 0.2), (-3, 0, -1, 0.1, 0, 0.2))
    expected = 2 / (1 + reference) - (0.05 * 4 + 0.02 * 0.01 + 0.1 + 0.02) - 0.0121 - 0.6 - 50
    assert ours.item() == pytest.approx(expected, abs=1e-9)


def test_settings_reach_the_formula():
    state = (3.0, 60.0, 7.0, 0.5, NORTH + 0.1, 0.2)
    reward = Reward(reading="raw", speed=6.0, weights=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
                    energy=(0.5, 0.25), smoothness=(1.0, 2.0), collision=-7.0, arrival=9.0)  # fmt: skip
    terms = call(reward, state, "lt", (1.0, -0.2), (0.0, 0.1), collided=True, success=True,
                 terms=True)  # fmt: skip
    reference = 1 + 3 + 4 * 0.25 + 5 * 0.01 + 6 * 0.04
    expected = {
        "reference": 2 / (1 + reference),
        "action": -(0.5 + 0.25 * 0.04) - (1.0 + 2 * 0.3),
        "destination": 0.0,
        "collision": -7.0,
        "arrival": 9.0,
    }
    assert {key: value.item() for key, value in terms.items()} == pytest.approx(expected)


@pytest.mark.parametrize("batch", [(), (2, 1)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("reading", UNITS)
def test_batches_give_what_singles_give(reading, batch, dtype):
    generator = torch.Generator().manual_seed(5)

    def draw(*shape):
        return torch.rand((*batch, *shape), generator=generator, dtype=dtype)

    reward = Reward(reading=reading, risk_shaping=True)
    arguments = [
        draw(6) * 10, torch.randint(0, 4, batch, generator=generator), draw(2), draw(2),
        draw(), draw() * 100, draw() > 0.3, draw() > 0.5, draw() > 0.5,
    ]  # fmt: skip
    total = reward(*arguments)
    assert total.shape == batch and total.dtype == dtype
    flat = [value.reshape(-1, *value.shape[len(batch):]) for value in arguments]  # fmt: skip
    for index, expected in enumerate(total.reshape(-1)):
        assert torch.allclose(reward(*[value[index] for value in flat]), expected)


def test_unknown_readings_and_scales_are_refused():
    with pytest.raises(ValueError, match="normalised, raw, got 'metric'"):
        Reward(reading="metric")
    with pytest.raises(ValueError, match="destination_scale must be > 0, got 0"):
        Reward(destination_scale=0.0)


# --- in the environments -------------------------------------------------------------------------

ONLY_SMOOTHNESS = Reward(energy=(0.0, 0.0), smoothness=(0.1, 0.1))
WITHOUT = dataclasses.replace(ONLY_SMOOTHNESS, smoothness=(0.0, 0.0))
ACTIONS = [(1.0, 0.1), (0.4, -0.1), (0.4, -0.1)]
#: |Delta a| in physical units: nothing at the first step, 3 m/s^2 and 0.12 rad, nothing again.
CHANGES = [0.0, -0.312, 0.0]


def rewards_of_batched(reward):
    env = BatchedIntersection(Scenario(task="gs", vehicles=0, reward=reward), num_envs=2, seed=1)
    tensordict = env.reset()
    out = []
    for episode in range(2):
        for action in ACTIONS:
            tensordict["action"] = torch.tensor(action).expand(2, 2)
            tensordict = env.step(tensordict)
            out.append(tensordict["next", "reward"][0].item())
            tensordict = tensordict["next"].exclude("reward", "cost")
        if not episode:
            tensordict = env.reset()
    return np.array(out)


def rewards_of_highway(reward):
    env = IntersectionEnv(task="gs", vehicles=0, reward=reward)
    out = []
    for seed in (1, 2):
        env.reset(seed=seed)
        out += [env.step(np.array(action, dtype=np.float32))[1] for action in ACTIONS]
    return np.array(out)


@pytest.mark.parametrize("rewards_of", [rewards_of_batched, rewards_of_highway])
def test_no_change_of_action_is_charged_at_the_first_step(rewards_of):
    charged = rewards_of(ONLY_SMOOTHNESS) - rewards_of(WITHOUT)
    np.testing.assert_allclose(charged, CHANGES * 2, atol=1e-5)
