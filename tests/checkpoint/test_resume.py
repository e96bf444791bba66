"""A run that was killed and continued is the run that was not."""

from __future__ import annotations

import shutil
import signal
import time
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from small import EMPTY, SMALL, compose
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensordict import TensorDict

from saferl.algorithms.assemble import build_trainer
from saferl.checkpoint.run import CONFIG
from saferl.training.trainer import Trainer

TRAFFIC = ("env=highway", "task.vehicles=3", "task=gs", "task.duration=6")


def everything(trainer: Trainer) -> dict:
    """All state of a run but for its wall-clock, as nested dicts."""
    parts = trainer.checkpoint.checkpoint.components
    return {
        name: part.state_dict() for name, part in parts.items() if name not in ("clock", "files")
    }


def assert_same(ours, theirs, at: str = "") -> None:
    if hasattr(ours, "items"):
        assert list(ours) == list(theirs), at
        for key in ours:
            assert_same(ours[key], theirs[key], f"{at}.{key}")
    elif isinstance(ours, (list, tuple)):
        assert len(ours) == len(theirs), at
        for index, (one, other) in enumerate(zip(ours, theirs, strict=True)):
            assert_same(one, other, f"{at}[{index}]")
    elif hasattr(ours, "shape"):
        assert ours.dtype == theirs.dtype and ours.shape == theirs.shape, at
        # NaN is equal to itself here, bit for bit is what is meant.
        assert ((ours == theirs) | ((ours != ours) & (theirs != theirs))).all(), at
    else:
        assert ours == theirs, at


def restored(run: Path, *overrides: str) -> Trainer:
    trainer = build_trainer(compose(*overrides), run)
    trainer.resume()
    return trainer


def test_resume_does_not_need_the_run_that_it_began_from(tmp_path: Path):
    first, second = tmp_path / "first", tmp_path / "second"
    options = (*SMALL, *EMPTY, "algo=sac")
    first.mkdir()
    OmegaConf.save(compose(*options), first / CONFIG, resolve=True)
    build_trainer(compose(*options), first).train()
    options = (*options, f"init={first}")
    trained = build_trainer(compose(*options), second)
    trained.train()
    shutil.rmtree(first)
    assert_same(everything(restored(second, *options)), everything(trained))


@pytest.mark.parametrize(
    "algo",
    [
        "arsac",
        pytest.param("sac", marks=pytest.mark.slow),
        pytest.param("ppo_lag", marks=pytest.mark.slow),
    ],
)
def test_killed_and_resumed_equals_uninterrupted(algo: str, tmp_path: Path, spawn):
    """SIGKILL in mid-episode on highway-env with traffic, a projector at work in ``arsac``."""
    options = [*SMALL, *TRAFFIC, f"algo={algo}", "frames=48", "save_every=4"]
    options += ["learning.batch_size=2", "learning.rollout_frames=4"] if algo == "ppo_lag" else []
    if (
        algo == "arsac"
    ):  # rectangles that overlap now, so that there is a cost to learn and to avoid
        options += ["projector.steps=7", "projector.limit=-1", "+task.cost.growth=[4,8]"]
    killed = spawn("saferl", *options, "out=killed")
    # Half of the run or so: where exactly it dies must not matter.
    while not list((tmp_path / "killed/checkpoints").glob("checkpoint-*0[23]?")):
        assert killed.poll() is None, killed.communicate()
        time.sleep(0.01)
    killed.send_signal(signal.SIGKILL)
    assert killed.wait() == -signal.SIGKILL

    whole = spawn("saferl", *options, "out=whole")
    resumed = spawn("saferl", "resume=killed")
    for process, word in ((resumed, "Resumed"), (whole, "Files")):
        out, err = process.communicate(timeout=600)
        assert process.returncode == 0 and word in out, err

    one, other = (restored(tmp_path / name, *options) for name in ("whole", "killed"))
    assert one.progress.frames == 48 and one.progress.updates > 10
    assert_same(everything(one), everything(other))
    if algo != "ppo_lag":
        assert len(one.experience.buffer) == 48  # a true buffer was compared
    if algo == "arsac":
        rows = one.experience.buffer[:]
        assert (rows["action"] != rows["action_proposed"]).any()
    for name in ("metrics.csv", "evaluation/episodes.csv", "evaluation/metrics.json"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "killed" / name).read_bytes()


@pytest.mark.parametrize(
    ("algo", "vehicles", "scenario"),
    [
        pytest.param("sac_lag", 0, "nominal", marks=pytest.mark.slow),
        ("rsac", 5, "dense"),
        ("ppo_lag", 0, "dense"),
        ("cpo", 0, "nominal"),
        ("sac", 3, "dense"),  # behind a shield, which has nothing to remember
    ],
)
def test_every_later_step_is_the_same(algo: str, vehicles: int, scenario: str, tmp_path: Path):
    """In one process: the state after a resume equals the state that was saved, and so does each
    update, action and environment step from there, with a multiplier, a late projector, a PID's
    memory, a buffer that has wrapped round, and loss sums of half a row."""
    frames = 240 if algo in ("ppo_lag", "cpo") else 120
    options = [*SMALL, *EMPTY, f"algo={algo}", f"frames={frames}", "record_every=31"]
    fresh = algo in ("ppo_lag", "cpo")
    options += ["learning.rollout_frames=24" if fresh else "learning.buffer_size=40"]
    options += ["save_every=1000", "task.duration=3"]
    options += [f"task.vehicles={vehicles}", f"task.scenario={scenario}"]
    options += ["projector.start=0.4", "lagrange=pid"] if algo == "rsac" else []
    options += ["projector=shield", "projector.horizon=1"] if algo == "sac" else []
    trainer = build_trainer(compose(*options), tmp_path / "a")
    trainer.save()
    batches = iter(trainer.collector)
    while trainer.spent < 0.45:
        data = next(batches)
        trainer._take(data)
        if trainer.progress.frames - trainer.progress.last_record >= trainer.record_every:
            trainer._record(data)
    trainer.save()
    assert trainer.means.counts and trainer.progress.episodes

    copy = restored(tmp_path / "a", *options)
    assert_same(everything(trainer), everything(copy))
    ours, theirs = (one.collector._carrier for one in (trainer, copy))
    for key in ("ego", "vehicles"):  # a matrix product may round otherwise in another layout
        assert ours[key].stride() == theirs[key].stride()
    rng = trainer.checkpoint.checkpoint.components["rng"]
    state = rng.state_dict()
    before = trainer.progress.updates
    trainer.train()
    assert trainer.progress.updates >= before + 20  # there was something left to differ in
    rng.load_state_dict(state)
    copy.train()
    assert_same(everything(trainer), everything(copy))


def test_progress_is_shown_from_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    options = [*SMALL, *EMPTY, "algo=sac"]
    trainer = build_trainer(compose(*options), tmp_path)
    batches = iter(trainer.collector)
    for _ in range(5):
        trainer._take(next(batches))
    trainer.save()

    shown = []

    def bar(*args, **kwargs):
        shown.append(kwargs)
        return real(*args, **kwargs)

    import saferl.training.trainer

    real = saferl.training.trainer.bar
    monkeypatch.setattr(saferl.training.trainer, "bar", bar)
    restored(tmp_path, *options).train()
    assert shown[0]["initial"] == 10 and shown[0]["total"] == 24


def test_resuming_a_finished_run_changes_nothing(tmp_path: Path, command, caplog):
    command("train", "config", *SMALL, *EMPTY, "algo=sac", "out=run")
    kept = ("metrics.csv", "config.yaml", "evaluation/metrics.json", "evaluation/episodes.csv")
    before = {name: (tmp_path / "run" / name).read_bytes() for name in kept}
    checkpoints = sorted((tmp_path / "run/checkpoints").iterdir())
    command("train", "config", "resume=run")
    assert {name: (tmp_path / "run" / name).read_bytes() for name in kept} == before
    assert sorted((tmp_path / "run/checkpoints").iterdir()) == checkpoints


def test_a_run_killed_before_its_first_episode_can_be_resumed(tmp_path: Path):
    """A checkpoint is there from the first frame on."""
    options = [*SMALL, *EMPTY, "algo=sac"]
    trainer = build_trainer(compose(*options), tmp_path)
    trainer.save()
    copy = restored(tmp_path, *options)
    assert copy.progress.frames == 0 and len(copy.experience.buffer) == 0
    copy.train()
    assert copy.progress.frames == 24 and isinstance(copy.experience.buffer[:], TensorDict)


def test_a_checkpoint_by_the_clock_changes_nothing(tmp_path: Path):
    """Due long before ``save_every`` frames; the run is the one that was never saved on the way."""
    runs, saved = {}, {}
    for minutes in ("1e-9", "null"):
        cfg = compose(*SMALL, *EMPTY, "algo=rsac", "task.duration=1", f"save_minutes={minutes}")
        trainer = runs[minutes] = build_trainer(cfg, tmp_path / minutes)
        frames = saved[minutes] = []
        save = trainer.checkpoint.save
        trainer.checkpoint.save = lambda at, about, f=frames, s=save: (f.append(at), s(at, about))
        trainer.train()
    assert saved == {"1e-9": list(range(0, 25, 2)), "null": [0, 24]}
    assert_same(everything(runs["1e-9"]), everything(runs["null"]))


def events(run: Path, key: str) -> list[tuple[int, float]]:
    """Steps and values that TensorBoard shows."""
    shown = EventAccumulator(str(run / "tensorboard")).Reload()
    return [(event.step, event.value) for event in shown.Scalars(key)]


@pytest.mark.parametrize("save_every", [pytest.param(12, marks=pytest.mark.slow), 1000])
def test_tensorboard_shows_a_resumed_run_once(save_every: int, tmp_path: Path):
    """What came after the checkpoint is hidden, even where that was before the first row."""
    options = [*SMALL, *EMPTY, "algo=sac", "logger=tensorboard", f"save_every={save_every}"]
    killed = build_trainer(compose(*options), tmp_path / "killed")
    record = killed._record

    def die(data):
        record(data)
        if killed.progress.frames >= 16:
            raise InterruptedError

    killed._record = die
    with pytest.raises(InterruptedError):
        killed.train()
    assert [step for step, _ in events(tmp_path / "killed", "updates")] == [8, 16]
    restored(tmp_path / "killed", *options).train()
    build_trainer(compose(*options), tmp_path / "whole").train()
    for key in ("updates", "loss_actor"):
        shown = events(tmp_path / "killed", key)
        assert [step for step, _ in shown] == [8, 16, 24]
        assert shown == events(tmp_path / "whole", key)


def test_a_logger_that_opens_is_told_every_row(tmp_path: Path):
    """Even those that a kill kept from its files, or, as W&B does, when it begins a new run."""
    told: list[tuple[str, int]] = []

    class Sink:
        experiment = None

        def log_scalar(self, key: str, value: float, step: int) -> None:
            told.append((key, step))

    options = [*SMALL, *EMPTY, "algo=sac"]
    build_trainer(compose(*options), tmp_path).train()
    copy = restored(tmp_path, *options)
    copy.open_loggers = lambda: [Sink()]
    copy.train()
    assert [step for key, step in told if key == "updates"] == [8, 16, 24]


def test_loggers_open_when_training_starts(tmp_path: Path, refusal, monkeypatch):
    """A refused resume leaves no logger's folder, and a logger that cannot open leaves no run."""
    options = (*SMALL, *EMPTY, "algo=sac", "logger=tensorboard")
    run = tmp_path / "run"
    build_trainer(compose(*options), run)
    assert not run.exists()
    run.mkdir()
    OmegaConf.save(compose(*options), run / "config.yaml", resolve=True)
    assert "holds no checkpoint" in refusal("train", "config", "resume=run")
    assert sorted(path.name for path in run.iterdir()) == [".lock", "config.yaml"]

    def missing(*args, **kwargs):
        raise ImportError("no tensorboard")

    monkeypatch.setattr("torchrl.record.loggers.TensorboardLogger", missing)
    line = refusal("train", "config", *options, "out=new")
    assert "TensorboardLogger needs a package that is not installed (no tensorboard)" in line
    assert not (tmp_path / "new").exists()


def test_a_finished_run_goes_on_with_a_larger_budget(tmp_path: Path, command, refusal):
    """As if it had had it from the start, but for schedules, which are those of the larger one from there on."""
    rates = [f"learning.lr.{name}=[1e-3,1e-3]" for name in ("actor", "critic", "alpha")]
    options = (*SMALL, "task=cart", "algo=sac", *rates)
    command("train", "config", *options, "frames=24", "out=run")
    assert "frames must be >= 24, the run's own, got 16" in refusal(
        "train", "config", "resume=run", "frames=16"
    )
    assert "other option than a larger frames=" in refusal(
        "train", "config", "resume=run", "episodes=99"
    )
    command("train", "config", "resume=run", "frames=48")
    command("train", "config", *options, "frames=48", "out=whole")
    run, whole = tmp_path / "run", tmp_path / "whole"
    for name in ("metrics.csv", "evaluation/episodes.csv"):
        assert (run / name).read_bytes() == (whole / name).read_bytes()
    assert OmegaConf.load(run / "config.yaml").frames == 48  # pyright: ignore
    states = [restored(path, *options, "frames=48") for path in (run, whole)]
    assert_same(*map(everything, states))
