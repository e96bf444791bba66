"""Updates or decisions a second of this checkout and of another, in turn.

    python benchmarks/two_checkouts.py OTHER [--what updates] [--runs "algo=arsac encoder.width=64" "algo=sac"]
        [--modes eager compiled] [--batch 256] [--rounds 5] [--seconds 3] [--threads 1] [--json PATH]

OTHER is a folder with another commit of saferl (``git worktree add ../before COMMIT``), which runs on the same
packages. Each composition is built in a process of its own by either checkout, on the world's observation, warmed
up, and then measured in rounds, one process after the other, so that load meets all alike. Of compiled rows it
is printed how many graphs torch holds, and how long it took to have them. ``--what decisions`` steps the simulation
of the composition's task with ``--batch`` environments and random actions instead, compiled or not.
"""

from __future__ import annotations

import inspect
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from side_by_side import conditions, medians, parser, rate, transitions, write


def learner_of(cfg: Any) -> Any:
    """What makes an update, by this or an older checkout."""
    try:
        from saferl.algorithms.assemble import algorithm_of, build_agent
    except ImportError:
        from saferl.agents import build_agent
        from saferl.builders import build_learner

        return build_learner(cfg, build_agent(cfg).loss)
    whole = "cfg" in inspect.signature(algorithm_of).parameters  # an older commit
    return algorithm_of(cfg if whole else cfg.learning).learner(build_agent(cfg).loss, cfg.compile)


def updates(cfg: Any, options: Any) -> Callable[[], int]:
    """Makes one update."""
    learner, data = learner_of(cfg), transitions(options.batch, options.device)

    def work() -> int:
        learner.update(data)
        return 1

    return work


def decisions(cfg: Any, options: Any) -> Callable[[], int]:
    """Makes a decision in each environment."""
    import hydra
    import torch

    from saferl.envs.intersection import BatchedIntersection

    env = BatchedIntersection(
        hydra.utils.instantiate(cfg.task),
        options.batch,
        device=options.device,
        compile_physics=cfg.compile,
        seed=0,
    )
    generator = torch.Generator(options.device).manual_seed(0)
    data = env.reset()

    def work() -> int:
        nonlocal data
        noise = torch.rand(options.batch, 2, generator=generator, device=options.device)
        data["action"] = 2 * noise - 1
        _, data = env.step_and_maybe_reset(data)
        return options.batch

    return work


#: What is counted, by the word of the command line.
WHAT = {"updates": updates, "decisions": decisions}


def serve(overrides: list[str], options: Any) -> None:
    """The child: gets ready, says so, and answers each line, a number of seconds, with a rate."""
    import torch
    from hydra import compose, initialize_config_dir

    try:
        from saferl.config.locate import config_dir
    except ImportError:  # an older commit
        from saferl.paths import config_dir

    torch.set_num_threads(options.threads)
    device, compiled = options.device, options.modes == ["compiled"]
    overrides = [*overrides, f"device={device}", f"compile={compiled}"]
    with initialize_config_dir(config_dir(), version_base=None):
        cfg = compose("config", overrides[-2:])
        if "policy" in cfg.encoder:  # older commits have settings for each network
            overrides = [o.replace("encoder.width", "encoder.policy.width") for o in overrides]
        cfg = compose("config", overrides)
        if "observation" in cfg.task:  # older commits have no other than the world's
            cfg = compose("config", [*overrides, "task.observation=world"])
    torch.manual_seed(0)
    work = WHAT[options.what](cfg, options)
    begin = time.perf_counter()
    for _ in range(3):
        work()
    graphs = torch._dynamo.utils.counters["stats"]["unique_graphs"]
    print(json.dumps({"first": time.perf_counter() - begin, "graphs": graphs}), flush=True)
    for line in sys.stdin:
        print(rate(work, float(line), options.clock, device), flush=True)


class Side:
    """A child that waits for its turn."""

    def __init__(self, checkout: Path, run: str, mode: str, options: Any):
        command = [sys.executable, __file__, "--serve", run, "--modes", mode]
        for name in ("what", "batch", "threads", "device", "clock"):
            command += [f"--{name}", str(getattr(options, name))]
        self.child = subprocess.Popen(
            command,
            env={**os.environ, "PYTHONPATH": str(checkout)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.ready = json.loads(self._line(" ".join(command)))

    def _line(self, what: str) -> str:
        line = self.child.stdout.readline()  # pyright: ignore[reportOptionalMemberAccess]
        if not line:
            raise SystemExit(f"{what} ended before its turn.")
        return line

    def measure(self, seconds: float) -> float:
        self.child.stdin.write(f"{seconds}\n")  # pyright: ignore[reportOptionalMemberAccess]
        self.child.stdin.flush()  # pyright: ignore[reportOptionalMemberAccess]
        return float(self._line("A side"))


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("other", type=Path, nargs="?", help="folder of the other checkout")
    arguments.add_argument(
        "--runs",
        nargs="+",
        default=["algo=arsac encoder.width=64", "algo=sac encoder.width=128"],
    )
    arguments.add_argument("--what", choices=list(WHAT), default="updates")
    arguments.add_argument("--modes", nargs="+", default=["eager", "compiled"])
    arguments.add_argument("--batch", type=int, default=256)
    arguments.add_argument("--serve", metavar="RUN", help="for the children alone")
    options = arguments.parse_args()
    if options.serve is not None:
        serve(options.serve.split(), options)
        return
    if options.other is None or not (options.other / "saferl").is_dir():
        raise SystemExit(f"OTHER must be a checkout of saferl, got {options.other}.")

    checkouts = {"here": Path(__file__).parents[1], "other": options.other.resolve()}
    sides, figures = {}, {}
    for run in options.runs:
        for mode in options.modes:
            for name, checkout in checkouts.items():
                side = sides[run, mode, name] = Side(checkout, run, mode, options)
                print(
                    f"{run}, {mode}, {name}: three steps after {side.ready['first']:.0f} s, "
                    f"{side.ready['graphs']} graphs",
                    flush=True,
                )
    rates: dict[tuple[str, str, str], list[float]] = {key: [] for key in sides}
    for _ in range(options.rounds):
        for key, side in sides.items():
            rates[key].append(side.measure(options.seconds))
    for side in sides.values():
        side.child.kill()
    speed = medians(rates)  # pyright: ignore[reportArgumentType]
    print(f"\n{conditions(options)}, batch {options.batch}, {options.what}/s")
    for run in options.runs:
        for mode in options.modes:
            here, other = (speed[run, mode, name] for name in checkouts)  # pyright: ignore
            print(f"{run}, {mode}: {here:.1f} here, {other:.1f} there, ratio {here / other:.2f}")
            figures[f"{run}, {mode}"] = {
                name: {
                    f"{options.what}_per_second": rates[run, mode, name],
                    **sides[run, mode, name].ready,
                }
                for name in checkouts
            } | {"ratio": here / other}
    write(options.json, figures | {"conditions": conditions(options)})


if __name__ == "__main__":
    main()
