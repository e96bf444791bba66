"""Where the time of a whole training goes, and how much memory it takes.

    python benchmarks/training.py [--algos arsac sac_lag] [--task mixed] [--episodes 10000]
        [--set KEY=VALUE ...] [--out DIR] [--json PATH]

Trains each algorithm from nothing on the default settings, changed by ``--set``, in a process of its
own, and prints wall-clock time, peak memory, updates and the success rate of the last 200 training
episodes, with the shares of five phases:

- simulate: steps and resets of the environment;
- act: the policy's forward pass on the states that it drives in;
- project: the correction of risky actions;
- learn: sampling, losses, gradients, optimizer, target networks;
- other: the rest, with the first steps' compiling, storing, transforms, records and checkpoints.

With ``--out`` the runs stay in ``DIR/ALGO``, where ``saferl.evaluate`` can test them.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path

from hydra import compose, initialize_config_dir
from side_by_side import write

from saferl.algorithms.assemble import build_trainer
from saferl.cli.train import claim
from saferl.config.locate import config_dir

PHASES = ("simulate", "act", "project", "learn", "other")


class Stopwatch:
    """Seconds by phase; a phase inside another one is counted once, as its own."""

    def __init__(self):
        self.seconds = dict.fromkeys(PHASES, 0.0)
        self._inner = [0.0]

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        self._inner.append(0.0)
        begin = time.perf_counter()
        try:
            yield
        finally:
            whole = time.perf_counter() - begin
            self.seconds[name] += whole - self._inner.pop()
            self._inner[-1] += whole

    def wrap(self, owner: object, method: str, name: str) -> None:
        """Counts the calls of a bound method."""
        call: Callable = getattr(owner, method)

        def timed(*args, **kwargs):
            with self.phase(name):
                return call(*args, **kwargs)

        setattr(owner, method, timed)


def train(overrides: list[str], out: Path | None) -> dict:
    """One training in this process; its figures."""
    with initialize_config_dir(config_dir(), version_base="1.3"):
        cfg = compose("config", overrides)
    watch, begin = Stopwatch(), time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) if out is None else out
        trainer = build_trainer(cfg, run)
        claim(run, cfg)
        env = trainer.collector.env
        for method in ("_step", "_reset"):
            watch.wrap(env.base_env, method, "simulate")
        watch.wrap(trainer.collector.policy, "forward", "act")
        for transform in env.transform:
            if hasattr(transform, "latencies"):
                watch.wrap(transform, "_inv_call", "project")
        watch.wrap(trainer.learner, "update", "learn")
        watch.wrap(trainer.experience.buffer, "sample", "learn")
        if hasattr(trainer.experience, "begin"):  # of an on-policy algorithm
            watch.wrap(trainer.experience, "begin", "learn")
        trainer.train()
    wall = time.perf_counter() - begin
    watch.seconds["other"] = wall - sum(watch.seconds.values())
    return {
        "wall_s": wall,
        "peak_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "frames": trainer.progress.frames,
        "episodes": trainer.progress.episodes,
        "updates": trainer.progress.updates,
        "updates_per_frame": cfg.learning.updates_per_frame,
        "success": trainer.window.summary()["success_rate"],
        "seconds": watch.seconds,
        "share": {name: seconds / wall for name, seconds in watch.seconds.items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--algos", nargs="+", default=["arsac", "sac_lag"])
    parser.add_argument("--task", default="mixed")
    parser.add_argument("--episodes", type=int, default=10_000)
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path, help="keep the runs below this folder")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()

    result = {}
    print(f"{options.episodes} episodes of {options.task}, load {os.getloadavg()[0]:.1f}")
    print(
        f"{'':10s}{'minutes':>9s}{'peak MB':>9s}{'frames':>9s}{'updates':>9s}{'success':>9s}"
        + "".join(f"{name:>10s}" for name in PHASES)
    )
    for algo in options.algos:
        overrides = [f"algo={algo}", f"task={options.task}", f"episodes={options.episodes}"]
        overrides += ["logger=none", *options.set]
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
            one = process.submit(train, overrides, options.out and options.out / algo).result()
        result[algo] = one
        print(
            f"{algo:10s}{one['wall_s'] / 60:9.1f}{one['peak_MB']:9.0f}{one['frames']:9d}"
            f"{one['updates']:9d}{one['success']:9.1%}"
            + "".join(f"{one['share'][name]:10.1%}" for name in PHASES),
            flush=True,
        )
    write(options.json, result | {"load": os.getloadavg()})


if __name__ == "__main__":
    main()
