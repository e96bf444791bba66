"""Files that somebody else wrote: they run no code and write nowhere."""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from small import SMALL, compose

import saferl
from saferl.algorithms.assemble import build_trainer
from saferl.checkpoint.run import CONFIG, run_config
from saferl.checkpoint.sealed import digests
from saferl.config.foreign import check_origin

ROOT = Path(saferl.__file__).parents[1]


@pytest.fixture(scope="module")
def theirs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("theirs")
    cfg = compose(*SMALL, "algo=rsac", "task=cart", "risk_limit=1")
    build_trainer(cfg, folder).train()
    OmegaConf.save(cfg, folder / CONFIG, resolve=True)
    return folder


EVIL = [
    ("loss._target_", "os.system"),
    ("encoder._target_", "subprocess.run"),
    ("encoder._target_", "builtins.exec"),
    ("encoder._target_", "builtins.open"),
    ("encoder.activation.path", "os.system"),
    ("encoder.activation._target_", "hydra.utils.instantiate"),
    ("risk._target_", "torch.load"),
    ("risk._target_", "torch.hub.load"),
    ("risk._target_", "saferl.checkpoint.run.export"),
    ("risk._target_", "saferl.modules.lagrange.torch.hub.load"),
    ("risk._target_", "saferl.envs.gym.importlib.import_module"),
    ("projector._target_", "shutil.rmtree"),
    ("task._target_", "numpy.load"),
    ("env._target_", "hydra._internal.utils._locate"),
    ("lagrange.signal._target_", "own_module.os.system"),
    ("learning._target_", ["os.system"]),
    ("learning._target_", {"path": "os.system"}),
    ("encoder.activation", "${oc.create:{_target_: torch.hub.load}}"),
    ("task.noise", "${oc.env:HOME}"),
    ("risk", {"_target_": "hydra.utils.get_method", "_args_": ["os.abort"]}),
    ("encoder.activation", {"_target_": "hydra.utils.get_class", "_args_": ["antigravity.X"]}),
    ("logger.sinks", [{"_target_": "torchrl.record.loggers.CSVLogger", "exp_name": "${init}"}]),
    ("task.id", "antigravity:X-v0"),
    ("task.id", "their_folder.evil:X-v0"),
    ("task.id", "policy.evil:X-v0"),
    ("algo_name", "../../x"),
    ("algo_name", ".."),
    ("task.task", "."),
    ("projector.name", "x/../../escaped"),
    ("task.task", "../x"),
    ("logger.sinks", [{"_target_": "os.system", "command": "x"}]),
    ("logger.sinks", [{"_target_": "torchrl.record.loggers.CSVLogger", "exp_name": "../../x"}]),
]


@pytest.mark.parametrize(("name", "value"), EVIL)
@pytest.mark.parametrize("option", ["checkpoint", "init", "resume"])
def test_a_configuration_names_parts_alone(
    name: str, value, option: str, theirs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "own_module.py").write_text("import os\n\n\nclass Part:\n    pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_module", raising=False)
    cfg = OmegaConf.load(theirs / CONFIG)
    OmegaConf.update(cfg, name, value, force_add=True)
    (tmp_path / "policy").mkdir()
    for folder in ("policy", "their_folder"):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / "evil.py").write_text("raise SystemExit('it ran')\n")
    OmegaConf.save(cfg, tmp_path / "policy" / CONFIG)
    with pytest.raises(ValueError, match=r"may not|must be a name without"):
        run_config(tmp_path / "policy", option)


@pytest.mark.parametrize(
    ("text", "reason"),
    [("a: [1", "cannot be read"), ("3", "holds no settings"), ("task: 3", "must be a mapping")],
)
def test_a_configuration_that_is_none_is_refused(text: str, reason: str, tmp_path: Path):
    (tmp_path / CONFIG).write_text(text)
    with pytest.raises(ValueError, match=reason):
        run_config(tmp_path)


def test_modules_beside_a_file_are_its_authors(
    theirs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "their_parts.py").write_text("raise SystemExit('it ran')\n")
    monkeypatch.syspath_prepend(tmp_path)
    cfg = OmegaConf.load(theirs / CONFIG)
    cfg.risk._target_ = "their_parts.Part"
    OmegaConf.save(cfg, tmp_path / CONFIG)
    with pytest.raises(ValueError, match="may not call"):
        run_config(tmp_path)


@pytest.mark.parametrize("name", ["task.id", "risk._target_"])
def test_a_package_around_a_file_is_its_authors(
    name: str, theirs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """An archive that brings a package with a run in it."""
    (tmp_path / "their_pack/run").mkdir(parents=True)
    for file in ("__init__.py", "evil.py"):
        (tmp_path / "their_pack" / file).write_text("raise SystemExit('it ran')\n")
    monkeypatch.syspath_prepend(tmp_path)
    cfg = OmegaConf.load(theirs / CONFIG)
    value = "their_pack.evil:Part-v0" if name == "task.id" else "their_pack.evil.Part"
    OmegaConf.update(cfg, name, value, force_add=True)
    OmegaConf.save(cfg, tmp_path / "their_pack/run" / CONFIG)
    with pytest.raises(ValueError, match="which a file may not"):
        run_config(tmp_path / "their_pack/run")


def test_a_run_whose_files_are_links_does_not_go_on(theirs: Path, tmp_path: Path, refusal):
    shutil.copytree(theirs, tmp_path / "run")
    (tmp_path / "mine").write_text("precious")
    (tmp_path / "run/metrics.csv").unlink()
    (tmp_path / "run/metrics.csv").symlink_to(tmp_path / "mine")
    assert "is a link" in refusal("train", "config", "resume=run", "frames=48")
    assert (tmp_path / "mine").read_text() == "precious"


def test_ones_own_parts_may_be_named(theirs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "own_parts.py").write_text("class Part:\n    pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert run_config(theirs).algo_name == "rsac"
    cfg = OmegaConf.load(theirs / CONFIG)
    (tmp_path / "run").mkdir()
    for target in ("own_parts.Part", "own_parts.Missing", "packaging.version.Version"):
        cfg.risk._target_ = target
        OmegaConf.save(cfg, tmp_path / "run" / CONFIG)
        monkeypatch.setenv("SAFERL_TRUST", "other,packaging")
        assert run_config(tmp_path / "run").risk._target_ == target
    monkeypatch.delenv("SAFERL_TRUST")
    with pytest.raises(ValueError, match="SAFERL_TRUST=package"):
        run_config(tmp_path / "run")


@pytest.mark.parametrize("option", ["checkpoint", "init", "resume"])
def test_a_part_of_another_kind_is_told(option: str, theirs: Path, tmp_path: Path, refusal):
    shutil.copytree(theirs, tmp_path / "run")
    cfg = OmegaConf.load(tmp_path / "run" / CONFIG)
    OmegaConf.update(cfg, "encoder", {"_target_": "saferl.modules.CVaR"}, merge=False)
    OmegaConf.save(cfg, tmp_path / "run" / CONFIG)
    command = ("evaluate", "evaluate") if option == "checkpoint" else ("train", "config")
    options = () if option != "init" else (*SMALL, "algo=rsac", "task=cart", "risk_limit=1")
    line = refusal(*command, *options, f"{option}=run")
    assert line.startswith("error: encoder._target_ must name a kind of Encoder, got ")


def test_whatever_a_run_may_be_made_of_may_stand_in_its_file():
    """Each class that our own configurations name, as a run that cannot be taken up again would be lost."""
    found = {}
    for path in (ROOT / "conf").glob("*/*.yaml"):
        if path.parent.name not in ("hydra", "experiment"):
            named = re.findall(
                r"(?:_target_|path): (\w+\.[\w.]+)", path.read_text(encoding="utf-8")
            )
            found |= dict.fromkeys(named, path)
    assert len(found) > 40
    for target, path in found.items():
        check_origin({"part": {"_target_": target}}, path)


def test_a_checkpoint_makes_no_file_longer(theirs: Path, tmp_path: Path):
    """Whose structure says more than a tensor's file holds, with a seal of its own, or whose file lies elsewhere."""
    shutil.copytree(theirs, tmp_path / "run")
    (state,) = tmp_path.glob("run/checkpoints/*/components/*-loss/state")
    name, about = next(
        (k, v)
        for k, v in json.loads((state / "meta.json").read_text()).items()
        if k.startswith("tensor")
    )
    file = state / f"{name}.memmap"
    precious = tmp_path / "precious"
    precious.write_bytes(file.read_bytes())
    meta = json.loads((state / "meta.json").read_text())
    meta[name] = {**about, "shape": [5000]}
    (state / "meta.json").write_text(json.dumps(meta))

    def refused(reason: str) -> None:
        (state.parent / "seal.json").write_text(json.dumps(digests(state.parent)))
        with pytest.raises(ValueError, match=reason):
            saferl.load_policy(tmp_path / "run")

    before = file.read_bytes()
    refused("does not hold what meta.json says")
    assert file.read_bytes() == before
    file.unlink()
    file.symlink_to(precious)
    refused("is a link")
    assert precious.read_bytes() == before
