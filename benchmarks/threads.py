"""Threads of one training, and what two trainings do to each other.

    python benchmarks/threads.py [--algos arsac sac_lag] [--threads 1 2] [--spins 0 1000 default]
        [--width 256] [--compile] [--rounds 3] [--seconds 5] [--json PATH]

Gradient updates a second of a training alone, and of two at once, for each number of intra-op threads and
for how long an idle thread waits awake for its next work (GOMP_SPINCOUNT, in turns of a loop; GNU's OpenMP,
which torch's Linux wheels use, waits awake by default). Every training is a process of its own; the
settings take turns.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

from side_by_side import transitions, write


def serve(algo: str, threads: int, width: int, compile: bool, seconds: float) -> None:
    """The child: get ready, say so, wait for a line, and print updates a second."""
    import torch
    from update import learner

    torch.set_num_threads(threads)
    data = transitions(256, "cpu")
    update = learner([f"algo={algo}", f"encoder.width={width}"], "cpu", compile).update
    for _ in range(3):
        update(data)
    print("ready", flush=True)
    sys.stdin.readline()
    begin, count = time.perf_counter(), 0
    while time.perf_counter() - begin < seconds:
        update(data)
        count += 1
    print(count / (time.perf_counter() - begin), flush=True)


def measure(
    processes: int, algo: str, threads: int, spin: str, options: argparse.Namespace
) -> float:
    """Updates a second of all processes together."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OMP_", "GOMP_"))}
    if spin != "default":
        environment["GOMP_SPINCOUNT"] = spin
    command = [sys.executable, __file__, "--serve", algo, "--threads", str(threads)]
    command += ["--width", str(options.width), "--seconds", str(options.seconds)]
    command += ["--compile"] if options.compile else []
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    children = [
        subprocess.Popen(command, env=environment, text=True, **pipes) for _ in range(processes)
    ]
    for child in children:
        while child.stdout.readline() != "ready\n":
            if child.poll() is not None:
                raise SystemExit(f"{' '.join(command)} ended before it was ready.")
    for child in children:
        child.stdin.write("go\n")
        child.stdin.flush()
    return sum(float(child.communicate()[0]) for child in children)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--algos", nargs="+", default=["arsac", "sac_lag"])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--spins", nargs="+", default=["0", "1000", "default"])
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--compile", action="store_true", help="compile the loss")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=5.0, help="of each setting in a round")
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--serve", metavar="ALGO", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(options.serve, options.threads[0], options.width, options.compile, options.seconds)
        return

    load = os.getloadavg()[0]
    # One thread waits for nobody.
    settings = [
        (n, spin) for n in options.threads for spin in options.spins[: None if n > 1 else 1]
    ]
    rates: dict[tuple, list[float]] = {}
    for _ in range(options.rounds):
        for algo in options.algos:
            for setting in settings:
                for processes in (1, 2):
                    rate = measure(processes, algo, *setting, options)
                    rates.setdefault((algo, *setting, processes), []).append(rate)
    print(f"median of {options.rounds} rounds of {options.seconds:g} s, load {load:.1f}")
    print(f"{'':10s}{'threads':>8s}{'spin':>9s}{'alone':>8s}{'two at once, together':>23s}")
    figures: dict = {"load": load}
    for algo in options.algos:
        for threads, spin in settings:
            alone, pair = (statistics.median(rates[algo, threads, spin, n]) for n in (1, 2))
            print(
                f"{algo:10s}{threads:8d}{spin if threads > 1 else '-':>9s}{alone:8.2f}{pair:23.2f}"
            )
            figures[f"{algo}_{threads}_{spin}"] = {"alone": alone, "two": pair}
    write(options.json, figures)


if __name__ == "__main__":
    main()
