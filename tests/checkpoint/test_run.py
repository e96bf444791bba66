"""Checkpoints: whole, atomic, without pickle."""

from __future__ import annotations

import itertools
import json
import pickle
import re
import shutil
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from safetensors.torch import save_file
from small import EMPTY, SMALL, compose
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from saferl.algorithms.assemble import build_agent, build_trainer, load_agent
from saferl.checkpoint.policy import policy_state
from saferl.checkpoint.run import (
    CONFIG,
    EXPORTED,
    RunCheckpoint,
    export,
    latest,
    progress,
    run_config,
    run_folder,
)
from saferl.checkpoint.sealed import digests
from saferl.checkpoint.state import BufferState, Fitting, GrowingFiles
from saferl.config.locate import pretrained_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of RSAC without its test episodes."""
    folder = tmp_path_factory.mktemp("run")
    cfg = compose(*SMALL, *EMPTY, "algo=rsac", "task.duration=2")
    build_trainer(cfg, folder).train()
    OmegaConf.save(cfg, folder / CONFIG, resolve=True)
    return folder


def test_no_file_is_pickled(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Neither by its name, nor by what it holds, nor when it is read."""
    for path in run.rglob("checkpoints/**/*"):
        assert path.suffix not in (".pkl", ".pt", ".pth", ".t", ".pickle")
        if path.is_file() and path.suffix != ".memmap":
            json.loads(path.read_text())

    def refuse(*args, **kwargs):
        raise AssertionError("pickle was used")

    for module, name in ((pickle, "load"), (pickle, "loads"), (torch, "load")):
        monkeypatch.setattr(module, name, refuse)
    cfg = compose(*SMALL, *EMPTY, "algo=rsac", "task.duration=2")
    trainer = build_trainer(cfg, run)
    trainer.resume()
    assert trainer.progress.frames == 24


def test_everything_is_in_it(run: Path):
    """A peer's checkpoint held the actor alone (docs/pitfalls.md, 13)."""
    assert set(Checkpoint.manifest(latest(run))["components"]) == {
        "buffer", "clock", "collector", "files", "loss", "means", "optimizer", "progress", "rng", "watch",
        "watchdog", "best",
        "window",
    }  # fmt: skip
    agent = build_agent(compose(*SMALL, *EMPTY, "algo=rsac"))
    names = {name.split(".")[0] for name in agent.loss.state_dict()}
    assert {
        "actor_network_params", "qvalue_network_params", "target_qvalue_network_params",
        "cost_critic_params", "target_cost_critic_params", "log_alpha", "lagrange",
    } <= names  # fmt: skip


def test_a_failed_write_leaves_the_last_checkpoint(tmp_path: Path):
    class Part:
        broken = False

        def state_dict(self):
            if self.broken:
                raise OSError("disk full")
            return {"value": torch.tensor(1.0)}

        def load_state_dict(self, state):
            self.loaded = state

    part = Part()
    checkpoint = RunCheckpoint(tmp_path, part=part)
    checkpoint.save(1, {})
    part.broken = True
    with pytest.raises(OSError, match="disk full"):
        checkpoint.save(2, {})
    assert latest(tmp_path).name.endswith("1")
    assert len(list((tmp_path / "checkpoints").iterdir())) == 1

    # What a SIGKILL leaves half written is neither read nor kept.
    leftover = tmp_path / "checkpoints/.checkpoint-000000000009.stage-0123"
    (leftover / "components").mkdir(parents=True)
    checkpoint.load_latest()
    assert part.loaded["value"] == 1.0 and not leftover.exists()


@pytest.mark.parametrize("how", ["moved", "deleted", "deleted in a save", "replaced"])
def test_a_folder_that_is_gone_is_not_begun_anew(how: str, tmp_path: Path):
    """It would hold a checkpoint, and nothing else of the run."""
    run = tmp_path / "run"

    class Part:
        deletes = False

        def state_dict(self):
            if self.deletes:
                shutil.rmtree(run)
            return {"value": torch.tensor(1.0)}

    part = Part()
    checkpoint = RunCheckpoint(run, part=part)
    checkpoint.save(1, {})
    if how == "moved":
        run.rename(tmp_path / "elsewhere")
    elif how == "deleted in a save":
        part.deletes = True
    else:
        shutil.rmtree(run)
    if how == "replaced":
        run.mkdir()
    with pytest.raises(
        FileNotFoundError, match="run was moved or deleted while the run wrote to it"
    ):
        checkpoint.save(2, {})


def test_the_newest_replaces_the_older(tmp_path: Path):
    checkpoint = RunCheckpoint(tmp_path, part=GrowingFiles())
    for frames in (5, 10):
        checkpoint.save(frames, {})
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == [latest(tmp_path).name]
    assert latest(tmp_path).name.endswith("10")


@pytest.mark.parametrize("written", [0, 3, 14])
def test_buffer_continues_where_it_was(written: int):
    """Empty, partly filled and wrapped round: same rows, same next samples, same next writes."""

    def buffer() -> tuple[TensorDictReplayBuffer, BufferState]:
        generator = torch.Generator().manual_seed(1)
        made = TensorDictReplayBuffer(
            storage=LazyTensorStorage(8), batch_size=4, generator=generator
        )
        return made, BufferState(made, generator)

    def transitions(start: int, count: int):
        values = torch.arange(start, start + count)
        return TensorDict({"x": values, "next": {"y": values[:, None] > 2}}, [count])

    (ours, kept), (theirs, restored) = buffer(), buffer()
    for index in range(written):
        ours.extend(transitions(index, 1))
    if written:
        ours.sample()
    restored.load_state_dict(kept.state_dict())
    assert len(ours) == len(theirs) == min(written, 8)
    for each in (ours, theirs):
        each.extend(transitions(100, 3))
    assert (ours[:] == theirs[:]).all()
    assert (ours.sample() == theirs.sample()).all()


def test_buffer_too_small_is_refused():
    ours = TensorDictReplayBuffer(storage=LazyTensorStorage(8), batch_size=1)
    ours.extend(TensorDict({"x": torch.zeros(6)}, [6]))
    small = TensorDictReplayBuffer(storage=LazyTensorStorage(4), batch_size=1)
    with pytest.raises(ValueError, match="buffer_size must be >= 6"):
        BufferState(small).load_state_dict(BufferState(ours).state_dict())


def test_files_return_to_what_they_were(tmp_path: Path):
    early, late = tmp_path / "early.csv", tmp_path / "late.csv"
    early.write_bytes(b"a\r\n1\r\n")
    files = GrowingFiles(early, late)
    state = files.state_dict()
    early.write_bytes(b"a,b\n1,\n2,3\n")  # a new column rewrote the header
    late.write_bytes(b"c\n")
    files.load_state_dict(state)
    assert early.read_bytes() == b"a\r\n1\r\n" and not late.exists()


def test_another_architecture_names_the_parameter_and_the_way_out(run: Path):
    wide = compose(*SMALL, *EMPTY, "algo=rsac", "encoder.width=24")
    with pytest.raises(ValueError) as refused:
        load_agent(wide, run, "checkpoint")
    message = str(refused.value)
    for part in ("actor_network_params", "[16]", "[24]", "more)", "config.yaml", str(run)):
        assert part in message
    with pytest.raises(ValueError, match=r"cost_critic_params.* in the checkpoint and absent here"):
        load_agent(compose(*SMALL, *EMPTY, "algo=sac"), run, "checkpoint")


def test_fitting_counts_differences():
    ours = Fitting(torch.nn.Linear(2, 3), "critic")
    state = torch.nn.Linear(2, 4).state_dict() | {"extra": torch.zeros(1)}
    with pytest.raises(
        ValueError, match=r"another critic: bias is \[4\] .* \[3\] here \(and 2 more"
    ):
        ours.load_state_dict(state)


def test_folders(run: Path, tmp_path: Path):
    point = latest(run)
    assert latest(point) == point
    assert run_folder(run) == run and run_folder(point) == run
    with pytest.raises(FileNotFoundError, match="init: no such file or folder"):
        latest(tmp_path / "none", "init")
    with pytest.raises(FileNotFoundError, match="holds no checkpoint"):
        latest(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"no config\.yaml"):
        run_folder(tmp_path)
    # The configuration of an outer folder is somebody else's.
    (tmp_path / CONFIG).touch()
    (tmp_path / "inner").mkdir()
    with pytest.raises(FileNotFoundError, match=r"no config\.yaml"):
        run_folder(tmp_path / "inner")


def test_a_run_is_newer_than_a_policy_beside_it(run: Path, tmp_path: Path):
    shutil.copytree(run, tmp_path / "run")
    policy = export(run, tmp_path / "policy")
    shutil.copy(policy / EXPORTED, tmp_path / "run")
    assert latest(tmp_path / "run").parent == tmp_path / "run/checkpoints"


def test_export_destroys_nothing(run: Path, tmp_path: Path):
    """Neither the run that it reads nor a policy that is there."""
    before = (run / CONFIG).read_bytes()
    with pytest.raises(ValueError, match=f"out: {run} holds a run or a policy already"):
        export(run, run)
    assert (run / CONFIG).read_bytes() == before and not (run / EXPORTED).exists()
    policy = export(run, tmp_path / "policy")
    with pytest.raises(ValueError, match=f"out: {policy} holds a run or a policy already"):
        export(run, policy)


def test_export_holds_the_networks_alone_and_drives_the_same(run: Path, tmp_path: Path):
    folder = export(run, tmp_path / "shipped" / "gs")
    assert [path.name for path in folder.iterdir()] == [EXPORTED]
    assert str(run).encode() not in (folder / EXPORTED).read_bytes()
    assert progress(folder) == progress(run) == progress(folder / EXPORTED)
    assert run_config(folder) == run_config(folder / EXPORTED)
    again = export(folder, tmp_path / "again") / EXPORTED
    assert policy_state(again).keys() == policy_state(folder / EXPORTED).keys()

    cfg = compose(*SMALL, *EMPTY, "algo=rsac")
    ours, theirs = load_agent(cfg, run, "x"), load_agent(cfg, folder, "x")
    state = theirs.loss.state_dict()
    assert all(
        torch.equal(value, state[key])
        for key, value in ours.loss.state_dict().items()
        if isinstance(value, torch.Tensor)
    )
    assert pretrained_run("gs", root=tmp_path / "shipped") == folder
    with pytest.raises(ValueError, match="pretrained must be one of gs, got 'lt'"):
        pretrained_run("lt", root=tmp_path / "shipped")


def damaged(path: Path, how: str) -> None:
    """Damage a file."""
    data = bytearray(path.read_bytes())
    if how == "cut":
        data = data[:10]
    elif how == "longer":
        data += b"\0"
    elif how == "changed":
        data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("how", "file"),
    [
        *itertools.product(
            ["cut", "longer", "changed", "gone"],
            ["state/*.memmap", "state/meta.json", "state.json", "seal.json"],
        ),
        ("pickle", "state.json"),
    ],
)
def test_a_damaged_file_is_named_and_left_as_it_is(run: Path, tmp_path: Path, how: str, file: str):
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    (part,) = latest(copy).glob("components/*-loss")
    path = max(part.glob(file), key=lambda path: path.stat().st_size)
    if how == "gone":
        path.unlink()
    elif how == "pickle":  # as TensorDict would read it, and with a seal that says so
        path = part / "state/other.pickle"
        path.write_bytes(pickle.dumps("code"))
        (part / "seal.json").write_text(json.dumps(digests(part)))
    else:
        damaged(path, how)
    before = {p: p.read_bytes() for p in copy.rglob("*") if p.is_file()}
    named = "" if path.name == "seal.json" else re.escape(path.name)  # else it names what differs
    with pytest.raises(ValueError, match=f"is damaged: {part.name}/.*{named}"):
        load_agent(run_config(copy), copy, "checkpoint")
    assert before == {p: p.read_bytes() for p in copy.rglob("*") if p.is_file()}


@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.3, 0.5, 0.9, 1.0])
@pytest.mark.parametrize("how", ["cut", "longer", "changed", "zeros"])
def test_a_damaged_policy_is_refused(run: Path, tmp_path: Path, how: str, share: float):
    """Wherever it is damaged: in the sizes, the header with the configuration, or the weights."""
    file = export(run, tmp_path / "policy") / EXPORTED
    data = bytearray(file.read_bytes())
    at = min(int(share * len(data)), len(data) - 1)
    if how == "cut":
        data = data[:at]
    elif how == "longer":
        data += b"\0"
    elif how == "changed":
        data[at] ^= 1
    else:
        data[at : at + 64] = bytes(len(data[at : at + 64]))
    same = data == file.read_bytes()
    file.write_bytes(data)
    if same:
        load_agent(run_config(file), file, "checkpoint")
        return
    with pytest.raises(ValueError, match=r"is damaged|no policy"):
        load_agent(run_config(file), file, "checkpoint")
    assert file.read_bytes() == data


def test_a_file_of_another_kind_is_no_policy(tmp_path: Path):
    (tmp_path / "x.pt").write_bytes(pickle.dumps("code"))
    with pytest.raises(ValueError, match=r"x\.pt is damaged, or no policy"):
        run_config(tmp_path / "x.pt")
    save_file({"x": torch.zeros(1)}, tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match="no policy of saferl: it has no config, counted, sha256"):
        run_config(tmp_path / "other.safetensors")
