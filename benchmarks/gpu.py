"""What one card does, in at most eight minutes and one JSON file.

    python benchmarks/gpu.py OUT [--device cuda] [--small]

Four parts, each a program of its own with its share of the time; one that fails or is not done in time is recorded as
such, with the end of what it said, and the others go on:

- ``simulation``: decisions a second of the batched road, eager and compiled (``simulation.py``);
- ``update``: updates a second, compiled ones replayed as CUDA graphs (``update.py``), at widths of 64 and 256;
- ``safe``: how far ARSAC and its tests come in two minutes (``time_to_safe.py``);
- ``paper``: one update for each frame, as the paper's text suggests, in sixteen environments: what it had learned when its
  time was over, and how long 10,000 episodes would take.

``--small --device cpu`` tries all parts in a small form. OUT gets ``gpu.json`` and what the parts wrote.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from side_by_side import write

from saferl.training.records import CsvLog

HERE = Path(__file__).parent


def parts(out: Path, device: str, small: bool) -> dict[str, tuple[float, list[str]]]:
    """Seconds and command of each."""
    rounds = ["--rounds", "1" if small else "3", "--seconds", "0.2" if small else "1"]
    on = ["--device", device]
    updates = {
        f"update_{width}": (
            60.0,
            ["update.py", *on, *rounds, "--width", width, "--json", f"{out}/update_{width}.json"],
        )
        for width in (["16"] if small else ["64", "256"])
    }
    batches = ["8"] if small else ["1024", "8192"]
    few = ["env.num_envs=16", "learning.warmup_frames=64", "compile=false"] if small else []
    run = [f"device={device}", "logger=none", "save_minutes=null", "threads=1"]
    return {
        "simulation": (
            100.0,
            [
                *("simulation.py", *on, *rounds, "--batches", *batches),
                *("--json", f"{out}/simulation.json"),
            ],
        ),
        **updates,
        "safe": (
            170.0,
            [
                *("time_to_safe.py", f"{out}/safe", "--jobs", "1", "--json", f"{out}/safe.json"),
                *("--minutes", "0.1" if small else "2", "--every", "0.05" if small else "0.5"),
                *("--episodes", "4" if small else "500", "--set", f"device={device}", *few),
            ],
        ),
        "paper": (
            10.0 if small else 80.0,
            [
                *("-m", "saferl", "algo=arsac", "task=mixed", "episodes=10000"),
                *(
                    "learning.updates_per_frame=1",
                    "env.num_envs=16",
                    "record_every=500",
                    *run,
                    *few,
                ),
                f"out={out}/paper",
            ],
        ),
    }


def perform(seconds: float, command: list[str]) -> dict[str, Any]:
    """Runs a part; how it ended, after how long, and the last that it said."""
    if command[0] != "-m":
        command = [str(HERE / command[0]), *command[1:]]
    begin = time.perf_counter()
    child = subprocess.Popen(
        [sys.executable, *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    try:
        said, _ = child.communicate(timeout=seconds)
        ended = "done" if child.returncode == 0 else f"failed ({child.returncode})"
    except subprocess.TimeoutExpired:
        os.killpg(child.pid, signal.SIGKILL)
        said, _ = child.communicate()
        ended = f"stopped after {seconds:.0f} s"
    lines = said.replace("\r", "\n").splitlines()
    return {"ended": ended, "seconds": time.perf_counter() - begin, "said": lines[-40:]}


def progress(run: Path) -> dict[str, float]:
    """The last rows of a run that was stopped, and what 10,000 episodes would take."""
    metrics, timings = (CsvLog(run / f"{name}.csv").read() for name in ("metrics", "timing"))
    if not metrics or not timings:
        return {}
    last, timing = metrics[-1], timings[-1]
    seconds = timing["collect"] + timing["learn"] + timing["other"]
    return {
        **last,
        "seconds": seconds,
        "updates_per_second": timing["updates"] / seconds,
        "minutes_for_10000_episodes": 1e4 / max(last["episodes"], 1.0) * seconds / 60,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda")
    parser.add_argument("--small", action="store_true")
    options = parser.parse_args()
    if options.out.exists():
        raise SystemExit(
            f"{options.out} exists: name another folder, as in make gpu OUT=runs/gpu2."
        )
    options.out.mkdir(parents=True)
    figures: dict[str, Any] = {"device": options.device, "small": options.small}
    for name, (seconds, command) in parts(options.out, options.device, options.small).items():
        # A CPU compiles where a card's parts have long begun.
        figures[name] = perform(4 * seconds if options.small else seconds, command)
        print(f"{name}: {figures[name]['ended']}, {figures[name]['seconds']:.0f} s", flush=True)
        file = options.out / f"{name}.json"
        if file.exists():
            figures[name]["figures"] = json.loads(file.read_text())
        elif name == "paper" and (options.out / "paper" / "timing.csv").exists():
            figures[name]["figures"] = progress(options.out / "paper")
        write(options.out / "gpu.json", figures)  # after each part, so that nothing is lost


if __name__ == "__main__":
    main()
