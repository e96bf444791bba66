"""Gradient updates per second, beside the forms that one would write first.

    python benchmarks/update.py [--omnisafe PYTHON] [--width 256] [--batch 256] [--rounds 5]
        [--seconds 3] [--clock wall] [--threads 1] [--device cpu] [--json PATH]

An update is whole on every side: losses, gradients, optimizer and target networks, on one and the same
batch. The sides take turns in one process:

- ARSAC with MMAM as printed (``PlainMMAMPolicyEncoder``, ``PlainMMAMValue``) and with ours, each eager and
  compiled;
- SAC-Lag on MLPs, ours and a straight PyTorch implementation (``benchmarks/straight.py``), as CleanRL
  writes SAC and tuned, each eager and compiled;
- SAC on the same MLPs by TorchRL's own loss, for scale: it has no cost critics;
- afterwards, in a process of its own, OmniSafe's SACLag, where ``--omnisafe`` names the Python of an environment
  that has it (``benchmarks/omnisafe_sac_lag.py`` says how to make one); with the default width, batch and thread
  alone. It has one cost critic where ours has two.

Calls are the operators of an eager update, backward included. A compiled row shows how many graphs torch made for it, each of them whole
(``fullgraph``, so that it cannot fall back to single operators). GFLOP are those of one eager update as torch counts them; the share is of the rate of a product of two
1,024 x 1,024 matrices, measured in the same rounds. The matrix products of SAC-Lag's update are also timed
alone: no arrangement of the same arithmetic is faster than they are.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from side_by_side import alternate, conditions, medians, parser, transitions, write
from straight import StraightSACLag
from torch._dynamo.utils import counters
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from saferl.algorithms.assemble import algorithm_of, build_agent
from saferl.config.locate import config_dir
from saferl.training.learner import Learner

PLAIN = ["encoder._target_=plain.PlainMMAM"]


class Flops(TorchDispatchMode):
    """Counts by torch's own table, and keeps the products that it counted to do them again.

    torch's own counter also tracks modules, which TensorDict's refuse.
    """

    def __init__(self):
        super().__init__()
        self.total, self.calls, self.products = 0, 0, []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        self.calls += 1
        if (count := flop_registry.get(func._overloadpacket)) is not None:
            self.total += count(*args, **(kwargs or {}), out_val=out)
            self.products.append((func, args, kwargs or {}))
        return out

    @torch.no_grad()
    def again(self) -> int:
        """The products alone, on the same operands."""
        for func, args, kwargs in self.products:
            func(*args, **kwargs)
        return 1


def learner(overrides: list[str], device: str, compile: bool) -> Learner:
    with initialize_config_dir(config_dir(), version_base=None):
        fixed = ["task.observation=world", f"device={device}", f"compile={compile}"]
        cfg = compose("config", [*overrides, *fixed])
    torch.manual_seed(0)
    return algorithm_of(cfg.learning).learner(build_agent(cfg).loss, cfg.compile)


def main() -> None:
    args = parser(__doc__)
    args.add_argument("--width", type=int, default=256)
    args.add_argument("--batch", type=int, default=256)
    args.add_argument("--omnisafe", type=Path, metavar="PYTHON")
    options = args.parse_args()
    torch.set_num_threads(options.threads)
    fixed = {"width": 256, "batch": 256, "threads": 1, "device": "cpu"}
    if options.omnisafe and any(getattr(options, name) != fixed[name] for name in fixed):
        args.error(f"--omnisafe is measured with {fixed} alone")

    data, width, device = transitions(options.batch, options.device), options.width, options.device
    nested = {f"next_{k}": data["next", k] for k in ("ego", "vehicles")}
    flat = {k: data["next", k] for k in ("reward", "cost", "terminated")}
    flat |= {k: data[k] for k in ("ego", "vehicles", "action")} | nested

    sides: dict[str, Callable[[], int]] = {}
    flops: dict[str, float] = {}
    calls: dict[str, int | str] = {}
    products: dict[str, Callable[[], int]] = {}

    def add(name: str, update: Callable, batch, same_as: str | None = None) -> None:
        """A side, warmed up; compiled ones have the arithmetic of the eager one."""

        def work() -> int:
            update(batch.copy())  # losses write into a batch, and the next one is fresh
            return 1

        if same_as is None:
            with Flops() as counter:
                work()
            flops[name], calls[name] = counter.total / 1e9, counter.calls
            products[name] = counter.again
        else:
            flops[name] = flops[same_as]
        before = counters["stats"]["unique_graphs"]
        for _ in range(3):
            work()
        made = counters["stats"]["unique_graphs"] - before
        if same_as is not None:
            if not made:
                raise SystemExit(f"{name} is not compiled.")
            calls[name] = f"{made} graph{'s' * (made > 1)}"
        sides[name] = work

    def ours(name: str, overrides: list[str]) -> None:
        overrides = [*overrides, f"encoder.width={width}"]
        add(f"{name} eager", learner(overrides, device, False).update, data)
        compiled = learner(overrides, device, True).update
        add(f"{name} compiled", compiled, data, f"{name} eager")

    ours("arsac plain", ["algo=arsac", *PLAIN])
    ours("arsac", ["algo=arsac"])
    ours("sac_lag", ["algo=sac_lag"])
    for kind, tuned in (("straight", False), ("tuned", True)):
        for compile in (False, True):
            with torch.device(device):
                straight = StraightSACLag(width=width, rows=11, compile=compile, tuned=tuned)
            name = f"{kind} sac_lag {'compiled' if compile else 'eager'}"
            add(name, straight.update, flat, f"{kind} sac_lag eager" if compile else None)
    ours("torchrl sac", ["algo=sac"])

    square = torch.randn(1024, 1024, device=device)

    def product() -> int:
        torch.mm(square, square)
        return 1

    sides["gemm"], flops["gemm"] = product, 2 * 1024**3 / 1e9
    alone = "sac_lag's products alone"
    sides[alone], flops[alone] = products["sac_lag eager"], flops["sac_lag eager"]
    rates = alternate(sides, options)
    if options.omnisafe:
        command = [options.omnisafe, Path(__file__).with_name("omnisafe_sac_lag.py"), "--same-work"]
        answer = subprocess.run(
            [*map(str, command), "--seconds", str(options.seconds)],
            capture_output=True,
            text=True,
            check=True,
        )
        key = {"wall": "updates_per_second", "cpu": "updates_per_cpu_second"}[options.clock]
        rates["omnisafe sac_lag"] = [json.loads(answer.stdout.strip().splitlines()[-1])[key]]

    speed = medians(rates)
    peak = speed["gemm"] * flops["gemm"]
    print(f"{conditions(options)}, batch {options.batch}, width {width}")
    print(f"GEMM rate {peak:.0f} GFLOP/s")
    print(f"{'':28s}{'updates/s':>10s}{'calls':>10s}{'GFLOP':>8s}{'of GEMM':>9s}")
    for name in speed:
        if name != "gemm":
            work = (
                f"{flops[name]:8.2f}{speed[name] * flops[name] / peak:9.0%}"
                if name in flops
                else ""
            )
            print(f"{name:28s}{speed[name]:10.1f}{calls.get(name, ''):>10}{work}")

    def ratio(left: str, right: str) -> float:
        print(f"{left} / {right}: {speed[left] / speed[right]:.2f}")
        return speed[left] / speed[right]

    figures = {
        "arsac": {
            "ratio_eager_over_plain": ratio("arsac eager", "arsac plain eager"),
            "ratio_compiled_over_plain": ratio("arsac compiled", "arsac plain compiled"),
            "ratio_over_plain": ratio("arsac compiled", "arsac plain eager"),
        },
        "sac_lag": {
            "ratio_eager_over_plain": ratio("sac_lag eager", "straight sac_lag eager"),
            "ratio_over_plain": ratio("sac_lag compiled", "straight sac_lag compiled"),
            "ratio_eager_over_tuned": ratio("sac_lag eager", "tuned sac_lag eager"),
            "ratio_over_tuned": ratio("sac_lag compiled", "tuned sac_lag compiled"),
            # What no form that makes these products can exceed.
            "bound_over_plain": ratio(alone, "straight sac_lag compiled"),
        },
        "updates_per_second": speed,
        "gflop": flops,
        "calls": calls,
        "rounds": rates,
        "conditions": conditions(options),
    }
    if options.omnisafe:
        over = ratio("sac_lag compiled", "omnisafe sac_lag")
        figures["sac_lag"]["ratio_over_omnisafe"] = over
    write(options.json, figures)


if __name__ == "__main__":
    main()
