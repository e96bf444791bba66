"""Every benchmark still runs, in a small form."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
FAST = [
    "encoder.width=16",
    "learning.warmup_frames=64",
    "learning.batch_size=16",
    "compile=false",
]
SHORT = ["--rounds", "1", "--seconds", "0.1"]
ABLATION = ["--runs", "algo=sac", "--seeds", "0", "--tasks", "gs", "--episodes", "5", "--jobs", "1"]


def command(*arguments: str | Path) -> str:
    env = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *map(str, arguments)], cwd=ROOT, env=env, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A short training of ARSAC and a test of it."""
    out = tmp_path_factory.mktemp("trained") / "run"
    small = ["algo=arsac", "task=gs", "env=batched", "env.num_envs=16", "frames=512", *FAST]
    command("-m", "saferl", *small, f"out={out}")
    where = f"checkpoint={out}"
    command("-m", "saferl.evaluate", where, "task=gs", "episodes=5", f"out={out}/test")
    return out


@pytest.mark.parametrize(
    "arguments",
    [
        ["highway", *SHORT],
        ["simulation", "--batches", "4", *SHORT],
        ["worlds", "--batches", "2", *SHORT],
        ["projector", "--batches", "2", "--width", "16", "--steps", "10", *SHORT],
        ["update", "--width", "16", "--batch", "8", *SHORT],
        ["threads", "--algos", "sac_lag", "--spins", "default", "--width", "16", *SHORT],
        ["training", "--algos", "sac_lag", "--episodes", "20", "--set", *FAST],
        ["traffic", "--episodes", "5"],
        ["traffic", "--env", "sumo-imperfect", "--episodes", "2"],
        ["oracle", "--episodes", "2"],
        ["two_checkouts", ".", "--runs", "algo=sac encoder.width=16", "--modes", "eager", "--batch", "8",
         *SHORT],
        ["two_checkouts", ".", "--what", "decisions", "--runs", "task=mixed", "--modes", "eager", "--batch", "8", *SHORT],
        ["reward_audit", "--episodes", "4"],
        ["workers", "--backends", "batched", "--workers", "1", "--set", "encoder.width=16", *SHORT],
        ["soak", "--decisions", "640", "--updates", "20", "--num-envs", "16", "--set", "env.compile_physics=false",
         "evaluation.episodes=1"],
        ["shield", "--batches", "2", "--decisions", "2", *SHORT],
        ["mmam_forms", "--seeds", "0", "--updates", "20", "--width", "16"],
    ],
    ids=lambda arguments: arguments[0],
)  # fmt: skip
def test_of_nothing(arguments: list[str]):
    assert command(f"benchmarks/{arguments[0]}.py", *arguments[1:])


@pytest.mark.parametrize(
    "arguments",
    [
        ["calibration", "{run}", "--episodes", "5"],
        ["failures", "{run}", "--episodes", "8"],
        ["cost_critics", "{run}", "--updates", "20", "--width", "16"],
        ["projection", "{run}", "--samples", "64"],
        ["backends", "{run}", "--episodes", "4", "--tasks", "gs", "--drivers", "blind"],
        ["curves", "{out}/curves.png", "ARSAC={run}"],
        ["trajectories", "{run}", "blind", "--episode", "1", "--out", "{out}"],
        ["compare", "{run}/test", "{run}/test"],
        ["ablation", "{out}", "--train", "gs", *ABLATION, "--set", "frames=512", *FAST],
        ["time_to_safe", "{out}", "--runs", "algo=rsac", "--minutes", "0.2", "--every", "0.1", "--episodes", "4",
         "--jobs", "1", "--peers", "ours", "intersection-v1", "--set", "frames=512", "env.num_envs=16", *FAST],
        ["limits", "{out}", "--algos", "cpo", "--seeds", "0", "--frames", "2500", "--episodes", "3"],
        ["cart", "{out}", "--algos", "ppo_saute", "cat", "--seeds", "0", "--set", "frames=2560", "evaluation.episodes=3"],
        ["choices", "{out}", "--undo", "closest", "--frames", "128", "--episodes", "2", "--seeds", "0", "--jobs", "1",
         "--set", *FAST],
        ["updates_per_frame", "{out}", "--values", "0.25", "--minutes", "0.05", "--seeds", "0",
         "--task", "gs", "--set", *FAST],
    ],
    ids=lambda arguments: arguments[0],
)  # fmt: skip
def test_of_a_run(arguments: list[str], run: Path, tmp_path: Path):
    name, *rest = (argument.format(run=run, out=tmp_path) for argument in arguments)
    command(f"benchmarks/{name}.py", *rest)
    assert name != "curves" or (tmp_path / "curves.png").stat().st_size > 1000


def test_progress_of_a_run_that_has_not_learned_yet(tmp_path: Path, monkeypatch):
    """Its first rows hold no losses."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    from gpu import progress

    assert progress(tmp_path) == {}
    (tmp_path / "metrics.csv").write_text("episodes,loss_actor\n10,\n20,0.5\n30,\n")
    (tmp_path / "timing.csv").write_text("collect,learn,other,updates\n1,2,1,8\n")
    figures = progress(tmp_path)
    assert figures["updates_per_second"] == 2.0
    assert figures["minutes_for_10000_episodes"] == 1e4 / 30 * 4 / 60
