"""Latency of a policy at batch 1 in saferl, as pt2 and by onnxruntime, where its projector acts and where it does not.

The states come from a drive in dense traffic; the sides take turns, call by call, so that load meets all alike.

    python benchmarks/exported.py --calls 300
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from side_by_side import parser, write
from tensordict import TensorDict

import saferl
from saferl.algorithms.policy import SafePolicy
from saferl.config.locate import pretrained_run
from saferl.deploy.formats import FORMATS
from saferl.deploy.package import package
from saferl.envs.intersection import BatchedIntersection, Scenario


def states(policy: SafePolicy, count: int) -> dict[str, list[dict[str, torch.Tensor]]]:
    """Of a drive: ``count`` states in which the projector acts, and as many in which it does not."""
    task = Scenario(task="mixed", scenario="dense").as_test()
    env = BatchedIntersection(task, 256)
    state = env.reset(seeds=task.episodes(5, 256))
    found: dict[str, list[dict[str, torch.Tensor]]] = {"idle": [], "acts": []}
    for _ in range(60):
        acted = policy(state.clone())
        for name, mask in zip(found, (~acted["intervened"], acted["intervened"]), strict=True):
            for row in state[mask.flatten()].select(*policy.in_keys).unbind(0):
                found[name].append({key: row[key][None].contiguous() for key in policy.in_keys})
        state = env.step_mdp(env.step(acted))
    return {name: rows[:: max(1, len(rows) // count)][:count] for name, rows in found.items()}


def main() -> None:
    args = parser(__doc__)
    args.add_argument("--pretrained", default="arsac")
    args.add_argument("--calls", type=int, default=300, help="of each side in each kind of state")
    options = args.parse_args()
    torch.set_num_threads(options.threads)
    policy = saferl.load_policy(options.pretrained)
    sides: dict[str, Callable] = {"eager": lambda seen: policy(TensorDict(seen, [1]))}
    with tempfile.TemporaryDirectory() as folder:
        for name, (_, read) in FORMATS.items():
            file = Path(folder) / f"policy.{name}"
            package(pretrained_run(options.pretrained), file)
            sides[name] = read(file)[0]
    figures: dict = {}
    print(f"CPU, {options.threads} thread(s), batch 1, {options.calls} calls of each")
    print(f"{'projector':<12}{'':<8}{'p50 ms':>9}{'p99 ms':>9}{'eager / it, p50':>18}{'p99':>8}")
    for kind, rows in states(policy, options.calls).items():
        taken: dict[str, list[float]] = {name: [] for name in sides}
        for number in range(options.calls + 10):
            seen = rows[number % len(rows)]
            for name, run in sides.items():
                begin = time.perf_counter()
                run(seen)
                taken[name].append(time.perf_counter() - begin)
        ms = {name: np.percentile(1e3 * np.array(t[10:]), [50, 99]) for name, t in taken.items()}
        for name, (half, most) in ms.items():
            ratio = ms["eager"] / ms[name]
            print(f"{kind:<12}{name:<8}{half:9.2f}{most:9.2f}{ratio[0]:18.1f}{ratio[1]:8.1f}")
            figures[f"{kind}_{name}"] = {"p50_ms": half, "p99_ms": most, "ratio_p50": ratio[0]}
    write(options.json, figures)


if __name__ == "__main__":
    main()
