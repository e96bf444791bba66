"""What the benchmarks of speed share: sides that take turns, medians, and their figures as JSON."""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}


def parser(description: str | None, rounds: int = 5, seconds: float = 3.0):
    """Options that every benchmark of speed takes."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--threads", type=int, default=1, help="intra-op threads of torch")
    parser.add_argument("--rounds", type=int, default=rounds)
    parser.add_argument("--seconds", type=float, default=seconds, help="of each side in a round")
    parser.add_argument("--clock", choices=list(CLOCKS), default="wall")
    parser.add_argument("--json", type=Path, help="write the figures here")
    return parser


def rate(work: Callable[[], int], seconds: float, clock: str, device: str = "cpu") -> float:
    """Units of work a second; ``work`` does some and says how many."""
    now, count = CLOCKS[clock], 0
    begin = now()
    while now() - begin < seconds or count == 0:
        count += work()
    if device == "cuda":
        torch.cuda.synchronize()
    return count / (now() - begin)


def alternate(
    sides: dict[str, Callable[[], int]], options: argparse.Namespace
) -> dict[str, list[float]]:
    """The rate of each side in each round; the sides take turns, so that load meets all alike."""
    rates: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(options.rounds):
        for name, work in sides.items():
            rates[name].append(rate(work, options.seconds, options.clock, options.device))
    return rates


def medians(rates: dict[str, list[float]]) -> dict[str, float]:
    return {name: statistics.median(values) for name, values in rates.items()}


def conditions(options: argparse.Namespace) -> str:
    """What a reader of the figures must know of how they were taken."""
    where = torch.cuda.get_device_name() if options.device == "cuda" else "CPU"
    return (
        f"{where}, {options.threads} thread(s), {options.clock} clock, median of {options.rounds} "
        f"rounds of {options.seconds:g} s, load {os.getloadavg()[0]:.1f}"
    )


def belongs(out: Path, settings: dict[str, Any]) -> None:
    """Refuse a folder whose runs were made with other settings: they would be read as these."""
    settings, file = json.loads(json.dumps(settings)), out / "settings.json"
    if file.exists() and (theirs := json.loads(file.read_text())) != settings:
        raise SystemExit(f"{out} holds runs of {theirs}, not of {settings}: take another folder.")
    write(file, settings)


def write(path: Path | None, figures: dict[str, Any]) -> None:
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(figures, indent=2) + "\n")


def transitions(batch: int, device: str, rows: int = 11) -> TensorDict:
    """Random ones with 0 to 10 vehicles in sight, in SI units."""
    generator = torch.Generator().manual_seed(0)

    def scene() -> dict[str, torch.Tensor]:
        ego = torch.randn(batch, 9, generator=generator) * 5
        vehicles = torch.randn(batch, rows, 6, generator=generator) * 10
        count = torch.randint(0, rows, (batch, 1), generator=generator)
        vehicles[..., 0] = (torch.arange(rows) < count).float()
        return {"ego": ego, "vehicles": vehicles * vehicles[..., :1]}

    action = torch.rand(batch, 2, generator=generator) * 2 - 1
    ended = torch.rand(batch, 1, generator=generator) < 0.02
    following = {
        **scene(),
        "reward": torch.randn(batch, 1, generator=generator),
        "cost": torch.rand(batch, 1, generator=generator) * 0.1,
        "done": ended,
        "terminated": ended,
    }
    return TensorDict({**scene(), "action": action, "next": following}, [batch]).to(device)
