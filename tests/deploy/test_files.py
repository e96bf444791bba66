"""Policies as pt2 and ONNX files do what they do in saferl."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import onnxruntime
import pytest
import torch
from tensordict import TensorDict

import saferl
from saferl.algorithms.parts import make
from saferl.algorithms.policy import REPORTED, SafePolicy
from saferl.checkpoint.run import run_config
from saferl.config.locate import pretrained_run
from saferl.deploy.card import card
from saferl.deploy.formats import FORMATS, read_onnx, read_pt2
from saferl.deploy.graph import policy_graph
from saferl.deploy.package import package
from saferl.envs import Cart
from saferl.envs.intersection import BatchedIntersection, Scenario

ROOT = Path(__file__).parents[2]


def scenes(count: int, vehicles: int, seed: int = 0) -> dict[str, torch.Tensor]:
    """States of the road: the ego anywhere on its way, cars around it, some of them absent."""
    generator = torch.Generator().manual_seed(seed)
    spread = torch.tensor([20.0, 20.0, 2.0, 0.1, 3.0, 0.1])
    centre = torch.tensor([0.0, 20.0, 7.0, 0.0, 0.0, 0.0])
    ego = torch.randn(count, 6, generator=generator) * spread * 0.3 + centre
    others = torch.randn(count, vehicles, 6, generator=generator) * spread + centre
    absent = torch.rand(count, vehicles, generator=generator) < 0.2
    others[absent] = torch.nan
    route = torch.randint(4, (count,), generator=generator)
    return {"ego": ego, "vehicles": others, "route": route}


def agree(policy: SafePolicy, told: dict[str, torch.Tensor], seen: dict[str, torch.Tensor]) -> None:
    own = policy(TensorDict(seen, [len(seen["ego"])]))
    assert list(told) == ["action", *REPORTED]
    for name, value in told.items():
        assert value.shape == own[name].shape and value.dtype == own[name].dtype, name
        torch.testing.assert_close(
            value, own[name], atol=1e-5, rtol=1e-5, msg=lambda m, n=name: f"{n}: {m}"
        )


@pytest.mark.parametrize(("count", "vehicles"), [(1, 0), (1, 3), (7, 1), (64, 12)])
def test_onnx_from_the_state_acts_as_the_policy_does(count: int, vehicles: int, small, from_state):
    policy, observe = saferl.load_policy(small), make(run_config(small).task).from_state()
    state = scenes(count, vehicles)
    seen = observe(**state)
    agree(policy, read_onnx(from_state)[0](state), seen)
    if count == 64:
        report = policy(TensorDict(seen, [count]))
        for name in ("intervened", "feasible"):
            assert 0.1 < float(report[name].float().mean()) < 0.95, name
        assert int(report["projection_steps"].unique().numel()) > 5


def test_pt2_acts_as_the_policy_does(small: Path, tmp_path: Path):
    """Whatever the strides of what it is given."""
    file = tmp_path / "policy.pt2"
    about = package(small, file)
    run, told = read_pt2(file)
    assert told == {name: value for name, value in about.items() if name != "compared"}
    observe = make(run_config(small).task).from_state()
    for count in (1, 7, 64):
        seen = observe(**scenes(count, 12))
        agree(saferl.load_policy(small), run(seen), seen)
    spread = {k: v.movedim(0, -1).contiguous().movedim(-1, 0) for k, v in seen.items()}
    torch.testing.assert_close(run(spread)["action"], run(seen)["action"])


def test_a_file_and_its_card_say_what_goes_in(small: Path, from_state: Path):
    _, about = read_onnx(from_state)
    assert list(about["inputs"]) == ["ego", "vehicles", "route"]
    assert about["inputs"]["vehicles"]["shape"] == ["batch", "vehicles", 6]
    session = onnxruntime.InferenceSession(from_state)
    shapes = {each.name: each.shape for each in (*session.get_inputs(), *session.get_outputs())}
    assert shapes["vehicles"] == ["batch", "vehicles", 6] and shapes["action"] == ["batch", 2]
    units = {each["name"]: each["unit"] for each in about["inputs"]["ego"]["features"]}
    assert units == {"x": "m", "y": "m", "v_x": "m/s", "v_y": "m/s", "phi": "rad", "omega": "rad/s"}
    action = about["outputs"]["action"]["features"]
    assert [(a["unit"], a["low"], a["high"]) for a in action] == [("5 m/s^2", -1.0, 1.0), ("0.6 rad", -1.0, 1.0)]  # fmt: skip
    assert about["projector"]["limit"] == 0.0 and about["trained"]["frames"] == 24
    text = card(small, from_state, {**about, "compared": "all"}).read_text(encoding="utf-8")
    digest = hashlib.sha256(from_state.read_bytes()).hexdigest()
    for words in ("`policy.onnx`", digest, "| `v_x` | m/s | 0 to any |", "## Trained", "Not for"):
        assert words in text
    assert str(small) not in text and str(small).encode() not in from_state.read_bytes()


def test_the_example_needs_neither_torch_nor_saferl(from_state: Path):
    code = f"""
import runpy, sys
sys.argv = ["drive", {str(from_state)!r}, "1"]
runpy.run_path({str(ROOT / "examples" / "drive_onnx.py")!r})
print(sorted({{"torch", "saferl", "tensordict"}} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]" and ": 1}" in done.stdout


def test_the_command(command, refusal, tmp_path: Path, small: Path):
    export = ("export", "export")
    command(*export, "pretrained=arsac", "project=false", "out=alone")
    assert saferl.load_policy(tmp_path / "alone").projector is None
    text = (tmp_path / "alone/README.md").read_text()
    assert "# alone" in text and "## Tested" in text and text.count("## Checksum") == 1
    assert "Not without its projector" in text and "98.3" not in text
    assert "alone holds a policy; take another" in refusal("train", "config", "out=alone")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/README.md").write_text("precious")
    assert "out: mine holds a README.md" in refusal(*export, "pretrained=arsac", "out=mine")
    assert (tmp_path / "mine/README.md").read_text() == "precious"
    line = refusal(*export, f"checkpoint={small}", "out=alone", "format=pt2")
    assert "out: alone holds a run or a policy already" in line
    command(*export, "checkpoint=alone", "out=pt2", "format=pt2")
    run, about = read_pt2(tmp_path / "pt2/policy.pt2")
    assert about["projector"] is None and about["algo"] == "arsac"
    seen = {"ego": torch.zeros(2, 12), "vehicles": torch.zeros(2, 11, 12)}
    own = saferl.load_policy("arsac", project=False)(TensorDict(seen, [2]))["action"]
    torch.testing.assert_close(run(seen), {"action": own}, atol=1e-5, rtol=0)


def test_what_a_graph_cannot_be_is_refused(small: Path, tmp_path: Path):
    policy = saferl.load_policy(small)
    policy.projector = torch.nn.Identity()
    with pytest.raises(ValueError, match="got Identity: take project=false, or format=torch"):
        policy_graph(policy, make(run_config(small).task).ports)
    with pytest.raises(ValueError, match="observation=state is of the road, got task=cart"):
        Cart().from_state()


@pytest.mark.slow
@pytest.mark.parametrize("observation", ["features", "state"])
@pytest.mark.parametrize("form", FORMATS)
def test_what_ships_drives_the_same(form: str, observation: str, tmp_path: Path):
    """In dense traffic, in the states where its projector acts. Where no action is within the limit the correction swings, and
    the last digit of an observation decides where it ends: 1 of 100 such actions may differ."""
    file = tmp_path / f"policy.{form}"
    package(pretrained_run("arsac"), file, observation=observation)
    run, policy = FORMATS[form][1](file)[0], saferl.load_policy("arsac")
    task = Scenario(task="mixed", scenario="dense").as_test()
    env, observe = BatchedIntersection(task, 256), task.from_state()
    state, apart, feasible = env.reset(seeds=task.episodes(5, 256)), [], []
    for _ in range(60):
        ego, others = (torch.tensor(part).float() for part in env.snapshot(slice(None)))
        scene = {"ego": ego, "vehicles": others, "route": state["route"].flatten()}
        seen = observe(**scene)
        own = policy(TensorDict(seen, [256]))
        acts = own["intervened"].flatten()
        told = run(scene if observation == "state" else seen)
        apart.append((told["action"] - own["action"]).abs().amax(-1))
        assert (apart[-1][~acts] <= 1e-5).all()
        feasible.append(torch.stack([acts, own["feasible"].flatten()], -1))
        state = env.step_mdp(env.step(state.update(own.select("action"))))
    apart, (acts, within) = torch.cat(apart), torch.cat(feasible).unbind(-1)
    assert acts.sum() > 100 and (apart[acts & within] <= 1e-5).all()
    assert (apart[acts] <= 1e-5).float().mean() > 0.98


def test_metadata_is_plain_json(from_state: Path):
    assert json.loads(json.dumps(read_onnx(from_state)[1]))["saferl"] == saferl.__version__
