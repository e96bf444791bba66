"""A checkpoint whose files were altered is refused in words, or loads what was written."""

from __future__ import annotations

import random
import shutil
from collections import Counter
from pathlib import Path

import pytest
from small import SMALL, compose

from saferl.algorithms.assemble import build_trainer
from saferl.checkpoint.run import latest
from saferl.checkpoint.sealed import digests
from saferl.training.trainer import Trainer

MUTATIONS = (
    "flip",
    "burst",
    "cut",
    "empty",
    "longer",
    "swap",
    "gone",
    "digit",
    "other name",
    "stranger",
)


@pytest.fixture(scope="module")
def trainer(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    trainer = build_trainer(
        compose(*SMALL, "algo=sac_lag", "task=cart", "cost_limit=1"), tmp_path_factory.mktemp("run")
    )
    trainer.train()
    return trainer


def written(trainer: Trainer, folder: Path) -> dict[str, list]:
    """What a trainer's state is in files, but for what names this very write."""
    shutil.rmtree(folder, ignore_errors=True)
    trainer.checkpoint.checkpoint.save(folder)
    files = digests(folder)
    return {name: value for name, value in files.items() if name != "manifest.json"}


def alter(folder: Path, how: str, chance: random.Random) -> str:
    """Alter one file of a checkpoint; returns its name."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    # Of its many small tensors few decide: one in three is a file of words.
    words = [path for path in files if path.suffix == ".json"]
    path = chance.choice(words if how == "digit" or chance.random() < 0.33 else files)
    data = bytearray(path.read_bytes())
    place = chance.randrange(len(data)) if data else 0
    if how == "flip" and data:
        data[place] ^= 1 << chance.randrange(8)
    elif how == "burst":
        data[place : place + 64] = chance.randbytes(len(data[place : place + 64]))
    elif how == "cut":
        del data[place:]
    elif how == "empty":
        data.clear()
    elif how == "longer":
        data += chance.randbytes(chance.randrange(1, 100))
    elif how == "swap":
        other = chance.choice(files)
        data[:], other_data = other.read_bytes(), bytes(data)
        other.write_bytes(other_data)
    elif how == "digit":
        digits = [i for i, byte in enumerate(data) if chr(byte).isdigit()]
        data[chance.choice(digits or [0])] = ord(chance.choice("0123456789"))
    if how == "gone":
        path.unlink()
    elif how == "other name":
        path.rename(path.with_name(chance.choice(["other", path.name + "x", "x" + path.name])))
    elif how == "stranger":
        path.with_name(
            chance.choice(["x.pickle", "x.pkl", "x.pt", "meta.json.pt", "data.bin"])
        ).write_bytes(data)
    else:
        path.write_bytes(data)
    return path.relative_to(folder).as_posix()


@pytest.mark.parametrize("count", [30, pytest.param(1000, marks=pytest.mark.slow)])
def test_each_alteration_is_refused_or_changes_nothing(
    trainer: Trainer, tmp_path: Path, count: int
):
    trainer.resume()
    good, kept = latest(trainer.run), tmp_path / "kept"
    shutil.copytree(good, kept)
    expected, outcomes = written(trainer, tmp_path / "state"), Counter()
    for number in range(count):
        chance, how = random.Random(number), MUTATIONS[number % len(MUTATIONS)]
        shutil.rmtree(good)
        shutil.copytree(kept, good)
        name = alter(good, how, chance)
        before = digests(good)
        try:
            trainer.resume()
        except (ValueError, FileNotFoundError) as error:
            outcomes["refused"] += 1
            assert "checkpoint" in str(error) and "\n" not in str(error), (number, how, name)
        else:
            outcomes["loaded equal"] += 1
            assert written(trainer, tmp_path / "state") == expected, (number, how, name)
        # Whoever looks at a damaged file does not change it.
        assert digests(good) == before, (number, how, name)
    shutil.rmtree(good)
    shutil.copytree(kept, good)
    print(dict(outcomes))
    assert outcomes["refused"] > 0.7 * count
