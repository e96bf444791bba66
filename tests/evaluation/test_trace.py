"""Traces of decisions, and what they say of crashes, against the simulator itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torchrl.envs import TransformedEnv

from saferl.envs.intersection import BatchedIntersection, HighwayIntersection, Scenario
from saferl.envs.intersection.drivers import Brake, CautiousDriver, Driver
from saferl.envs.intersection.dynamics import to_physical
from saferl.envs.intersection.geometry import overlap
from saferl.envs.intersection.true_scene import TrueScene
from saferl.envs.transforms import SafetyProjector
from saferl.evaluation.crashes import explain, table, way
from saferl.evaluation.play import evaluate, play
from saferl.evaluation.trace import TRACE, Trace, record
from saferl.modules import CriticEnsemble, MLPValue, MMAMPolicyEncoder, value_operator

SCENARIO = Scenario(task="mixed").as_test()
BACKENDS = {"batched": BatchedIntersection, "highway": HighwayIntersection}


def traced(
    scenario: Scenario, count: int, policy=None, critics=None, transforms=(), backend="batched"
):
    policy = policy or Driver()
    make = BACKENDS[backend]
    rows = evaluate(policy, TransformedEnv(make(scenario, count), *transforms), count, 5, False)
    for transform in transforms:
        transform.reset_parent()
    env = TransformedEnv(make(scenario, count))
    for transform in (TrueScene(), *transforms):
        env.append_transform(transform)
    return rows, record(policy, env, rows, critics, 0.1, policy="driver")


@pytest.fixture(scope="module")
def blind():
    return traced(SCENARIO, 12)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_trace_tells_what_the_test_counted(backend: str):
    scenario = Scenario(task="lt", vehicles=4).as_test()
    rows, trace = traced(scenario, 3, backend=backend)
    assert len(trace) == len(rows)
    for index, row in enumerate(rows):
        found = trace.episode(index)
        assert len(found["ego"]) == row["decisions"] + 1
        assert np.nansum(found["reward"]) == pytest.approx(row["return"], rel=1e-4)
        assert np.nansum(found["cost"]) == pytest.approx(row["cost_return"], abs=1e-4)
        speed = np.hypot(found["ego"][1:, 2], found["ego"][1:, 3])
        assert speed.mean() == pytest.approx(row["speed"], rel=1e-4)
        assert np.isnan(found["proposed"][-1]).all() and np.isfinite(found["proposed"][:-1]).all()
        np.testing.assert_array_equal(found["proposed"], found["executed"])
        hit = trace.episodes["outcome"][index] == "hit_vehicle"
        assert hit == bool(row["hit_vehicle"])
        assert (found["gap"][-1] == 0) == hit and found["gap"][:-1].min() > 0
        if hit:  # the nearest car is the one whose body meets the ego's
            car = found["vehicles"][-1, found["nearest"][-1]]
            poses = [torch.from_numpy(state[[0, 1, 4]]) for state in (found["ego"][-1], car)]
            assert overlap(*poses, scale=1.001)


def test_states_are_the_simulators(blind):
    """Of one episode, step by step."""
    rows, trace = blind
    env = BatchedIntersection(SCENARIO, 1)
    seeds = torch.tensor([rows[4]["seed"]])
    found = trace.episode(4)
    tensordict = env.reset(seeds=seeds)
    for number in range(rows[4]["decisions"] + 1):
        ego, others = env.snapshot(0)
        np.testing.assert_allclose(found["ego"][number], ego, atol=2e-4)
        np.testing.assert_allclose(found["vehicles"][number], others, atol=2e-4)
        tensordict = env.step_mdp(env.step(Driver()(tensordict)))


def test_the_cost_is_the_sum_of_what_each_car_adds(blind):
    _, trace = blind
    for index in range(len(trace)):
        found = trace.episode(index)
        shares, cost = found["cost_share"][:-1].sum(-1), found["cost"][:-1]
        np.testing.assert_allclose(shares[:-1], cost[:-1], atol=1e-5)
        crashed = trace.episodes["outcome"][index] != "success"
        assert cost[-1] - shares[-1] == pytest.approx(float(crashed), abs=1e-5)
    assert (trace.rows["cost_share"] > 0).any()


def test_who_is_observed_and_looked_at_is_told_by_number(blind):
    """The weights of a network on its rows go to the cars that stand in them: those that are near and not behind."""
    rows, _ = blind
    torch.manual_seed(0)
    form = SCENARIO.form
    encoder = MMAMPolicyEncoder(width=16, **form.scales)

    class Looking(Driver):
        def __init__(self):
            super().__init__()
            self.encoder = encoder

    _, trace = traced(SCENARIO, 12, Looking())
    env = BatchedIntersection(SCENARIO, 12)
    first = play(Driver(), env, torch.tensor([row["seed"] for row in rows]))[0]
    weights = encoder.attention(first["ego"], first["vehicles"]).mean(-2)
    for index in range(len(trace)):
        found = trace.episode(index)
        ego, cars = found["ego"][0], found["vehicles"][0]
        offset = cars[:, :2] - ego[:2]
        apart = np.hypot(*offset.T)
        order = [car for car in np.argsort(apart) if found["observed"][0, car]]
        rows_there = int((first["vehicles"][index, :, 0] > 0.5).sum())
        assert len(order) == rows_there
        expected = weights[index, 1 : 1 + rows_there].detach().numpy()
        np.testing.assert_allclose(found["attention"][0, order], expected, atol=1e-6)
        assert found["attention"][0].sum() <= 1 + 1e-6


def test_risks_are_those_of_the_critics_and_the_projector():
    torch.manual_seed(1)
    scales = SCENARIO.form.scales
    members = [
        value_operator(
            MLPValue(rows=SCENARIO.rows, width=16, **scales), out_key="state_action_cost_value"
        )
        for _ in range(3)
    ]
    critics = CriticEnsemble(members, reduce="max")
    limit = float(np.nanmedian(traced(SCENARIO, 4, Driver(), critics)[1].rows["risk"]))
    projector = SafetyProjector(risk=critics, limit=limit, steps=5)
    rows, trace = traced(SCENARIO, 4, Driver(), critics, (projector,))
    found = trace.rows
    assert found["members"].shape[1] == 3 and trace.about["risk_limit"] == 0.1
    last = trace.episodes["first"][1:] - 1
    there = np.setdiff1d(np.arange(len(found["risk"])), last)
    np.testing.assert_allclose(found["members"][there].max(-1), found["risk"][there], atol=1e-6)
    np.testing.assert_array_equal(found["intervened"][there], (found["risk"] > limit)[there])
    moved = (found["proposed"] != found["executed"]).any(-1)
    np.testing.assert_array_equal(moved[there], found["intervened"][there])
    assert found["intervened"].any() and not found["intervened"][last].any()
    share = np.add.reduceat(found["intervened"], trace.episodes["first"][:-1]) / [
        r["decisions"] for r in rows
    ]
    np.testing.assert_allclose(share, [row["intervention_rate"] for row in rows])


def test_priority_follows_entry_then_the_road():
    """From the right, a road of priority: its cars go first; once the ego is alone inside, none does."""
    _, trace = traced(Scenario(task="gs").as_test(), 8, CautiousDriver())
    found, first = trace.rows, trace.episodes["first"][:-1]
    start = found["vehicles"][first]
    approaching = (start[..., 0] > 25) & (start[..., 0] < 110)  # from the east, before the box
    assert approaching.any() and found["priority"][first][approaching].all()
    away = np.isnan(found["vehicles"][..., 0])
    assert not found["priority"][away].any()


def test_a_file_holds_all_and_a_damaged_one_is_refused(blind, tmp_path: Path):
    _, trace = blind
    path = trace.save(tmp_path)
    again = Trace.load(tmp_path)
    assert path.name == TRACE and again.about == trace.about
    for mine, theirs in ((trace.rows, again.rows), (trace.episodes, again.episodes)):
        assert mine.keys() == theirs.keys()
        for key in mine:
            np.testing.assert_array_equal(mine[key], theirs[key])
    whole = path.read_bytes()
    for damaged in (whole[:100], whole[: len(whole) // 2], b"", b"x" * 50):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match="is no trace, or damaged"):
            Trace.load(path)
    np.savez(path, about=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="is no trace, or damaged"):
        Trace.load(path)


def test_crashes_are_explained(blind):
    rows, trace = blind
    crashes = explain(trace, SCENARIO)
    assert [each["episode"] for each in crashes] == [r["episode"] for r in rows if r["collision"]]
    assert len(crashes) > 2
    for each in crashes:
        found = trace.episode([r["episode"] for r in rows].index(each["episode"]))
        assert each["time"] == pytest.approx((len(found["ego"]) - 1) * 0.1)
        assert each["what"] == way(int(found["vehicle_route"][0, each["car"]]))
        assert each["warning"] is None  # a driver without critics
        # Nobody can brake in time in the last half second of a crash at speed, everybody long before.
        assert each["braking"] is not None and 0.5 <= each["braking"] <= 5
    text = table(crashes, len(rows))
    assert text.startswith(f"{len(crashes)} crashes in 12 episodes")
    assert table([], 7) == "No crash in 7 episodes."


def test_the_moment_that_helps_is_found_by_playing_it(blind):
    """The same by hand: the recorded actions up to the moment, then braking along the lane."""
    rows, trace = blind
    crash = explain(trace, SCENARIO)[0]
    index = [r["episode"] for r in rows].index(crash["episode"])
    actions = trace.episode(index)["executed"][:-1]

    def crashes(before: float) -> bool:
        env = BatchedIntersection(SCENARIO, 1)
        tensordict = env.reset(seeds=torch.tensor([crash["seed"]]))
        switch = len(actions) - round(before / 0.1)
        for number in range(len(actions) + 50):
            if number < switch:
                action = torch.from_numpy(actions[number]) / torch.tensor([5.0, 0.6])
                tensordict["action"] = action[None]
            else:
                tensordict = Brake()(tensordict)
            after = env.step(tensordict)
            if after["next", "collision"].item() or after["next", "offroad"].item():
                return True
            tensordict = env.step_mdp(after)
        return False

    assert not crashes(crash["braking"])
    if crash["braking"] > 0.5:
        assert crashes(crash["braking"] - 0.5)


def test_a_warning_is_the_first_within_five_seconds():
    """A critic that speaks of the gap ahead says when it was first above its limit."""

    class Always:
        in_keys = ("ego", "action")

        def parameters(self):
            return iter(())

        def bind(self, data):
            class Bound:
                costs = 1

                def values(self, action):
                    return torch.full((2, len(action), 1), 0.3)

                def __call__(self, action):
                    return torch.full((len(action), 1), 0.3)

            return Bound()

    _, trace = traced(SCENARIO, 12, Driver(), Always())
    crashes = explain(trace, SCENARIO)
    assert crashes and all(each["warning"] == min(5.0, each["time"]) for each in crashes)
    assert all(each["corrected"] == 0 for each in crashes)


def test_executed_actions_are_in_physical_units(blind):
    _, trace = blind
    step = play(
        Driver(), BatchedIntersection(SCENARIO, 1), torch.tensor([trace.episodes["seed"][0]])
    )[0]
    np.testing.assert_allclose(
        trace.episode(0)["executed"][0], to_physical(step["action"])[0], atol=1e-5
    )


def test_the_worst_of_several_risks():
    """In each row the one that exceeds its limit most, as if all had the least limit; the members of that cost."""
    risk = np.array([[0.3, 0.2], [0.1, 0.9], [np.nan, np.nan]], np.float32)
    members = np.stack([risk, risk - 0.1], 1)
    rows = {"risk": risk, "risk_executed": risk, "members": members, "members_executed": members}
    rows |= {"cost": np.array([[1.0, 2.0], [0.0, 0.5], [np.nan, np.nan]], np.float32)}
    worst = Trace({"risk_limit": [0.1, 0.5]}, {}, rows).worst()
    assert worst.about["risk_limit"] == 0.1
    np.testing.assert_allclose(worst.rows["risk"], [0.3, 0.5, np.nan], rtol=1e-6)
    np.testing.assert_allclose(worst.rows["members"][:2], [[0.3, 0.2], [0.5, 0.4]], rtol=1e-6)
    np.testing.assert_allclose(worst.rows["cost"], [3.0, 0.5, np.nan])
    one = Trace({"risk_limit": 0.1}, {}, {"cost": risk[:, 0], "risk": risk[:, 0]})
    assert one.worst() is one
    # A policy that knows of two costs where a test counts one, and of one where a test counts two.
    less = Trace({"risk_limit": [0.1, 0.5]}, {}, {**rows, "cost": rows["cost"][:, 0]}).worst()
    np.testing.assert_array_equal(less.rows["risk"], worst.rows["risk"])
    np.testing.assert_array_equal(less.rows["cost"], rows["cost"][:, 0])
    single = {name: each[..., 0] for name, each in rows.items() if name != "cost"}
    more = Trace({"risk_limit": 0.1}, {}, {**single, "cost": rows["cost"]}).worst()
    assert more.about["risk_limit"] == 0.1
    np.testing.assert_array_equal(more.rows["risk"], risk[:, 0])
    np.testing.assert_array_equal(more.rows["cost"], worst.rows["cost"])
