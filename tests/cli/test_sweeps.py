"""Several jobs of one command line, and the folders that they are in."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from small import EMPTY, SMALL

from saferl.checkpoint.run import CONFIG
from saferl.config.locate import config_dir
from saferl.evaluation.compare import main as summarise

TRAIN, TEST, EXPORT = ("train", "config"), ("evaluate", "evaluate"), ("export", "export")


def test_train_from_any_folder_then_multirun(command, tmp_path: Path, capsys):
    command(*TRAIN, *SMALL, *EMPTY, "algo=sac", "out=mine", "logger=tensorboard")
    names = {path.name for path in (tmp_path / "mine").iterdir()}
    assert names == {
        ".lock", "checkpoints", "config.yaml", "evaluation", "metrics.csv", "tensorboard", "timing.csv",
    }  # fmt: skip
    assert {path.name for path in tmp_path.iterdir()} == {"mine"}
    assert "SR" in capsys.readouterr().out

    command(*TRAIN, "-m", *SMALL, *EMPTY, "algo=sac,asac", "seed=0,1", "frames=8", "out=many")
    jobs = sorted(path for path in (tmp_path / "many").iterdir() if path.is_dir())
    assert [job.name for job in jobs] == [
        f"algo-{algo}_seed-{seed}" for algo in ("asac", "sac") for seed in (0, 1)
    ]
    made = [(job / CONFIG).read_text() for job in jobs]
    assert ["algo_name: sac\n" in text for text in made] == [False, False, True, True]
    assert [f"seed: {seed}\n" in text for seed, text in zip((0, 1, 0, 1), made, strict=True)] == [
        True
    ] * 4
    assert all((job / "evaluation/metrics.json").is_file() for job in jobs)
    summary = capsys.readouterr().out.splitlines()[-3:]
    summarise(["many"])
    assert capsys.readouterr().out.splitlines() == summary
    with pytest.raises(SystemExit, match="no run below elsewhere has been tested"):
        summarise(["elsewhere"])
    with pytest.raises(SystemExit) as left:
        summarise(["--help"])
    assert left.value.code == 0 and "FOLDER" in capsys.readouterr().out
    assert summary[0].split() == ["runs", "SR", "%", "CR", "%", "return", "cost", "return"]
    for line, algo in zip(summary[1:], ("sac", "asac"), strict=True):
        assert re.match(algo + r" gs +2 +\S+ \[\S+, \S+\]  ", line)


def test_tests_of_a_sweep_end_with_one_table_and_those_before_stand_in_it(
    command, tmp_path: Path, capsys
):
    """Drivers, then a run with and without its projector, in other traffic and on the other backend."""
    short = ("task=gs", "task.duration=1", "episodes=3", "env.num_envs=3", "out=tests")
    where = ("task.scenario=nominal,dense", "env=batched,highway")
    run = (*SMALL, "algo=rsac", "task=gs", "task.vehicles=null", "projector.steps=2", "out=run")
    command(*TRAIN, *run, "task.duration=1")
    command(*TEST, "-m", "policy=scripted,blind", *short, *where)
    drivers = capsys.readouterr().out.splitlines()[-9:]
    assert drivers[0].split()[:4] == ["policy", "scenario", "env", "episodes"]
    assert [line.split()[0] for line in drivers[1:]] == ["scripted"] * 4 + ["blind"] * 4

    command(*TEST, "-m", "checkpoint=run", *short, *where, "project=true,false")
    head, *lines = capsys.readouterr().out.splitlines()[-17:]
    assert head.split() == [
        "policy",
        "scenario",
        "env",
        "project",
        "episodes",
        "CR",
        "%",
        "SR",
        "%",
        "FR",
        "%",
    ]
    rows = [line.replace("rsac (run)", "rsac").split()[:5] for line in lines]
    assert rows[:8] == [[*line.split()[:3], "False", "3"] for line in drivers[1:]]
    assert sorted(map(tuple, rows[8:])) == sorted(
        ("rsac", scenario, f"{env}Intersection", project, "3")
        for scenario in ("nominal", "dense")
        for env in ("Batched", "Highway")
        for project in ("True", "False")
    )
    summarise(["tests"])
    assert capsys.readouterr().out.splitlines() == [head, *lines]


def test_a_sweep_of_tests_that_is_run_again_does_what_is_missing(command, tmp_path: Path, capsys):
    """A test that was cut short is done again; another one in its folder is refused."""
    sweep = (*TEST, "-m", *EMPTY, "policy=blind,random", "task=rt", "out=tests")
    command(*sweep, "episodes=1")
    kept, again = (tmp_path / f"tests/policy-{name}" for name in ("blind", "random"))
    told = json.loads((again / "asked.json").read_text())
    assert told["finished"]
    (again / "asked.json").write_text(json.dumps(told | {"finished": False}))
    for folder in (kept, again):
        (folder / "episodes.csv").write_text("mine")
    capsys.readouterr()
    command(*sweep, "episodes=1", "env.num_envs=1")
    assert "policy-blind is there already" in capsys.readouterr().out
    assert (kept / "episodes.csv").read_text() == "mine"
    assert (again / "episodes.csv").read_text() != "mine"
    with pytest.raises(SystemExit):
        command(*sweep, "episodes=2")
    assert "holds a test already" in (kept / "error.txt").read_text()
    assert (kept / "episodes.csv").read_text() == "mine"


def test_one_refused_job_of_a_sweep_stops_no_other(command, tmp_path: Path, capsys):
    """It is told at the end and by its folder; the same command again does what is missing, and only that."""
    small = [setting for setting in SMALL if "batch_size" not in setting]
    many = (*TRAIN, *small, "task=cart", "algo=sac", "seed=0,1", "out=many", "-m")
    with pytest.raises(SystemExit) as left:
        command(*many, "learning.batch_size=8,100000")
    bad = [f"many/learning.batch_size-100000_seed-{seed}" for seed in (0, 1)]
    good = [tmp_path / name.replace("100000", "8") for name in bad]
    assert str(left.value).startswith(f"error: {bad[0]}, {bad[1]} failed")
    assert "got 64 and 100000" in (tmp_path / bad[0] / "error.txt").read_text()
    assert re.search(r"sac cart +2 ", capsys.readouterr().out)

    rows = [(run / "metrics.csv").read_text() for run in good]
    (good[1] / "evaluation/metrics.json").unlink()
    with pytest.raises(SystemExit) as left:
        command(*many, "learning.batch_size=8,100000,200000")
    assert str(left.value).count("00000_seed") == 4
    assert re.search(r"sac cart +2 ", out := capsys.readouterr().out)
    assert f"{good[0]} is there already" in out and f"{good[1]} is there already" not in out
    assert rows == [(run / "metrics.csv").read_text() for run in good]
    command(*many, "learning.batch_size=8,16")
    assert capsys.readouterr().out.count("sac cart learning.batch_size=") == 2
    assert not list(tmp_path.glob("many/*-8_*/error.txt"))


@pytest.mark.parametrize(
    "name",
    [
        "Läufe (1) 50% a{b} it's #c",
        "algo=rsac,seed=0",
        "ends\\",
        "007",
    ],
)
def test_a_path_may_hold_any_character(name: str, command, tmp_path: Path):
    command(*TRAIN, *SMALL, "task=cart", "algo=sac", "frames=8", f"out={name}")
    assert (tmp_path / name / "metrics.csv").is_file()
    command(*TRAIN, f"resume={name}")
    command(*TEST, f"checkpoint={name}", "episodes=1", f"out={name}/test")
    command(*TEST, "-m", f"checkpoint={name}", "episodes=1", f"out={name}/tests", "seed=0,1")
    made = sorted(path.parent.name for path in (tmp_path / name / "tests").glob("*/metrics.json"))
    assert made == ["seed-0", "seed-1"]


def test_a_job_stays_in_the_folder_of_its_sweep(command, tmp_path: Path, capsys):
    """Whatever path it is about; a mistake of one is told, and no file of anybody else's is touched."""
    command(*TRAIN, *SMALL, "task=cart", "algo=sac", "frames=8", "out=here/run")
    (tmp_path / "error.txt").write_text("mine")
    (tmp_path / "tests/notes").mkdir(parents=True)
    (tmp_path / "tests/notes/error.txt").write_text("mine")
    before = {path for path in tmp_path.rglob("*")}
    with pytest.raises(SystemExit) as left:
        command(*TEST, "-m", "checkpoint=here/run,./here/run,nosuch", "episodes=1", "out=tests")
    assert (
        str(left.value) == "error: tests/checkpoint-nosuch failed; each says why in its error.txt."
    )
    made = {path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path not in before}
    assert all(path.parts[0] == "tests" for path in made)
    assert Path("tests/checkpoint-here_run/metrics.json") in made
    command("export", "export", "-m", "checkpoint=here/run,./here/run", "out=policies")
    assert len(list(tmp_path.glob("policies/*/policy.safetensors"))) == 2
    command("export", "export", "checkpoint=here/run", "out=alone")  # the sweep before is forgotten
    assert [path.read_text() for path in tmp_path.rglob("error.txt")].count("mine") == 2


def test_a_sweep_knows_its_jobs_again(command, tmp_path: Path, capsys):
    """However its folder is written and with other threads; one that was killed before its first checkpoint begins anew."""
    many = (*TRAIN, *SMALL, "task=cart", "algo=sac", "frames=8", "seed=0,1", "-m")
    command(*many, "out=many")
    shutil.rmtree(tmp_path / "many/seed-0/checkpoints")
    shutil.rmtree(tmp_path / "many/seed-0/evaluation")
    capsys.readouterr()
    command(*many, "out=many/", "threads=2")
    out = capsys.readouterr().out
    assert "seed-1 is there already" in out and "seed-0 is there already" not in out
    assert (tmp_path / "many/seed-0/evaluation/metrics.json").is_file()
    shutil.rmtree(tmp_path / "many/seed-1/checkpoints")  # to save room
    whole = (tmp_path / "many/seed-1/config.yaml").read_text()
    capsys.readouterr()
    command(*many, "out=many")
    assert "seed-1 is there already" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        command(*many, "out=many", "learning.tau=0.03")
    assert (tmp_path / "many/seed-1/config.yaml").read_text() == whole
    command(*TRAIN, *SMALL, "task=cart", "algo=sac", "frames=8", "seed=5", "-m", "out=many")
    assert (tmp_path / "many/0/metrics.csv").is_file() and not (
        tmp_path / "many/metrics.csv"
    ).exists()


def test_the_trace_of_a_job_is_kept_where_it_is_asked_for(command, tmp_path: Path, monkeypatch):
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(SystemExit, match="0 failed"):
        command(
            *TRAIN, *SMALL, "-m", "task=cart", "algo=sac", "learning.batch_size=100000", "out=many"
        )
    assert "Traceback" in (tmp_path / "many/0/error.txt").read_text()


def test_the_experiments_of_the_paper_share_what_both_need(command, tmp_path: Path, capsys):
    """One folder a system and seed, on all three tasks; what is there is left alone, whichever experiment made it."""
    small = (*SMALL, *EMPTY, "frames=8", "evaluation.episodes=3", "seed=0")
    command(*TRAIN, *small, "experiment=paper_comparison", "algo=sac,rsac")
    command(*TRAIN, *small, "experiment=paper_ablation", "algo=sac,arsac_unprojected")
    assert "paper/sac/seed0 is there already" in capsys.readouterr().out
    runs = {path.parent.relative_to(tmp_path).as_posix() for path in tmp_path.rglob(CONFIG)}
    assert runs == {f"paper/{algo}/seed0" for algo in ("sac", "rsac", "arsac_unprojected")}
    for run in runs:
        lines = (tmp_path / run / "evaluation/episodes.csv").read_text().splitlines()
        assert [line.split(",")[2][:2] for line in lines[1:]] == ["lt", "gs", "rt"]


@pytest.mark.parametrize("name", ["paper_comparison", "paper_ablation"])
def test_an_experiment_of_the_paper_sweeps_its_systems_and_seeds(name: str):
    swept = OmegaConf.load(Path(config_dir()) / f"experiment/{name}.yaml").hydra.sweeper.params
    systems = {
        "paper_comparison": "arsac asac rsac sac sac_lag sac_rs ppo_rs cpo",
        "paper_ablation": "arsac arsac_unprojected asac rsac sac",
    }[name]
    assert swept.algo.split(",") == systems.split()
    assert swept.get("seed", "0,1,2,3,4") == "0,1,2,3,4"


@pytest.mark.slow
def test_a_sweep_on_a_cluster(command, tmp_path: Path):
    """By submitit, which starts each job as on Slurm: folders, failures and repetitions are those of any other sweep."""
    pytest.importorskip("submitit")
    small = [setting for setting in SMALL if "batch_size" not in setting]
    many = (*TRAIN, *small, "task=cart", "algo=sac", "out=many", "-m", "hydra/launcher=submitit_local")  # fmt: skip
    with pytest.raises(SystemExit, match="^error: many/learning.batch_size-100000 failed; each"):
        command(*many, "learning.batch_size=8,100000")
    bad, good = (tmp_path / f"many/learning.batch_size-{size}" for size in (100000, 8))
    assert "got 64 and 100000" in (bad / "error.txt").read_text()
    made = (good / "evaluation/metrics.json").stat().st_mtime_ns
    command(*many, "learning.batch_size=8,16")
    assert (good / "evaluation/metrics.json").stat().st_mtime_ns == made
    assert (tmp_path / "many/learning.batch_size-16/evaluation/metrics.json").is_file()
    said = "".join(path.read_text() for path in tmp_path.glob("many/.submitit/*/*_log.out"))
    assert said.count(f"{good} is there already") == 1
    assert not list(tmp_path.glob(".failures-*"))
