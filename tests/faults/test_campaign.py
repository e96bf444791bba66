"""Trainings to which something happens: killed, without room, without their folder, told to stop while they save.

Each is a child of this process, forked, so that hundreds of them need no imports; half of its time goes into small files, which
a disk in memory spares (``--basetemp=/dev/shm/faults``). What is promised: none hangs, none loses a good checkpoint, none shows a
bare trace, and a run that can go on ends as if nothing had happened, bit for bit.
"""

from __future__ import annotations

import fcntl
import functools
import os
import random
import re
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from small import SMALL, fitting

from saferl.checkpoint import sealed
from saferl.checkpoint.run import FOLDER, begun, latest
from saferl.cli import train  # noqa: F401  the children's, who import nothing
from saferl.cli.launch import launch

pytestmark = pytest.mark.slow

#: Where to read what a child says, and the folder to keep it in.
_OUTPUT: dict[int, tuple[int, Path]] = {}
LIMIT = 120  # seconds after which a child hangs
PROJECTOR = ("projector.start=0", "projector.steps=3", "risk_limit=0", "task.duration=2")
OFF = (*SMALL, "algo=rsac", "task.vehicles=3", *PROJECTOR, "frames=64", "save_every=8")
ON = (*SMALL, "algo=arppo", "task.vehicles=3", *PROJECTOR, "frames=64", "save_every=8")
BACKENDS = {"batched": (), "highway": ("env=highway",)}
RUNS = {
    f"{name} {backend}": (*options, *extra)
    for name, options in (("off-policy", OFF), ("on-policy", ON))
    for backend, extra in BACKENDS.items()
}


def begin(folder: Path, arguments: Sequence[str], sabotage: Callable[[], object] = int) -> int:
    """A child that runs a training in a folder, after ``sabotage``; its output goes to ``folder/said``."""
    folder.mkdir(parents=True, exist_ok=True)
    reading, writing = os.pipe()  # a file would be among those that may not grow
    fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, 2**20)
    if (child := os.fork()) != 0:
        os.close(writing)
        _OUTPUT[child] = reading, folder
        return child
    status = 70
    try:
        os.chdir(folder)
        os.dup2(writing, 1)
        os.dup2(writing, 2)
        torch.set_num_threads(1)
        random.seed(0)  # which a process of its own has from the system, and no run uses
        np.random.seed(0)
        sys.argv = ["saferl", *fitting(arguments)]
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.default_int_handler)
        sabotage()
        launch("train", "config")
        status = 0
    except SystemExit as end:
        if isinstance(end.code, str):
            os.write(2, f"{end.code}\n".encode())
        status = end.code if isinstance(end.code, int) else 1
    except BaseException:
        import traceback

        os.write(2, traceback.format_exc().encode())
    finally:
        os._exit(status)


def ended(child: int) -> int:
    """The exit status of a child, negative for a signal; fails where it hangs."""
    until = time.monotonic() + LIMIT
    while time.monotonic() < until:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            reading, folder = _OUTPUT.pop(child)
            with open(reading, "rb") as output, (folder / "said").open("ab") as file:
                os.set_blocking(reading, False)  # what it left behind may still hold the other end
                file.write(output.read() or b"")
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    pytest.fail("it hangs")


def said(folder: Path) -> str:
    text = (folder / "said").read_text(errors="replace") if (folder / "said").exists() else ""
    assert "Traceback" not in text, text[-3000:]
    return text


def finish(folder: Path, arguments: Sequence[str]) -> None:
    """Continue the run in ``folder/run`` to its end, or begin it where nothing is there to continue."""
    run = folder / "run"
    if begun(run):
        arguments = ["resume=run"]
    else:
        shutil.rmtree(run, ignore_errors=True)
        arguments = [*arguments, "out=run"]
    assert ended(begin(folder, arguments)) == 0, said(folder)


def result(run: Path) -> dict[str, bytes]:
    """What a run left, but for its wall-clock, its configuration's place and its logs."""
    found = {name: (run / name).read_bytes() for name in ("metrics.csv", "evaluation/episodes.csv")}
    for path in sorted(latest(run).rglob("*")):
        name = path.relative_to(run).as_posix()
        if path.is_file() and "-clock/" not in name and "-files/" not in name:
            found[name] = path.read_bytes()
    return {k: v for k, v in found.items() if not k.endswith(("manifest.json", "seal.json"))}


@pytest.fixture(scope="module")
def untouched(tmp_path_factory: pytest.TempPathFactory):
    """What a kind of run leaves when nothing happens to it, and the seconds that it takes."""

    @functools.cache
    def play(name: str) -> tuple[dict[str, bytes], float]:
        folder, began = tmp_path_factory.mktemp("untouched"), time.monotonic()
        assert ended(begin(folder, (*RUNS[name], "out=run"))) == 0, said(folder)
        return result(folder / "run"), time.monotonic() - began

    return play


def at_save(number: int, action: Callable[[], object]) -> Callable[[], None]:
    """A saboteur: something happens at the n-th part of a checkpoint that is written."""

    def sabotage() -> None:
        count, save = [0], sealed.Sealed.save

        def counting(self, *args, **kwargs):
            count[0] += 1
            if count[0] == number:
                action()
            return save(self, *args, **kwargs)

        sealed.Sealed.save = counting

    return sabotage


@pytest.mark.parametrize("name", RUNS)
def test_kills_at_random_moments(name: str, untouched, tmp_path: Path):
    """Twenty times, each run killed once or more, and then continued."""
    arguments, (expected, seconds) = RUNS[name], untouched(name)
    draw = random.Random(0)
    for number in range(20):
        folder = tmp_path / str(number)
        child = begin(folder, (*arguments, "out=run"))
        time.sleep(draw.uniform(0.1, seconds))
        os.kill(child, signal.SIGKILL)
        ended(child)
        if begun(folder / "run") and draw.random() < 0.5:  # and once more
            child = begin(folder, ["resume=run"])
            time.sleep(draw.uniform(0.1, seconds))
            os.kill(child, signal.SIGKILL)
            ended(child)
        finish(folder, arguments)
        assert result(folder / "run") == expected, number
        said(folder)
        shutil.rmtree(folder)


@pytest.mark.parametrize("number", [1, 2, 3, 9, 13, 14, 20, 27, 40, 55])
@pytest.mark.parametrize("blow", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_signals_in_the_middle_of_a_save(
    blow: signal.Signals, number: int, untouched, tmp_path: Path
):
    arguments = RUNS["off-policy batched"]
    strike = at_save(number, lambda: os.kill(os.getpid(), blow))
    status = ended(begin(tmp_path, (*arguments, "out=run"), strike))
    assert status == (-9 if blow == signal.SIGKILL else 130), said(tmp_path)
    finish(tmp_path, arguments)
    assert result(tmp_path / "run") == untouched("off-policy batched")[0]


@pytest.mark.parametrize("size", [0, 1, 100, 1000, 4000, 10_000, 30_000, 60_000, 100_000, 200_000])
def test_no_room_on_the_disk(size: int, untouched, tmp_path: Path):
    """No file may grow beyond a size: one line, the last good checkpoint stays, and with room the run goes on."""
    arguments = RUNS["off-policy batched"]

    def cramped() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        # After the first checkpoint, so that there is something to lose.
        at_save(30, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)))()

    status = ended(begin(tmp_path, (*arguments, "out=run"), cramped))
    text = said(tmp_path)
    assert status == 0 or (status == 1 and re.search("error: .*(checkpoint|csv|run/)", text)), text
    if status:
        assert latest(tmp_path / "run").exists()
    finish(tmp_path, arguments)
    assert result(tmp_path / "run") == untouched("off-policy batched")[0]


@pytest.mark.parametrize("number", [1, 2, 5, 12, 13, 18, 25, 30, 44, 60])
def test_a_folder_that_vanishes(number: int, tmp_path: Path):
    """The run is lost with its folder, and says so."""
    arguments = RUNS["off-policy batched"]
    gone = at_save(number, lambda: shutil.rmtree("run"))
    status = ended(begin(tmp_path, (*arguments, "out=run"), gone))
    text = said(tmp_path)
    assert status == 1 and re.search(r"error: \S+ was moved or deleted", text), text


@pytest.mark.parametrize("moment", range(10))
def test_a_second_process(moment: int, untouched, tmp_path: Path):
    """It is refused while the first works, which ends as if alone."""
    arguments = RUNS["off-policy batched"]
    first = begin(tmp_path, (*arguments, "out=run"))
    while not (tmp_path / "run" / FOLDER).is_dir():
        time.sleep(0.005)
    time.sleep(0.02 * moment)
    second = ["resume=run"] if moment % 2 else [*arguments, "out=run"]
    (tmp_path / "other").mkdir()
    (tmp_path / "other/run").symlink_to(tmp_path / "run")
    assert ended(begin(tmp_path / "other", second)) == 1
    assert "works on" in said(tmp_path / "other") or "holds a run already" in said(
        tmp_path / "other"
    )
    assert ended(first) == 0, said(tmp_path)
    assert result(tmp_path / "run") == untouched("off-policy batched")[0]


@pytest.mark.parametrize("jump", [-1e9, -3600, -60, -1, 0, 1, 60, 3600, 1e9, "back and forth"])
def test_a_clock_that_jumps(jump, untouched, tmp_path: Path):
    """What is learned does not depend on the clock."""
    arguments = RUNS["off-policy batched"]
    now, calls = time.time, [0]

    def jumping() -> float:
        calls[0] += 1
        by = (-1) ** calls[0] * 1e6 if isinstance(jump, str) else jump * (calls[0] > 5)
        return now() + by

    def sabotage() -> None:
        time.time = jumping

    assert ended(begin(tmp_path, (*arguments, "out=run"), sabotage)) == 0, said(tmp_path)
    assert result(tmp_path / "run") == untouched("off-policy batched")[0]


def test_a_folder_that_may_not_be_written(tmp_path: Path):
    """Refused before anything starts; as root may write everywhere, the folder is a file or lies below one."""
    arguments = RUNS["off-policy batched"]
    (tmp_path / "file").write_text("mine")
    for out in ("file", "file/run", "file/a/b", "/proc/run", "/proc/1/run"):
        status = ended(begin(tmp_path, (*arguments, f"out={out}")))
        assert status == 1, out
        assert "error: " in said(tmp_path), out
    assert (tmp_path / "file").read_text() == "mine"
