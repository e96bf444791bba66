"""A ``_target_`` that makes something else than its place needs is refused in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf
from small import EMPTY, SMALL, compose

from saferl.algorithms.assemble import build_trainer
from saferl.algorithms.parts import make
from saferl.cli.errors import MISTAKES, explain
from saferl.config.check import PARTS, check_targets
from saferl.config.locate import config_dir
from saferl.modules import MLP

#: Where a node stands in a composition, by what it makes.
PLACES = {name.rpartition(".")[2]: name for name in PARTS}
PLACES |= {"risk": "loss.risk", "reward": "task.reward", "cost": "task.cost"}
PLACES |= {"activation": "encoder.activation"}
#: Parts of a part that not every composition has, and what is Hydra's.
WITHIN = ("prediction", "fallbacks", "hydra")


def targets() -> dict[str, set[str]]:
    """Every ``_target_`` in conf/, by what it makes."""
    found: dict[str, set[str]] = {}

    def walk(node: Any, makes: str) -> None:
        for key, value in node.items() if isinstance(node, dict) else ():
            if key not in WITHIN:
                walk(value, key)
        for each in node if isinstance(node, list) else ():
            walk(each, makes)
        if isinstance(node, dict) and node.get("_target_"):
            found.setdefault(makes, set()).add(node["_target_"])

    for file in sorted(Path(config_dir()).glob("*/*.yaml")):
        walk(OmegaConf.to_container(OmegaConf.load(file)), file.parent.name)
    return found


TARGETS = targets()
PAIRS = [
    (place, target)
    for makes, place in PLACES.items()
    for other, names in TARGETS.items()
    for target in sorted(names)
    if makes != other
]


@pytest.fixture(scope="module")
def whole() -> DictConfig:
    """A composition that has every part."""
    cfg = compose(*SMALL, *EMPTY, "algo=arsac", "encoder=mlp")
    OmegaConf.resolve(cfg)
    OmegaConf.set_struct(cfg, False)
    return cfg


def refusal(cfg: DictConfig, place: str, node: Any, folder: Path) -> str:
    """The line with which a composition is refused that has this node at a place."""
    cfg = cfg.copy()
    if place == "logger.sinks":
        cfg.logger.sinks = [node]
    else:
        OmegaConf.update(cfg, place, node, merge=False, force_add=True)
    with pytest.raises(MISTAKES) as error:
        build_trainer(cfg, folder).open_loggers()
    line = explain(error.value)
    assert "\n" not in line
    return line


def test_there_are_many():
    assert set(TARGETS) == set(PLACES) and len(PAIRS) > 300


@pytest.mark.parametrize(("place", "target"), PAIRS)
def test_a_part_of_another_kind_is_refused(place: str, target: str, whole, tmp_path: Path):
    key, node = "_target_", {"_target_": target}
    if target == "hydra.utils.get_class":
        key, node = "path", node | {"path": "torch.nn.GELU"}
    line = refusal(whole, place, node, tmp_path)
    if place == "loss.risk":  # which may be any function, and is tried
        assert "risk" in line
    else:
        place = place.replace("sinks", "sinks[0]")
        assert line.startswith(f"{place}.{key} must name ") and line.endswith(f"got {node[key]!r}.")


@pytest.mark.parametrize("target", ["os.getcwd", "builtins.dict", "nobody.Knows", 3])
@pytest.mark.parametrize("place", [*PARTS, "loss.risk"])
def test_what_is_no_part_is_refused(place: str, target: Any, whole, tmp_path: Path):
    line = refusal(whole, place, {"_target_": target, "num_envs": 2}, tmp_path)
    assert place.rpartition(".")[2] in line


@pytest.mark.parametrize("path", ["builtins.int", "torch.relu", "nobody.Knows", None])
def test_an_activation_is_a_class_of_modules(path: str | None, whole, tmp_path: Path):
    node = {"_target_": "hydra.utils.get_class"} | ({"path": path} if path else {})
    assert "encoder.activation.path " in refusal(whole, "encoder.activation", node, tmp_path)


def test_kinds_of_ones_own():
    """A function is of the kind that it says it makes; one that says nothing is looked at when it has made it."""
    for name in ("said", "unsaid"):
        node = OmegaConf.create({"encoder": {"_target_": f"{__name__}.{name}"}})
        with pytest.raises(ValueError, match=r"encoder._target_ must name a kind of Encoder, got"):
            check_targets(node)
            make(node.encoder)
    right = OmegaConf.create({"encoder": {"_target_": f"{__name__}.right"}})
    check_targets(right)
    assert make(right.encoder).width == 8


def said() -> int:
    return 3


def unsaid():
    return 3


def right():
    return MLP(width=8)
