"""The training loop and its wiring, part by part."""

from __future__ import annotations

import csv
import math
import re
from pathlib import Path

import hydra
import pytest
import torch
from omegaconf import OmegaConf
from small import EMPTY, SMALL, compose
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import RewardSum, TransformedEnv
from trainers import collect, trainer_of

from saferl.algorithms import assemble
from saferl.algorithms.assemble import build_trainer
from saferl.algorithms.base import STORED
from saferl.checkpoint.run import CONFIG
from saferl.cli import train as commands
from saferl.config.locate import config_dir
from saferl.envs.intersection import BatchedIntersection, Scenario
from saferl.envs.intersection.drivers import CautiousDriver, Driver
from saferl.training.experience import Epochs, Replay
from saferl.training.learner import Learner
from saferl.training.progress import Budget
from saferl.training.records import EpisodeWindow
from saferl.training.trainer import Trainer


def test_budget():
    assert Budget(frames=200).spent(frames=50, episodes=3) == 0.25
    assert Budget(episodes=4).spent(frames=50, episodes=9) == 1.0
    for wrong in ({}, {"episodes": 1, "frames": 1}):
        with pytest.raises(ValueError, match="Give one budget"):
            Budget(**wrong)
    with pytest.raises(ValueError, match="episodes must be >= 1, got 0"):
        Budget(episodes=0)


def test_random_warm_up_differs_between_environments(tmp_path: Path):
    """A peer drew one action for all (docs/pitfalls.md, 1)."""
    trainer = trainer_of(tmp_path, "env.num_envs=6", "algo=sac")
    action = collect(trainer, 1)[0]["action"]
    assert len(action.reshape(-1, 2).unique(dim=0)) == 6
    assert action.abs().max() <= 1 and action.std() > 0.2


def test_a_row_tells_how_often_the_projector_acted(tmp_path: Path):
    """The share of all decisions since the row before, whoever made them."""
    trainer = trainer_of(tmp_path, "algo=rsac", "projector.limit=0.0", "projector.start=0")
    for parameter in trainer.learner.loss.parameters():  # before the first update all risks are 0
        torch.nn.init.normal_(parameter, std=0.1)
    data = collect(trainer, 3)
    trainer._record(data[-1])
    acted = torch.stack([batch["next", "intervened"] for batch in data]).float().mean()
    assert acted > 0 and trainer.metrics.read()[0]["intervention_rate"] == pytest.approx(acted)
    trainer._record(collect(trainer, 1)[-1])
    assert "intervention_rate" in trainer.metrics.read()[1]
    (tmp_path / "without").mkdir()
    without = trainer_of(tmp_path / "without", "algo=sac")
    without._record(collect(without, 1)[-1])
    assert "intervention_rate" not in without.metrics.read()[0]


def test_demonstrations_fill_the_buffer_before_the_first_frame(tmp_path: Path):
    options = (
        "algo=arsac",
        "learning.demonstrations=101",
        "learning.buffer_size=200",
        "episodes=null",
        "frames=8",
    )
    trainer = build_trainer(compose(*SMALL, *options, "env.num_envs=2"), tmp_path)
    shown = trainer.experience.demonstrate()
    assert 101 <= len(shown) < 101 + 2 * trainer.collector.env.batch_size[0]
    # The mean error of the noise alone is 0.16.
    for half, driver in zip(
        shown.split(len(shown) // 2), (CautiousDriver(), Driver()), strict=True
    ):
        error = half["action"] - driver(half.clone())["action"]
        assert 0.1 < error.abs().mean() < 0.18
    trainer.experience.demonstrate = lambda: shown
    trainer.train()
    stored = trainer.experience.buffer[:]
    assert len(stored) == len(shown) + 8 and trainer.progress.frames == 8
    for key in ("action", ("next", "cost"), ("next", "ego")):
        assert torch.equal(stored[key][: len(shown)], shown[key])


def test_the_papers_order_with_and_without_a_temperature(tmp_path: Path):
    """What has no temperature has no stage for one."""
    trainer = trainer_of(tmp_path, "algo=sac", "learning.update_order=sequential", "env.num_envs=4")
    trainer.train()
    assert trainer.progress.updates and len(trainer.learner.stages) == 3
    ppo = trainer_of(tmp_path, "algo=ppo").learner
    assert len(Learner(ppo.loss, ppo.optimizer, order="sequential").stages) == 2


def test_an_epoch_leaves_its_rest(tmp_path: Path):
    """A few samples would weigh as much as a whole mini-batch, and be standardised by themselves."""
    trainer = trainer_of(
        tmp_path,
        "algo=ppo",
        "learning.rollout_frames=20",
        "learning.batch_size=8",
        "learning.epochs=10",
    )
    batches = list(trainer.experience.batches(next(iter(trainer.collector)), 20))
    assert [len(batch) for batch in batches] == [8, 8] * 10
    rows = torch.cat([batch["action"] for batch in batches[:2]])
    assert len(rows.unique(dim=0)) == 16


def test_threads_are_as_many_as_are_asked_for(tmp_path: Path):
    """One by default, not all that a machine has (docs/pitfalls.md, 14)."""
    assert compose().threads == 1
    for threads in (2, 1):
        trainer_of(tmp_path, "algo=sac", f"threads={threads}")
        assert torch.get_num_threads() == threads


def test_updates_follow_the_frames(tmp_path: Path):
    trainer = trainer_of(
        tmp_path, "algo=sac", "learning.updates_per_frame=0.75", "learning.warmup_frames=7"
    )
    counts = []
    for _ in range(8):
        collect(trainer, 1)
        counts.append(trainer.progress.updates)
    # Two frames a batch; from the fourth batch (8 frames) on, 1.5 updates each.
    assert counts == [0, 0, 0, 1, 3, 4, 6, 7]


def test_a_budget_that_ends_before_the_first_update_is_said(tmp_path: Path, caplog):
    for share, said in (("0.1", True), ("1.0", False)):
        (folder := tmp_path / share).mkdir()
        trainer = trainer_of(folder, "algo=sac", "frames=8", f"learning.updates_per_frame={share}")
        trainer.train()
        assert any("Nothing was learned" in message for message in caplog.messages) is said
        assert (trainer.progress.updates == 0) is said
        caplog.clear()


def test_learning_rates_are_linear_in_the_budget(tmp_path: Path):
    trainer = trainer_of(
        tmp_path, "algo=arsac", "learning.lr.actor=[1e-2,2e-3]", "learning.lr.critic=[1e-3,1e-3]"
    )
    trainer.learner.schedule(0.25)
    rates = {group["name"]: group["lr"] for group in trainer.learner.optimizer.param_groups}
    assert rates == pytest.approx({"actor": 8e-3, "critic": 1e-3, "alpha": 3e-4})
    held = [id(p) for group in trainer.learner.optimizer.param_groups for p in group["params"]]
    assert sorted(held) == sorted(id(p) for p in trainer.learner.loss.parameters())
    assert len(set(held)) == len(held)


def test_the_last_batch_is_learned_from(tmp_path: Path):
    """A rate that falls to 0 is what was spent when a batch was begun, not when it is there."""
    options = (
        "algo=ppo",
        "learning.rollout_frames=8",
        "env.num_envs=4",
        "frames=8",
        "learning.lr.actor=[1e-2,0]",
    )
    trainer = trainer_of(tmp_path, *options)
    weights = trainer.learner.loss.actor_network_params.clone()
    trainer.train()
    assert trainer.progress.frames == 8
    assert (trainer.learner.loss.actor_network_params != weights).any()
    assert trainer.metrics.read()[-1]["lr_actor"] == 1e-2


def test_an_update_moves_everything_that_learns(tmp_path: Path):
    trainer = trainer_of(
        tmp_path, "algo=arsac", "learning.tau=0.25", "lagrange.multiplier.init=2.0"
    )
    collect(trainer, 3)
    loss = trainer.learner.loss
    before = {name: value.clone() for name, value in loss.state_dict().items() if _tensor(value)}
    trainer.learner.schedule(0.0)
    trainer.learner.update(costly(trainer))
    after = loss.state_dict()
    for kind in ("actor_network", "qvalue_network", "cost_critic"):
        names = [name for name in before if name.startswith(f"{kind}_params")]
        assert any(not torch.equal(before[name], after[name]) for name in names), kind
    assert before["log_alpha"] != after["log_alpha"]
    for name, value in before.items():
        live = name.removeprefix("target_")
        if name.startswith("target_") and value.is_floating_point():
            torch.testing.assert_close(after[name], 0.75 * value + 0.25 * after[live])
    # The policy that collects is the one that learns.
    learned = {parameter.data_ptr() for parameter in loss.parameters()}
    assert {parameter.data_ptr() for parameter in trainer.collector.policy.parameters()} <= learned


def costly(trainer: Trainer) -> TensorDict:
    """A batch with a cost, of which an empty road has none."""
    batch = trainer.experience.buffer.sample()
    return batch.set(("next", "cost"), torch.rand(batch["next", "cost"].shape))


def _tensor(value) -> bool:
    return isinstance(value, torch.Tensor)


def test_projector_reads_the_live_critics(tmp_path: Path):
    trainer = trainer_of(tmp_path, "algo=rsac")
    collect(trainer, 3)
    projector = trainer.collector.env.transform[-1]
    batch = costly(trainer)
    before = projector.risk(batch.copy())["state_action_cost_value"].clone()
    trainer.learner.update(batch)
    assert not torch.equal(before, projector.risk(batch.copy())["state_action_cost_value"])


def always_risky(trainer: Trainer) -> None:
    risk = TensorDictModule(lambda action: action[..., :1] + 2, ["action"], ["risk"])
    trainer.collector.env.transform[-1].risk = risk


def test_projector_starts_when_it_is_told(tmp_path: Path):
    trainer = trainer_of(tmp_path, "algo=rsac", "projector.start=0.5", "projector.penalty=100")
    always_risky(trainer)
    moved = [bool(data["next", "intervened"].any()) for data in collect(trainer, 12)]
    assert moved == [False] * 6 + [True] * 6  # half of 24 frames, two a batch


def test_buffer_keeps_the_executed_action_and_unscaled_reward(tmp_path: Path):
    options = ("algo=rsac", "risk_limit=0", "learning.reward_scale=0.1", "projector.start=0")
    trainer = trainer_of(tmp_path, *options)
    always_risky(trainer)
    data = torch.cat([each.reshape(-1) for each in collect(trainer, 3)])
    rows = trainer.experience.buffer.storage[:6]
    assert torch.equal(rows["action"], data["next", "action_executed"])
    assert torch.equal(rows["action_proposed"], data["action"])
    assert (rows["action"] != rows["action_proposed"]).any()
    assert torch.equal(rows["next", "reward"], data["next", "reward"])
    sample = trainer.experience.buffer.sample()
    stored = rows["next", "reward"][sample["index"].flatten()]
    torch.testing.assert_close(sample["next", "reward"], 0.1 * stored)


@pytest.mark.parametrize("late", [0, 1])
def test_an_end_on_the_last_step_does_not_bootstrap(late: int):
    """Success on the very step of the time limit is stored as terminated (docs/pitfalls.md, 2); one step less
    and it is truncated alone, which the environment's own flag says (docs/pitfalls.md, 12)."""
    free = BatchedIntersection(Scenario(task="rt", vehicles=0), num_envs=1, seed=3)
    steps = free.rollout(125, Driver()).shape[-1]
    scenario = Scenario(task="rt", vehicles=0, duration=(steps - late) / 5, observation="world")
    env = TransformedEnv(
        BatchedIntersection(scenario, num_envs=1, seed=3),
        RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"]),
    )
    data = next(iter(Collector(env, Driver(), frames_per_batch=steps + 1, total_frames=-1)))[0]
    last = steps - late - 1
    assert data["next", "done"].flatten().nonzero().flatten().tolist()[0] == last
    assert bool(data["next", "truncated"][last])
    assert bool(data["next", "terminated"][last]) == (late == 0)
    stored = data.select(*STORED, strict=False)
    assert torch.equal(stored["next", "terminated"], data["next", "terminated"])
    # The final observation is the end of the road, not the start of the next episode.
    ends, starts = data["next", "ego"][last], data["ego"][last + 1]
    assert ends[1] > 30 and starts[2] > 40  # far east; far south
    assert data["next", "episode_reward"][last] == pytest.approx(
        float(data["next", "reward"][: last + 1].sum()), rel=1e-5
    )
    assert data["episode_reward"][last + 1] == 0


def test_records(tmp_path: Path):
    """Rows at the frames they are due, means of what lies between, no wall-clock among them."""
    trainer = trainer_of(tmp_path, "algo=arsac", "record_every=10", "logger=tensorboard")
    means: dict[str, list[float]] = {"loss_qvalue": []}
    add = trainer.means.add
    trainer.means.add = lambda name, value: (
        means.setdefault(name, []).append(float(value)),
        add(name, value),
    )
    trainer.train()
    with (tmp_path / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frames"]) for row in rows] == [10, 20, 24]
    assert {"return", "cost_return", "collision_rate", "success_rate", "lr_actor"} < rows[0].keys()
    assert not any("second" in key or "time" in key for key in rows[0])
    first = means["loss_qvalue"][: int(rows[0]["updates"])]
    assert float(rows[0]["loss_qvalue"]) == pytest.approx(sum(first) / len(first), rel=1e-5)
    assert int(rows[-1]["updates"]) == len(means["loss_qvalue"])
    with (tmp_path / "timing.csv").open() as file:
        timing = list(csv.DictReader(file))
    assert all(float(row["collect"]) > 0 for row in timing) and len(timing) == 3

    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    scalars = events.Scalars("loss_actor")
    assert [event.step for event in scalars] == [10, 20, 24]
    assert scalars[-1].value == pytest.approx(float(rows[-1]["loss_actor"]), rel=1e-5)


def test_no_episode_need_end(tmp_path: Path):
    """docs/pitfalls.md, 10."""
    trainer = trainer_of(tmp_path, "algo=sac_lag")
    trainer.window = EpisodeWindow()
    trainer.train()
    with (tmp_path / "metrics.csv").open() as file:
        row = next(csv.DictReader(file))
    assert row["episodes"] == "0" and math.isnan(float(row["return"]))


@pytest.mark.parametrize(
    ("name", "value"),
    [("updates_per_frame", -1), ("warmup_frames", 0), ("record_every", 0), ("save_every", 0)],
)
def test_trainer_refuses(name: str, value: int, tmp_path: Path):
    ours = trainer_of(tmp_path, "algo=sac")
    names = ("run", "collector", "experience", "learner", "budget")
    parts = {key: getattr(ours, key) for key in names}
    buffer = ours.experience.buffer
    with pytest.raises(ValueError, match=f"{name} must be >= "):
        if name.endswith("_every"):
            Trainer(**parts, **{name: value})
        else:
            Replay(buffer, STORED, **{name: value})
    with pytest.raises(ValueError, match="save_minutes must be null or > 0, got 0"):
        Trainer(**parts, save_minutes=0)
    with pytest.raises(ValueError, match="epochs must be >= 1, got 0"):
        Epochs(buffer, STORED, begin=print, epochs=0)


def test_two_runs_that_start_at_once_do_not_share_a_folder(refusal, monkeypatch, tmp_path: Path):
    def complete(node):
        task = assemble.complete(node)
        commands.claim(tmp_path / "run", OmegaConf.create({"seed": 7}))  # faster by a moment
        return task

    monkeypatch.setattr(commands, "complete", complete)
    line = refusal("train", "config", *SMALL, *EMPTY, "algo=sac", "out=run")
    assert "run holds a run already; it has just begun, or was killed before" in line
    assert [path.name for path in (tmp_path / "run").iterdir()] == [CONFIG]
    assert "seed: 7\n" in (tmp_path / "run" / CONFIG).read_text()


def test_default_folders_tell_microseconds():
    with hydra.initialize_config_dir(config_dir(), version_base="1.3"):
        made = hydra.compose("config", return_hydra_config=True).hydra
    for folder in (made.run.dir, made.sweep.dir):
        assert re.search(r"/\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d-\d{6}$", folder), folder
