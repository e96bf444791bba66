"""Policies that ship, and any policy as one module."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

import saferl
from saferl.algorithms.policy import SafePolicy, compiling, trained_agent
from saferl.checkpoint.policy import EXPORTED
from saferl.checkpoint.run import run_config
from saferl.config.locate import pretrained_run, shipped
from saferl.envs.intersection import BatchedIntersection, Scenario

SHIPPED = ("arsac", "arsac_plus", "asac", "sac_lag")
SCENARIO = Scenario(task="mixed").as_test()


def test_what_ships_is_small_and_has_a_card():
    assert set(SHIPPED) <= set(shipped())
    for name in shipped():
        folder = pretrained_run(name)
        assert (folder / EXPORTED).stat().st_size <= 2e6
        card = (folder / "README.md").read_text(encoding="utf-8")
        for words in (
            f"# {name}",
            "## Trained",
            "## Tested",
            "python -m saferl ",
            "seed",
            "Not for",
        ):
            assert words in card, f"{name}: {words}"


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_policy_drives(name: str):
    """Eight episodes, the same actions as with the projector as a transform of the environment."""
    policy = saferl.load_policy(name)
    cfg = run_config(pretrained_run(name))
    assert cfg.algo_name == name and (policy.projector is not None) == name.startswith("arsac")
    seeds = SCENARIO.episodes(11, 8)
    state = BatchedIntersection(SCENARIO, 8).reset(seeds=seeds)
    agent = trained_agent(compiling(cfg, False), pretrained_run(name))
    env = TransformedEnv(BatchedIntersection(SCENARIO, 8), *agent.transforms)
    theirs = env.reset(seeds=seeds)
    alone = BatchedIntersection(SCENARIO, 8)
    alone.reset(seeds=seeds)
    for _ in range(40):
        mine = policy(state)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            theirs = env.step(agent.actor(theirs))
        executed = theirs["next"].get("action_executed", theirs["action"])
        torch.testing.assert_close(mine["action"], executed)
        if policy.projector is not None:
            for key in ("risk_before", "risk_after", "intervened", "feasible"):
                torch.testing.assert_close(mine[key], theirs["next", key])
        state = alone.step_mdp(alone.step(mine.clone()))
        theirs = env.step_mdp(theirs)
    speed = torch.hypot(state["ego"][:, 0], state["ego"][:, 1])
    assert speed.max() > 3.0  # it drives


def test_without_its_projector_the_mean_action_is_executed():
    seen = BatchedIntersection(SCENARIO, 8).reset(seeds=SCENARIO.episodes(11, 8))
    whole, bare = saferl.load_policy("arsac"), saferl.load_policy("arsac", project=False)
    assert bare.projector is None
    torch.testing.assert_close(whole(seen.clone())["action_proposed"], bare(seen.clone())["action"])


def test_a_policy_that_is_not_there_is_named(tmp_path: Path):
    with pytest.raises(
        ValueError, match=r"load_policy takes a path, or one of arsac, .*, got 'nothing'"
    ):
        saferl.load_policy("nothing")
    (tmp_path / EXPORTED).write_bytes(b"damaged")
    with pytest.raises(ValueError, match="damaged"):
        saferl.load_policy(tmp_path)
    with pytest.raises(AttributeError, match="no attribute 'load_polcy'"):
        saferl.load_polcy  # noqa: B018


def test_a_policy_is_a_module():
    policy = saferl.load_policy("arsac")
    assert isinstance(policy, SafePolicy) and sum(p.numel() for p in policy.parameters()) > 1000
    seen = BatchedIntersection(SCENARIO, 2).reset(seeds=SCENARIO.episodes(0, 2))
    first = policy(seen.clone())["action"]
    policy.load_state_dict(policy.state_dict())
    torch.testing.assert_close(policy(seen.clone())["action"], first)


def test_what_is_not_finite_is_refused_and_a_device_is_named():
    seen = BatchedIntersection(SCENARIO, 2).reset(seeds=SCENARIO.episodes(0, 2))
    policy = saferl.load_policy("arsac", device=torch.device("cpu"))
    assert not policy.training and set(policy.out_keys) <= set(policy(seen.clone()).keys())
    seen["ego"][0, 0] = torch.nan
    with pytest.raises(ValueError, match="an action that is not finite"):
        policy(seen)


@pytest.mark.parametrize("name", ["arsac", "asac"])
def test_no_state_and_a_locked_one(name: str):
    """No state gives no action; what may not be written to stays as it is, and a copy has the action."""
    seen = BatchedIntersection(SCENARIO, 2).reset(seeds=SCENARIO.episodes(0, 2))
    policy = saferl.load_policy(name)
    none = policy(seen[:0].clone())
    assert all(none[key].shape[0] == 0 for key in policy.out_keys) and none["action"].shape == (
        0,
        2,
    )
    locked = seen.clone().lock_()
    told = policy(locked)
    assert set(locked.keys()) == set(seen.keys()) and not told.is_locked
    torch.testing.assert_close(told["action"], policy(seen.clone())["action"])


def test_another_action_is_corrected_as_its_own():
    policy = saferl.load_policy("arsac")
    policy.projector._limit.fill_(0.0)
    seen = BatchedIntersection(SCENARIO, 8).reset(seeds=SCENARIO.episodes(11, 8))
    own = policy(seen.clone())
    state = {key: seen[key] for key in policy.in_keys}
    result = policy.project(state, own["action_proposed"])
    torch.testing.assert_close(result.action, own["action"])
    for name in ("risk_before", "risk_after", "intervened", "feasible"):
        torch.testing.assert_close(getattr(result, name), own[name].squeeze(-1))
    assert result.steps.dtype is torch.int64 and result.intervened.any()
    with pytest.raises(ValueError, match="needs a policy with a SafetyProjector, got none"):
        saferl.load_policy("arsac", project=False).project(state, own["action"])
    unknown = {key: value * torch.nan for key, value in state.items()}
    for seen, action in ((unknown, own["action"]), (state, own["action"] * torch.nan)):
        with pytest.raises(ValueError, match="is not finite"):
            policy.project(seen, action)
    sizes = r"ego \[8, 12\], vehicles \[8, \d+, 12\], action"
    for size in ((8, 3), (7, 2)):
        with pytest.raises(ValueError, match=sizes):
            policy.project(state, torch.zeros(size))
    with pytest.raises(ValueError, match="needs ego, vehicles, action, got no vehicles"):
        policy.project({"ego": state["ego"]}, own["action"])
    with torch.inference_mode(), pytest.raises(RuntimeError, match="no_grad, not inference_mode"):
        policy.project(state, own["action"])
