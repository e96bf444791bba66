"""Frames a second of one process and of workers, in turns, and what each process does for a frame.

    python benchmarks/workers.py [--backends batched highway] [--workers 1 2] [--set KEY=VALUE ...]
        [--rounds 5] [--seconds 3] [--json PATH]

Experience is collected as in training by a policy that is told before each batch, without updates. Beside the
rates on the wall clock stand the processor's milliseconds for 1,000 frames, of the learner's process and of the busiest
worker: what the rates would be if each process had a core of its own is their sum's inverse, as a learner and its
workers wait for each other. The last lines say what passes between them.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

from hydra import compose, initialize_config_dir
from side_by_side import alternate, conditions, medians, parser, write

from saferl.algorithms.assemble import build_trainer
from saferl.config.locate import config_dir

#: Of each backend; highway-env is slow, and a few of its environments fill a batch.
BACKENDS = {
    "batched": ("env=batched", "env.num_envs=256"),
    "highway": ("env=highway", "env.num_envs=16"),
}


def spent(process: int) -> float:
    """Seconds of a processor that a process has used."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Side:
    """One way to collect, which counts what it costs."""

    def __init__(self, overrides: list[str], folder: Path):
        with initialize_config_dir(config_dir(), version_base="1.3"):
            cfg = compose("config", overrides)
        self.trainer = build_trainer(cfg, folder)
        self.batches = iter(self.trainer.collector)
        self.data = next(self.batches)
        crew = getattr(self.trainer.collector, "collector", None)
        self.processes = [process.pid for process in crew.procs] if crew is not None else []
        self.frames, self.learner = 0, 0.0
        self.begin = [spent(process) for process in self.processes]

    def work(self) -> int:
        begin = time.process_time()
        self.data = next(self.batches)
        self.learner += time.process_time() - begin
        self.frames += self.data.numel()
        return self.data.numel()

    def costs(self) -> dict[str, float]:
        """Milliseconds for 1,000 frames."""
        used = [spent(p) - begin for p, begin in zip(self.processes, self.begin, strict=True)]
        scale = 1e6 / self.frames
        return {"learner": self.learner * scale, "worker": max(used, default=0.0) * scale}


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("--backends", nargs="+", default=list(BACKENDS), choices=list(BACKENDS))
    arguments.add_argument("--workers", nargs="+", type=int, default=[1, 2])
    arguments.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    options = arguments.parse_args()
    figures: dict = {}
    common = ["algo=arsac", "task=gs", "logger=none", "compile=false", "frames=100000"]
    common += [f"threads={options.threads}", f"device={options.device}"]
    for backend in options.backends:
        sides: dict[str, Side] = {}
        with tempfile.TemporaryDirectory() as folder:
            try:
                for count in (0, *options.workers):
                    where = [f"collector.workers={count}"] if count else []
                    where = [f"collector={'multi' if count else 'single'}", *where]
                    overrides = [*common, *BACKENDS[backend], *where, *options.set]
                    name = f"{count} workers" if count else "one process"
                    sides[name] = Side(overrides, Path(folder) / str(count))
                rates = medians(
                    alternate({name: side.work for name, side in sides.items()}, options)
                )
                costs = {name: side.costs() for name, side in sides.items()}
            finally:
                for side in sides.values():
                    side.trainer.close()
        print(f"{backend}: {conditions(options)}")
        print(f"{'':14s}{'frames/s':>10s}{'ratio':>8s}{'ms learner':>12s}{'ms worker':>11s}{'cores of their own':>20s}")  # fmt: skip
        alone, own = rates["one process"], sum(costs["one process"].values())
        for name, rate in rates.items():
            learner, worker = costs[name].values()
            print(
                f"{name:14s}{rate:10.1f}{rate / alone:8.2f}{learner:12.2f}{worker:11.2f}{own / (learner + worker):20.2f}"
            )
        side = sides["one process"]
        transition = side.data.select(*side.trainer.experience.stored, strict=False)
        passes = {
            "bytes_transition": transition.bytes() / transition.numel(),
            "frames_batch": side.data.numel(),
        }
        crews = [each.trainer.collector for each in sides.values() if each.processes]
        passes["bytes_learned"] = sum(v.nbytes for v in crews[0].agent.learned().values())
        print("  ".join(f"{name}={value:,.0f}" for name, value in passes.items()))
        figures[backend] = {"rates": rates, "costs": costs, **passes}
    write(options.json, figures)


if __name__ == "__main__":
    main()
