"""Decisions per second of the batched intersection beside highway-env's own, in one process.

    python benchmarks/simulation.py [--batches 1 256 1024 4096] [--device cpu] [--rounds 5]
        [--seconds 3] [--clock wall] [--soak 0] [--json PATH]

A decision is whole on both sides: yielding, three substeps, observation, reward, and resets; ours
adds the cost. Stock ``intersection-v1`` runs at 15 Hz with 5 decisions per second and 10 vehicles,
ours the nominal traffic with 10 vehicles, both with random actions; every environment is stepped by
``step_and_maybe_reset``, TorchRL's overhead included. The rounds alternate, so that a changing load
meets all alike. Prints medians, their ratios to stock, the time to the first step, and the memory of
the states. On a machine that is busy with other work ``--clock cpu`` counts this process's own time.

``--soak 10000000`` then makes so many decisions in a row, compiled, at the last of the batches, looks
at every number of every step for one that is not finite, and prints the process's memory on the way.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import torch
from highway import deciding, stock
from side_by_side import alternate, conditions, medians, parser, write

from saferl.envs.intersection import BatchedIntersection, Scenario


class Ours:
    """One batched environment and what is known of it."""

    def __init__(self, batch: int, compiled: bool, device: str):
        self.name = f"B={batch} {'compiled' if compiled else 'eager'}"
        begin = time.perf_counter()
        scenario = Scenario(task="mixed")
        self.env = BatchedIntersection(
            scenario, batch, device=device, compile_physics=compiled, seed=0
        )
        self.batch, self.compiled, self.device = batch, compiled, device
        self.generator = torch.Generator(device).manual_seed(0)
        self.data = self.env.reset()
        self()
        self.first_step = time.perf_counter() - begin
        state = self.env.state_dict().values()
        self.megabytes = sum(t.numel() * t.element_size() for t in state) / 2**20

    def __call__(self) -> int:
        noise = torch.rand(self.batch, 2, generator=self.generator, device=self.device)
        self.data["action"] = 2 * noise - 1
        _, self.data = self.env.step_and_maybe_reset(self.data)
        return self.batch


def resident() -> float:
    """Memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def soak(one: Ours, decisions: int) -> dict[str, float]:
    """Decisions in a row; the process's memory after a tenth of them and at the end, MB."""
    done, memory, marks = 0, {}, [decisions // 10, decisions]
    while done < decisions:
        done += one()
        wrong = [
            key
            for key, value in one.data.items(True, True)
            if value.is_floating_point() and not bool(value.isfinite().all())
        ]
        if wrong:
            raise SystemExit(f"Not finite after {done} decisions: {wrong}.")
        if done >= marks[0]:
            memory[f"MB_after_{marks.pop(0)}"] = resident()
    return memory


def main() -> None:
    args = parser(__doc__)
    args.add_argument("--batches", type=int, nargs="+", default=[1, 256, 1024, 4096])
    args.add_argument("--soak", type=int, default=0, metavar="DECISIONS")
    options = args.parse_args()
    torch.set_num_threads(options.threads)

    ours = [
        Ours(batch, compiled, options.device)
        for batch in options.batches
        for compiled in (False, True)
    ]
    sides: dict[str, Callable[[], int]] = {
        "stock": deciding(stock()),
        **{one.name: one for one in ours},
    }
    rates = alternate(sides, options)
    speed_of = medians(rates)

    print(conditions(options))
    print(
        f"{'':16s}{'decisions/s':>12s}{'ratio':>8s}{'us each':>9s}{'first step':>12s}{'state':>9s}"
    )
    print(f"{'stock':16s}{speed_of['stock']:12.1f}{1.0:8.1f}{1e6 / speed_of['stock']:9.1f}")
    result = {"stock": speed_of["stock"], "conditions": conditions(options), "rounds": rates}
    for one in ours:
        speed = speed_of[one.name]
        ratio = speed / speed_of["stock"]
        print(
            f"{one.name:16s}{speed:12.0f}{ratio:8.0f}{1e6 / speed:9.1f}{one.first_step:10.1f} s"
            f"{one.megabytes:6.1f} MB"
        )
        kind = "compiled" if one.compiled else "eager"
        result[f"ratio_{kind}_{one.batch}"] = ratio
        result[one.name] = {
            "decisions_per_second": speed,
            "ratio": ratio,
            "first_step_s": one.first_step,
            "state_MB": one.megabytes,
        }
    if options.device == "cuda":
        print(
            f"{torch.cuda.get_device_name()}: peak {torch.cuda.max_memory_allocated() / 2**20:.0f} MB"
        )
    if options.soak:
        result["soak"] = soak(ours[-1], options.soak)
        memory = ", ".join(f"{key} {value:.0f}" for key, value in result["soak"].items())
        print(f"{options.soak} decisions, {ours[-1].name}: every number finite, {memory}")
    write(options.json, result)


if __name__ == "__main__":
    main()
