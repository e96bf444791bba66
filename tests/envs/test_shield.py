"""The shield: what it foresees against closed forms and the simulator itself, and what it lets pass."""

from __future__ import annotations

import copy
import math
import pickle
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from saferl.envs.cart import Cart, CartEnv
from saferl.envs.intersection import BatchedIntersection, HighwayIntersection, Scenario
from saferl.envs.intersection.drivers import Brake, CautiousDriver, Driver, Hold
from saferl.envs.intersection.foresight import (
    AlongLanes,
    ConstantVelocity,
    Simulator,
    pick,
    safe_for,
)
from saferl.envs.intersection.geometry import ARM
from saferl.envs.intersection.roads import lane_frames, lanes
from saferl.envs.transforms import SafetyProjector, Shield

ROAD = Scenario(task="gs").as_test()
GS = 1  # straight on in the inner lane, x = 2, towards -y
GO = torch.tensor([1.0, 0.0])


def scene(y: float, speed: float, *others: tuple[float, float, float, float]) -> TensorDict:
    """An ego in its lane at ``y``, and others (x, y, speed, heading), as ``world`` shows them; it accelerates."""
    ego = torch.tensor([1.0, 2.0, y, speed, 0.0, -math.pi / 2, 0.0, 0.0, 0.0])
    table = torch.zeros(11, 6)
    for row, (x, where, v, heading) in enumerate(others):
        table[row] = torch.tensor(
            [1, x - 2, where - y, v * math.cos(heading), v * math.sin(heading) + speed, heading]
        )
    seen = {"ego": ego[None], "vehicles": table[None], "route": torch.tensor([[GS]])}
    return TensorDict(seen | {"action": GO[None]}, [1])


def lasts(
    seen: TensorDict, driver, first=None, horizon: float = 5.0, kind=ConstantVelocity, **settings
) -> float:
    prediction = kind(**settings)
    start = prediction.begin(seen, None, ROAD)
    return safe_for(prediction, ROAD, start, driver, horizon, first).item()


def test_a_car_that_crosses_is_met_when_both_are_there():
    """Both are 23.5 m before each other's strip at 9 m/s: they touch after 23.5 / 9 = 2.611 s."""
    crossing = scene(29.0, 9.0, (-25.0, 2.0, 9.0, 0.0))
    # Found at the end of a decision of 0.2 s.
    assert lasts(crossing, Driver()) == pytest.approx(2.8)
    assert lasts(crossing, Driver(), horizon=2.6) == math.inf
    assert lasts(crossing, Hold()) == pytest.approx(2.8)
    assert lasts(crossing, Brake()) == math.inf  # stands 8.1 m on, 12 m before the strip
    assert lasts(crossing, CautiousDriver()) == math.inf
    # A second later the other has passed.
    assert lasts(scene(38.0, 9.0, (-25.0, 2.0, 9.0, 0.0)), Driver()) == math.inf


def test_an_action_passes_as_long_as_braking_would_still_do():
    """Braking from 9 m/s takes 8.1 m, from 9.5 m/s and a decision later 10.0 m."""
    shield = Shield(margin=0.0)
    late, early = (scene(y, 9.0, (-13.5, 2.0, 9.0, 0.0)) for y in (15.0, 17.5))
    passes, refused = shield.correct(early), shield.correct(late)
    assert torch.equal(passes["action_executed"], early["action"])
    assert not passes["intervened"] and passes["feasible"] and passes["fallback"] == 0
    assert refused["intervened"] and refused["feasible"] and refused["fallback"] == 1
    assert refused["action_executed"][0, 0] == -1.0
    assert lasts(late, Driver(), GO[None]) < 2.0


def test_a_margin_is_kept_but_not_asked_of_who_stands_near():
    """A gap of 0.3 m may stay; it may not shrink, nor one of 3 m become less than the margin."""
    shield, ahead = Shield(), partial(scene, 60.0)
    near = ahead(0.0, (2.0, 60.0 - 5.3, 0.0, -math.pi / 2))
    stays = near.clone().set("action", torch.tensor([[-1.0, 0.0]]))
    assert shield.correct(near)["fallback"] == 1
    assert shield.correct(stays)["fallback"] == 0 and shield.correct(stays)["feasible"]
    # From 3 m, at 5 m/s^2 for 0.1 s and braking as long: 0.05 m. At 5 m/s 2.5 m and more.
    assert shield.correct(ahead(0.0, (2.0, 52.0, 0.0, -math.pi / 2)))["fallback"] == 0
    assert shield.correct(ahead(5.0, (2.0, 52.0, 0.0, -math.pi / 2)))["fallback"] == 1


def test_who_comes_from_behind_or_can_stop_is_trusted_to():
    behind = scene(60.0, 9.0, (2.0, 66.0, 10.0, -math.pi / 2))
    assert lasts(behind, Brake()) == math.inf
    across = partial(scene, 2.0, 0.0)  # stands in the other's way
    assert lasts(across((-28.0, 2.0, 9.0, 0.0)), Brake()) == math.inf
    # 6 m before the ego's flank at 9 m/s: 13.5 m/s^2.
    assert lasts(across((-7.5, 2.0, 9.0, 0.0)), Brake()) == pytest.approx(0.8)


def test_who_has_begun_to_turn_turns_on():
    """An oncoming car, 2 m into its left turn, comes across the ego's lane in the middle of the box."""
    route = torch.tensor(8)  # from the north, to the left, which is to the east
    table = lanes(route, torch.zeros(()))
    place, heading = lane_frames(table, torch.tensor(ARM + 2.0))
    turns = scene(10.0, 6.0, (place.x.item(), place.y.item(), 7.0, heading.item()))
    assert lasts(turns, Hold()) == math.inf  # straight on it would cross behind the ego
    assert lasts(turns, Hold(), kind=AlongLanes) == pytest.approx(1.6)
    prediction = AlongLanes()
    start = prediction.begin(turns, None, ROAD)
    told = prediction.moved(start, torch.tensor([0.5, 2.0])[:, None, None])
    ways, angles = lane_frames(table, ARM + 2.0 + 7.0 * torch.tensor([0.5, 2.0]))
    for key, value in (("x", ways.x), ("y", ways.y), ("heading", angles)):
        torch.testing.assert_close(told[key][:, 0, 0], value, atol=1e-4, rtol=0)
    # And so after decisions one after the other, with its velocity along it.
    for _ in range(5):
        start, _ = prediction.step(ROAD, start, torch.zeros(1, 2))
    way, angle = lane_frames(table, torch.tensor(ARM + 2.0 + 7.0 * 0.5))
    told = torch.stack([start[key][0, 0] for key in ("x", "y", "v_x", "v_y")])
    aims = torch.stack([way.x, way.y, 7.0 * angle.cos(), 7.0 * angle.sin()])
    torch.testing.assert_close(told, aims, atol=1e-3, rtol=0)


def test_who_has_not_begun_to_turn_or_fits_no_lane_goes_straight_on():
    """Three movements share an approach; a car that stands askew between the lanes follows none."""
    for other in ((-25.0, 2.0, 9.0, 0.0), (-3.0, 1.0, 5.0, 2.4)):
        seen = scene(29.0, 9.0, other)
        ends = []
        for prediction in (ConstantVelocity(), AlongLanes()):
            start = prediction.begin(seen, None, ROAD)
            way = prediction.moved(start, torch.tensor([0.5, 2.5])[:, None, None])
            ends.append(torch.stack([way[key][:, 0, 0] for key in ("x", "y", "heading")]))
        torch.testing.assert_close(*ends, atol=1e-4, rtol=0)


def test_who_drives_ahead_may_brake_at_any_time():
    """10 m behind at 8 m/s: it stands after 6.4 m, so that its tail is reached after 16.4 / 8 = 2.05 s."""
    ahead = scene(60.0, 8.0, (2.0, 45.0, 8.0, -math.pi / 2))
    assert lasts(ahead, Hold()) == pytest.approx(2.2)  # the end of a decision of 0.2 s
    assert lasts(ahead, Hold(), ahead=0.0) == math.inf
    assert lasts(ahead, Brake()) == math.inf
    # The gap shrinks by t^2 where it brakes with 2 m/s^2, for 4 s: by 10 m after 3.16 s.
    assert lasts(ahead, Hold(), ahead=2.0) == pytest.approx(3.2)
    # Who comes towards it goes on.
    oncoming = scene(60.0, 8.0, (2.0, 0.0, 8.0, math.pi / 2))
    assert lasts(oncoming, Hold()) == lasts(oncoming, Hold(), ahead=0.0) == pytest.approx(3.6)


def test_where_nobody_can_be_saved_the_last_to_crash_drives():
    """4.5 m before a wall of a car at 9 m/s: braking hits it last."""
    wall = scene(40.0, 9.0, (2.0, 40.0 - 9.5, 0.0, -math.pi / 2))
    times = [lasts(wall, driver) for driver in (Driver(), Hold(), Brake())]
    assert times[0] <= times[1] <= times[2] < math.inf
    order = {"go": Driver(), "brake": Brake()}
    report = Shield(fallbacks=order).correct(wall)
    assert not report["feasible"] and report["intervened"]
    assert order[["go", "brake"][int(report["fallback"]) - 1]] is order["brake"] or (
        times[0] == times[2]
    )


def test_nothing_near_passes_bit_for_bit():
    env = TransformedEnv(BatchedIntersection(Scenario(vehicles=0).as_test(), 16, seed=0), Shield())
    steers = TensorDictModule(  # as one may in a lane
        lambda ego: (torch.rand(16, 2) * 2 - 1) * torch.tensor([1.0, 0.02]), ["ego"], ["action"]
    )
    data = env.rollout(3, steers)
    assert torch.equal(data["next", "action_executed"], data["action"])
    assert not data["next", "intervened"].any() and not data["next", "fallback"].any()


def driven(scenario: Scenario, count: int, decisions: int):
    """The batched road after some decisions of a driver blind to traffic, and what is seen there."""
    env = BatchedIntersection(scenario, count)
    seen = env.reset(seeds=scenario.episodes(3, count))
    for _ in range(decisions):
        seen = env.step_mdp(env.step(Driver()(seen)))
    return env, Driver()(seen)


def test_the_simulators_prediction_is_the_simulator():
    """Who crashes when is what happens if one plays on."""
    scenario = Scenario(task="lt", scenario="aggressive").as_test()
    env, seen = driven(scenario, 24, 30)
    prediction = Simulator(patience=math.inf)
    start = prediction.begin(seen, env, scenario)
    told = safe_for(prediction, scenario, start, Driver(), 6.0)
    truth = torch.full((24,), math.inf)
    going = torch.ones(24, dtype=torch.bool)
    for number in range(60):
        seen = env.step(Driver()(seen))["next"]
        crash = (seen["collision"] | seen["offroad"]).squeeze(-1)
        truth[going & crash] = (number + 1) / 10
        going &= ~(crash | seen["success"].squeeze(-1))
    assert truth.isfinite().sum() >= 5
    torch.testing.assert_close(told, truth)


@pytest.mark.parametrize("prediction", [AlongLanes(), Simulator()])
def test_scenes_do_not_feel_each_other(prediction):
    scenario = Scenario(task="mixed").as_test()
    env, seen = driven(scenario, 12, 45)
    start = prediction.begin(seen, env, scenario)
    action = seen["action"]
    told = safe_for(prediction, scenario, start, Brake(), 2.0, action, 0.5)
    for index in (0, 5, 11):
        row = torch.tensor([index])
        alone = safe_for(prediction, scenario, pick(start, row), Brake(), 2.0, action[row], 0.5)
        torch.testing.assert_close(alone, told[row])
    turned = torch.arange(12).flip(0)
    again = safe_for(prediction, scenario, pick(start, turned), Brake(), 2.0, action[turned], 0.5)
    torch.testing.assert_close(again, told[turned])


def test_a_blind_driver_is_saved():
    """Eight left turns in which it hits somebody on its own."""
    scenario = Scenario(task="lt").as_test()
    seeds = scenario.episodes(3, 32)
    crashed = torch.zeros(32, dtype=torch.bool)
    env = BatchedIntersection(scenario, 32)
    seen = env.reset(seeds=seeds)
    for _ in range(70):
        seen = env.step(Driver()(seen))["next"]
        crashed |= seen["collision"].squeeze(-1)
    seeds = seeds[crashed][:8]
    env = TransformedEnv(BatchedIntersection(scenario, 8), Shield())
    seen = env.reset(seeds=seeds)
    acted = torch.zeros(8, dtype=torch.bool)
    for _ in range(70):
        seen = env.step(Driver()(seen))["next"]
        assert not (seen["collision"] | seen["offroad"]).any()
        acted |= seen["fallback"].squeeze(-1) > 0
    assert acted.all()


ROADS = {
    "alone": lambda: TransformedEnv(BatchedIntersection(ROAD, 2, seed=0), Shield()),
    "simulator": lambda: TransformedEnv(
        BatchedIntersection(ROAD, 2, seed=0), Shield(Simulator(), horizon=1.0)
    ),
    "serial": lambda: TransformedEnv(
        SerialEnv(2, partial(BatchedIntersection, ROAD, 2)), Shield(frequency=10)
    ),
    "highway": lambda: TransformedEnv(HighwayIntersection(ROAD, 1, seed=0), Shield()),
}


@pytest.mark.parametrize("numbers", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("name", ROADS)
def test_specs(name: str, numbers: torch.dtype):
    before = torch.get_default_dtype()
    torch.set_default_dtype(numbers)
    try:
        env = ROADS[name]()
        check_env_specs(env)
        data = env.rollout(2)
        assert data["next", "action_executed"].dtype == numbers
        assert data["next", "fallback"].dtype == torch.int64
    finally:
        torch.set_default_dtype(before)


@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["deepcopy", "pickle"]
)  # fmt: skip
@pytest.mark.parametrize("name", ["alone", "simulator"])
def test_a_copy_goes_on_by_itself(name: str, copied):
    env = ROADS[name]()
    last = env.rollout(3, break_when_any_done=False)[:, -1]["next"]
    other = copied(env)
    steps = TensorDict({"action": torch.full(env.action_spec.shape, 0.3)}, env.batch_size)
    for _ in range(2):
        ours, theirs = (each.step(last.clone().update(steps))["next"] for each in (env, other))
        assert all((ours[key] == theirs[key]).all() for key in ours.keys())  # noqa: SIM118
    assert other.transform is not env.transform


def test_it_has_no_state_to_resume():
    assert not Shield().state_dict()


def test_behind_a_projector_it_has_the_last_word():
    """A projector that always brakes a little is told apart from the shield, and both count."""
    risk = TensorDictModule(lambda ego, action: action[..., :1] + 1, ["ego", "action"], ["risk"])
    shield = Shield(margin=0.0, first=SafetyProjector(risk, 1.905, penalty=10.0))
    free, late = scene(40.0, 9.0), scene(15.0, 9.0, (-13.5, 2.0, 9.0, 0.0))
    report = shield.correct(torch.cat([free, late]), low=-1.0, high=1.0)
    assert report["intervened"].flatten().tolist() == [True, True]
    assert report["fallback"].flatten().tolist() == [0, 1]
    assert report["action_executed"][:, 0].tolist() == pytest.approx([0.9, -1.0])
    assert set(report.keys()) == {"action_executed", *shield.reports}
    assert report["risk_before"].flatten().tolist() == [2.0, 2.0]
    assert shield.limit == pytest.approx(1.905) and Shield().limit is None
    env = TransformedEnv(BatchedIntersection(ROAD, 2, seed=0), shield)
    check_env_specs(env)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fallbacks": {}}, "fallbacks must be drivers by name, one at least"),
        ({"fallbacks": [Brake()]}, "fallbacks must be drivers by name, one at least"),
        ({"fallbacks": {"crawl": torch.nn.ReLU()}}, "fallbacks.crawl must be a TensorDictModule"),
        ({"horizon": 0.0}, "horizon must be > 0, got 0.0"),
        ({"frequency": -1}, "frequency must be > 0, got -1"),
        ({"margin": -0.1}, r"margin must be >= 0, got -0.1"),
    ],
)
def test_settings_are_refused(options, message: str):
    with pytest.raises(ValueError, match=message):
        Shield(**options)


def test_a_fallback_that_gives_no_number_is_named():
    """Nothing is nearer than the margin where it is NaN, so that it would seem safe."""
    bad = TensorDictModule(lambda ego: ego[..., :2] * math.nan, ["ego"], ["action"])
    with pytest.raises(ValueError, match="the fallback bad: an action is not finite"):
        Shield(fallbacks={"bad": bad}).correct(scene(60.0, 8.0))
    road = TransformedEnv(BatchedIntersection(ROAD, 2, seed=0), Shield())
    with pytest.raises(ValueError, match="the policy gave an action that is not finite"):
        road.rollout(1, bad)


@pytest.mark.parametrize(
    ("road", "shield", "message"),
    [
        (partial(HighwayIntersection, ROAD, 1), lambda: Shield(Simulator()), "which HighwayIntersection is not: take env=batched, or ConstantVelocity"),
        (partial(CartEnv, Cart(), 2), Shield, "needs frequency=.*CartEnv: it is no intersection"),
        (lambda: SerialEnv(2, partial(BatchedIntersection, ROAD, 2)), lambda: Shield(Simulator(), frequency=10), "which SerialEnv is not"),
    ],
)  # fmt: skip
def test_what_it_cannot_look_into_is_refused(road, shield, message: str):
    with pytest.raises(ValueError, match=message):
        TransformedEnv(road(), shield()).rollout(1)
