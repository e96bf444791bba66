"""A long training with everything on: does it stay as fast, and as small, as it began?

    python benchmarks/soak.py [--decisions 10000000] [--updates 20000] [--num-envs 1024] [--algo sac_lag]
        [--set KEY=VALUE ...] [--clock cpu] [--json PATH]

Small networks drive the batched road, whose physics are compiled (some minutes at the start, which are not counted). There are
twenty checkpoints, a thousand rows for TensorBoard, and a test after each tenth, of which it prints

- decisions a second, of the time that environment and policy take, and updates a second, of that of learning: of
  the process's own time, or with ``--clock wall`` of the wall's;
- the process's memory and open files at its end;

and then the last tenth beside the first.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from side_by_side import CLOCKS, write
from simulation import resident

from saferl.algorithms.assemble import build_trainer, complete
from saferl.algorithms.policy import compiling
from saferl.cli.train import claim, closing_test
from saferl.config.locate import config_dir

COLUMNS = {"decisions_per_s": 0, "updates_per_s": 1, "MB": 0, "open_files": 0}


def soak(overrides: list[str], run: Path, now: Callable[[], float]) -> list[dict[str, float]]:
    """One training; what was measured in each tenth of it."""
    with initialize_config_dir(config_dir(), version_base="1.3"):
        cfg = compose("config", overrides)
    complete(cfg.task)
    OmegaConf.resolve(cfg)
    torch.set_num_threads(cfg.threads)
    claim(run, cfg)
    trainer = build_trainer(cfg, run)
    seconds, rows = {"rollout": 0.0, "update": 0.0}, []
    before: list[int] = []

    def time(owner: object, method: str) -> None:
        call = getattr(owner, method)

        def timed(*args, **kwargs):
            begin = now()
            try:
                return call(*args, **kwargs)
            finally:
                seconds[method] += now() - begin

        setattr(owner, method, timed)

    def look(finished: object, spent: float) -> None:
        counts = [trainer.progress.frames, trainer.progress.updates]
        if before and spent * 10 < len(rows) + 1:
            return
        if before:
            closing_test(compiling(cfg, False), run)
            done = [after - old for after, old in zip(counts, before, strict=True)]
            rates = [
                count / max(seconds[name], 1e-9) for count, name in zip(done, seconds, strict=True)
            ]
            files = len(os.listdir("/proc/self/fd"))
            rows.append(dict(zip(COLUMNS, (*rates, resident(), files), strict=True)))
        # After the first batch, too, in which the physics are compiled.
        before[:] = counts
        seconds.update(rollout=0.0, update=0.0)

    time(trainer.collector, "rollout")
    time(trainer.learner, "update")
    trainer.after_collect.append(look)
    trainer.train()
    trainer.close()
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--decisions", type=int, default=10_000_000)
    parser.add_argument("--updates", type=int, default=20_000)
    parser.add_argument("--num-envs", type=int, default=1024)
    parser.add_argument("--algo", default="sac_lag")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    parser.add_argument("--clock", choices=list(CLOCKS), default="cpu")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()

    frames, num_envs = options.decisions, options.num_envs
    overrides = [
        f"algo={options.algo}",
        f"frames={frames}",
        f"env.num_envs={num_envs}",
        "threads=1",
    ]
    overrides += ["encoder=mlp", "encoder.width=32", "device=cpu", "compile=false"]
    overrides += ["env.compile_physics=true"]
    overrides += [f"learning.updates_per_frame={options.updates / frames}", "save_minutes=null"]
    overrides += [f"learning.buffer_size={4 * num_envs}", f"learning.warmup_frames={num_envs}"]
    overrides += ["learning.batch_size=64", "evaluation.episodes=4", "evaluation.num_envs=4"]
    overrides += [f"record_every={-(-frames // 1000)}", f"save_every={-(-frames // 20)}"]
    with tempfile.TemporaryDirectory() as folder:
        rows = soak([*overrides, *options.set], Path(folder) / "run", CLOCKS[options.clock])

    print(f"{frames} decisions, {options.updates} updates of {options.algo}, {options.clock} clock")
    print("tenth" + "".join(f"{name:>17s}" for name in COLUMNS))
    for number, row in enumerate(rows, 1):
        print(f"{number:5d}" + "".join(f"{row[k]:17,.{p}f}" for k, p in COLUMNS.items()))
    ratios = {name: rows[-1][name] / rows[0][name] for name in COLUMNS}
    print("ratio" + "".join(f"{ratio:17.2f}" for ratio in ratios.values()))
    write(options.json, {"tenths": rows, "last_by_first": ratios, "load": os.getloadavg()})


if __name__ == "__main__":
    main()
