"""Every leaf of a composed configuration reaches what is built or run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict
from small import EMPTY, SMALL, compose

from saferl.algorithms import assemble
from saferl.cli.train import closing_test
from saferl.config.check import check
from saferl.config.limits import readers
from saferl.config.locate import config_dir

ALGOS = sorted(path.stem for path in (Path(config_dir()) / "algo").glob("*.yaml"))
LIMITS = ("cost_limit=1", "risk_limit=1")
#: A road's own encoder reads no plain observation.
TASKS = {
    "batched": ("task=mixed", *EMPTY, "evaluation.drivers=[blind]", "task.duration=3"),
    "highway": ("task=gs", "env=highway", "task.vehicles=0", "task.duration=3"),
    "cart": ("task=cart", "encoder=mlp", *LIMITS),
    "gym": ("task=gym", "task.id=Pendulum-v1", "task.cost_key=null", "encoder=mlp", *LIMITS),
}
#: One of either family, on every task; the others on one.
FEW = ("rsac", "ppo_lag")
#: Read before a run is built: by Hydra, for its folder, and by the command.
EARLIER = {"out", "resume"}


def leaves(node: Any, path: str = "") -> Iterator[tuple[Any, Any, str]]:
    """The nodes, keys and full names of all settings; an empty list has none."""
    for key in range(len(node)) if isinstance(node, ListConfig) else node:
        name = f"{path}{key}"
        value = node._get_node(key)
        if (
            isinstance(value, (DictConfig, ListConfig))
            and not value._is_none()
            and not value._is_interpolation()
        ):
            yield from leaves(value, f"{name}.")
        elif not str(key).startswith("_"):
            yield node, key, name


def watched(cfg: DictConfig) -> tuple[set[str], set[str]]:
    """Replace each leaf by one that says when it is read; all names, and those that were read."""
    values: dict[str, Any] = {}
    seen: set[str] = set()

    def read(name: str, *value: Any) -> Any:
        seen.add(name)
        return value[0] if value else values[name]

    OmegaConf.register_new_resolver("read", read, replace=True)
    found = list(leaves(cfg))
    for node, key, name in found:
        values[name] = node._get_node(key)._value()
    OmegaConf.set_readonly(cfg, False)
    with open_dict(cfg):
        for node, key, name in found:
            follows = OmegaConf.is_interpolation(node, key)
            value = f",{values[name]}" if follows else ""
            node._set_item_impl(key, f"${{read:'{name}'{value}}}")
    return set(values), seen


@pytest.mark.parametrize(
    ("algo", "task"),
    [
        pytest.param(algo, task, marks=[] if task == "batched" or algo in FEW else pytest.mark.slow)
        for algo in ALGOS
        for task in TASKS
    ],
)
def test_every_leaf_is_read_by_a_training(
    algo: str, task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    cfg = compose(*SMALL, f"algo={algo}", *TASKS[task])
    if task in ("cart", "gym") and cfg.task.get("reward"):
        pytest.skip("refused: a shaped reward is the road's")
    unread = {name for name, keys in readers(cfg).items() if not keys} - {"cost_limit"}
    task_of_this = assemble.complete(cfg.task)
    check(cfg)
    names, seen = watched(cfg)
    assert not seen
    # What has been checked reads everything, and so shows nothing.
    monkeypatch.setattr(assemble, "complete", lambda node: task_of_this)
    monkeypatch.setattr(assemble, "check", lambda cfg: None)
    monkeypatch.setattr(assemble, "order_limits", lambda cfg, costs: None)
    trainer = assemble.build_trainer(cfg, tmp_path)
    trainer.train()
    closing_test(cfg, tmp_path)
    assert names - seen == EARLIER | unread
    assert trainer.progress.frames >= 12 and trainer.progress.updates >= 3
    assert (tmp_path / "metrics.csv").read_text().count("\n") >= 2
