"""Every option of every group composes, and every composition builds."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import yaml
from omegaconf import OmegaConf
from small import EMPTY, SMALL, compose

from saferl.algorithms.assemble import build_agent, build_trainer
from saferl.cli.evaluate import on_its_own_task
from saferl.config.check import arguments, check, fits
from saferl.config.limits import USUAL, check_limits, readers
from saferl.config.locate import config_dir
from saferl.modules import MeanStd, MLPPolicyEncoder, MMAMPolicyEncoder

ROOT = Path(config_dir())
OPTIONS = sorted(
    f"{path.parent.name}={path.stem}"
    for path in ROOT.glob("*/*.yaml")
    if path.parent.name not in ("hydra", "recipe")
)
ALGOS = sorted(path.stem for path in (ROOT / "algo").glob("*.yaml"))
#: What an option needs beside it.
LIMITS = ("cost_limit=1", "risk_limit=1")
BESIDE = {
    "task=gym": ("task.id=Pendulum-v1", "task.cost_key=null", *LIMITS),
    "task=cart": LIMITS,
    # Which say of themselves whose multiplier it is.
    "experiment=cart_profile": ("algo=ppo_lag",),
    "experiment=multiplier_profile": ("algo=ppo_lag",),
}
#: What starts processes, which tests/training does.
STARTING = ("collector=multi", "collector=ray")
#: Encoder, cost critics, multiplier's signal, projector, r_safe: the table of the paper.
PARTS = {
    "arsac": (MMAMPolicyEncoder, 2, "CriticSignal", True, False),
    "rsac": (MLPPolicyEncoder, 2, "CriticSignal", True, False),
    "asac": (MMAMPolicyEncoder, 0, None, False, False),
    "sac": (MLPPolicyEncoder, 0, None, False, False),
    "sac_rs": (MLPPolicyEncoder, 0, None, False, True),
    "sac_lag": (MLPPolicyEncoder, 2, "EpisodeSignal", False, False),
}


@pytest.mark.parametrize("option", [o for o in OPTIONS if o.startswith("algo=") or o in STARTING])
def test_option_composes_and_is_checked(option: str):
    """What is not built below, with the parts that it needs beside it, passes the check of what it says."""
    check(compose(option, *BESIDE.get(option, ())))


ROADS = {"task": ["gs", "lt", "mixed", "rt"], "env": ["batched", "highway", "sumo"]}


@pytest.mark.parametrize("option", [f"{group}={name}" for group in ROADS for name in ROADS[group]])
def test_option_of_the_evaluation(option: str):
    cfg = compose(option, config="evaluate")
    check(cfg)
    cfg = on_its_own_task(cfg, cfg, [option])
    assert cfg.task.policy_frequency == 10 and cfg.task.route_starts == 0.0
    assert cfg.task.standstill is None and not cfg.task.reward.get("risk_shaping", False)
    assert {"checkpoint", "pretrained", "policy", "episodes", "seed", "out"} <= set(cfg)


def test_help_of_the_evaluation_lists_its_choices():
    template = yaml.safe_load((ROOT / "evaluate.yaml").read_text())["hydra"]["help"]["template"]
    for group, choices in ROADS.items():
        assert f"{group}: {', '.join(choices)}\n" in template


def test_every_file_is_an_option_of_a_known_group():
    groups = {path.name for path in ROOT.iterdir() if path.is_dir()}
    assert groups == {
        "algo", "collector", "cost_critic", "critic", "encoder", "env", "experiment", "hydra", "lagrange",
        "learning", "logger", "loss", "projector", "recipe", "risk", "shaping", "task",
        "transform",
    }  # fmt: skip
    assert not list(ROOT.rglob("__init__.py"))  # a package of YAML would be shipped as code
    assert set(ALGOS) >= set(PARTS)


def test_every_recipe_is_of_two_choices_that_there_are():
    """A pair without a file changes nothing, so that a misspelt one would do nothing without a word."""
    groups = {"task": ("task", "learning"), "experiment": ("experiment", "learning")}
    for path in (ROOT / "recipe").glob("*/*.yaml"):
        one, other = groups.get(path.parent.name, path.parent.name.split("_"))
        pairs = {
            f"{a.stem}_{b.stem}" for a in (ROOT / one).iterdir() for b in (ROOT / other).iterdir()
        }
        assert path.stem in pairs, path
        defaults = OmegaConf.load(ROOT / "config.yaml").defaults
        assert {f"optional recipe/{path.parent.name}": f"${{{one}}}_${{{other}}}"} in defaults


#: What ARSAC refuses, and the reason.
REFUSED = {
    "cost_critic=none": "needs cost_critic, got cost_critic=none",
    "env=cart": "plays a Cart, but task=gs is a Scenario",
    "env=gym": "plays a GymTask, but task=gs is a Scenario",
    "experiment=cart": "reads ego, vehicles, but task=cart observes observation",
    "experiment=speed": r"but task=\S+ observes observation|cannot be made: .*(No module|not installed)",
    "learning=on_policy": "OnPolicy learns by losses with a critic_network, which .*SACLagLoss has not",
    "lagrange=none": "needs lagrange, got lagrange=none",
    **{
        f"loss={name}": "OffPolicy learns by losses with a qvalue_network"
        for name in ("cat", "cpo", "crpo", "focops", "p3o", "ppo", "ppo_lag", "ppo_risk")
    },
    "risk=none": "needs risk, got risk=none",
    "loss=sac": "takes no cost_critic",
    "risk=cvar": "risk=cvar is of quantiles: set cost_critic=quantile",
    "task=cart": "reads ego, vehicles, but task=cart observes observation",
    "task=gym": r"reads ego, vehicles, but task=\S+ observes observation",
}


@pytest.mark.parametrize(
    "option", [o for o in OPTIONS if not o.startswith("algo=") and o not in STARTING]
)
def test_option_builds_or_is_refused_with_the_reason(option: str, tmp_path: Path):
    """Each option of each group, one at a time, in place of ARSAC's own."""
    cfg = compose(*SMALL, option, *BESIDE.get(option, ()))
    if option in REFUSED:
        with pytest.raises(ValueError, match=REFUSED[option]):
            build_trainer(cfg, tmp_path)
        return
    build_trainer(cfg, tmp_path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("algo=cpo", "+cost_critic.outputs=16"), "cost_critic.outputs is of action values"),
        (("algo=ppo", "+critic.layer_norm=true"), "critic.layer_norm is of action values"),
        (("algo=sac_lag", "loss.cost_backup=reach"), "EpisodeSignal limits the summed cost"),
    ],
)
def test_an_option_that_nothing_would_read_is_refused(options, message: str, tmp_path: Path):
    with pytest.raises(ValueError, match=message):
        build_trainer(compose(*SMALL, *EMPTY, *options), tmp_path)


@pytest.mark.parametrize("encoder", ["mmam", "mlp"])
def test_critics_are_built_as_their_options_say(encoder: str):
    """Also where an option equals another's usual value, as True does 1."""

    def critics(*options: str):
        loss = build_agent(compose(*SMALL, "algo=arsac", f"encoder={encoder}", *options)).loss
        return loss.qvalue_network.module, loss.cost_critic.module

    assert not any(critic.layer_norm for critic in critics())
    for option in ("critic.layer_norm=true", "cost_critic.layer_norm=true"):
        assert sum(critic.layer_norm for critic in critics(option)) == 1
    plain, quantiles = critics("cost_critic=quantile")
    scene = torch.zeros(3, 12), torch.zeros(3, 11, 12), torch.zeros(3, 2)
    assert plain(*scene).shape == (3, 1) and quantiles(*scene).shape == (3, 16)


@pytest.mark.parametrize("algo", ["sac_lag", "ppo_lag"])
@pytest.mark.parametrize("lagrange", ["episode", "pid"])
def test_every_multiplier_of_episodes_goes_with_every_loss(algo, lagrange, tmp_path: Path):
    cfg = compose(*SMALL, *EMPTY, f"algo={algo}", f"lagrange={lagrange}")
    build_trainer(cfg, tmp_path).train()


@pytest.mark.parametrize("algo", ALGOS)
def test_what_a_task_has_not_is_refused(algo: str, tmp_path: Path):
    """A shaped reward and a scene belong to the road; all else goes with a cart, too."""
    cfg = compose(*SMALL, f"algo={algo}", "task=cart", *LIMITS)
    shaped, scene = cfg.task.get("reward"), cfg.encoder._target_.endswith((".MMAM", ".MaxPool"))
    if not shaped and not scene:
        build_trainer(cfg, tmp_path)
        return
    reason = "set shaping=none" if shaped else "reads ego, vehicles, but task=.* set encoder=mlp"
    with pytest.raises(ValueError, match=reason):
        build_trainer(cfg, tmp_path)


@pytest.mark.parametrize("algo", sorted(PARTS))
def test_composition_is_the_papers(algo: str):
    encoder, cost_critics, signal, projector, shaping = PARTS[algo]
    cfg = compose(f"algo={algo}", "encoder.width=16")
    agent = build_agent(cfg)
    assert cfg.algo_name == algo
    assert isinstance(next(m for m in agent.actor.modules() if isinstance(m, encoder)), encoder)
    assert cfg.cost_critic.members == cost_critics
    assert hasattr(agent.loss, "lagrange") == (signal is not None)
    assert signal is None or cfg.lagrange.signal._target_.endswith(signal)
    assert (agent.projector is not None) == projector
    assert cfg.task.reward.get("risk_shaping", False) == shaping


def test_arsac_plus_is_arsac_with_another_risk():
    ours, papers = compose("algo=arsac_plus"), compose("algo=arsac")
    differ = {key for key in papers if ours[key] != papers[key]}
    assert differ == {"algo_name", "cost_critic", "risk", "loss"}  # loss.risk is risk
    assert isinstance(build_agent(ours).loss.risk, MeanStd) and ours.cost_critic.members == 4


@pytest.mark.parametrize(
    ("algo", "read"),
    [
        *((algo, {"risk_limit"}) for algo in ("arsac", "arsac_plus", "arsac_signed", "rsac")),
        *((algo, {"cost_limit"}) for algo in ("sac_lag", "sac_pid", "ppo_lag", "cpo")),
        *((algo, {"cost_limit"}) for algo in ("ppo_pid", "p3o", "focops", "crpo", "ppo_saute")),
        ("arppo", {"cost_limit", "risk_limit"}),
        *((algo, set()) for algo in ("sac", "sac_rs", "asac", "ppo", "ppo_rs", "cat")),
    ],
)
def test_limits_mean_one_thing(algo: str, read: set[str], caplog):
    """On an episode, or on the risk in each state (docs/pitfalls.md, 6); each is asked for where it is read."""
    cfg = compose(f"algo={algo}", "task=cart", "cost_limit=3", "risk_limit=2")
    assert {name for name, keys in readers(cfg).items() if keys} == read
    check_limits(cfg, [])
    for name in read:
        where = OmegaConf.to_container(cfg, resolve=True)
        for key in readers(cfg)[name]:
            assert OmegaConf.select(cfg, key) == {"cost_limit": 3, "risk_limit": 2}[name]
        cfg[name] = None
        check_limits(cfg, [])
        assert caplog.messages[-1].startswith(f"{name}={USUAL[name]}, as none is given: it bounds")
        assert cfg[name] == USUAL[name]
        cfg[name] = where[name]
    alone = {"cost_limit", "risk_limit"} - read
    for name in alone if len(alone) == 1 else {"risk_limit"} - read:
        with pytest.raises(ValueError, match=f"{name} is on the .* algo={algo} does not bound"):
            check_limits(cfg, [f"{name}=1"])
    check_limits(cfg, ["cost_limit=1", *(f"{name}=1" for name in read)])


@pytest.mark.parametrize("option", [o for o in OPTIONS if o.startswith("experiment=")])
@pytest.mark.parametrize("algo", ["arsac", "cpo"])
def test_preset_builds_with_either_kind_of_algorithm(option: str, algo: str, tmp_path: Path):
    fast = ("encoder.width=16", "logger=none", "compile=false", "threads=1")
    cfg = compose(option, f"algo={algo}", *fast)
    if option == "experiment=speed":
        pytest.importorskip("mujoco")
    if option.startswith(("experiment=cart", "experiment=speed")) and algo == "arsac":
        with pytest.raises(ValueError, match="set encoder=mlp"):
            build_trainer(cfg, tmp_path)
        return
    build_trainer(cfg, tmp_path)


def test_command_line_beats_preset_beats_algorithm():
    cfg = compose("experiment=quickstart", "algo=sac", "encoder=mmam", "episodes=7")
    assert cfg.episodes == 7
    assert cfg.encoder._target_.endswith(".MMAM")
    assert cfg.env._target_.endswith("BatchedIntersection")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("gama: 0.9", "unknown key gama in experiment/mine; did you mean gamma?"),
        ("learning: {lr: {actr: [1, 2]}}", "unknown key learning.lr.actr in experiment/mine"),
        ("evaluation: {episode: 1}", "unknown key evaluation.episode in experiment/mine"),
        ("critic: {member: 2}", "unknown key critic.member in experiment/mine"),
        ("gamma: high", "gamma must be a number, got 'high'"),
    ],
)
def test_a_typo_in_a_preset_is_refused_as_it_is_composed(line, message, refusal, tmp_path: Path):
    (tmp_path / "my/experiment").mkdir(parents=True)
    (tmp_path / "my/experiment/mine.yaml").write_text(f"# @package _global_\n{line}\n")
    assert message in refusal("train", "config", "--config-dir", "my", "experiment=mine")


#: Settings that one family has and the other not, or a part that is not there.
UNREAD = {
    "sac": ("learning.gae_lambda=0.1", "learning.rollout_frames=77", "learning.epochs=3",
            "loss.cost_target=max", "lagrange.multiplier.lr=1", "projector.steps=3", "cost_critic.size=3"),
    "ppo": ("learning.tau=0.5", "learning.updates_per_frame=3", "learning.alpha_init=9",
            "learning.buffer_size=5000", "learning.lr.alpha=[1,1]", "loss.risk_limit=1", "tau=0.5"),
}  # fmt: skip


@pytest.mark.parametrize(
    ("algo", "option"), [(a, o) for a, options in UNREAD.items() for o in options]
)
def test_a_setting_that_nothing_would_read_does_not_compose(algo: str, option: str, refusal):
    assert "unknown key" in refusal("train", "config", f"algo={algo}", option)


def test_a_typo_in_a_preset_is_refused():
    """Hydra lets files add keys; only the check can tell."""
    for key, value, message in (
        ("encoder.depht", 3, r"unknown key encoder.depht: .* takes .*width"),
        ("task.vehicels", 3, "unknown key task.vehicels: .*Scenario takes task, vehicles"),
        ("loss.risk_limits", 3, "unknown key loss.risk_limits"),
        ("projector.step_size", "0.02 rad", "projector.step_size must be a number, got '0.02 rad'"),
        ("task.reward.weights", [1, "x"], "task.reward.weights must be a list, each a number"),
        ("task.standstill", "never", "task.standstill must be a number or null, got 'never'"),
        ("encoder._target_", "saferl.Nothing", "'saferl.Nothing'"),
    ):
        cfg = compose()
        OmegaConf.set_struct(cfg, False)
        OmegaConf.update(cfg, key, value)
        with pytest.raises(ValueError, match=message):
            check(cfg)


def test_kinds():
    assert fits(1, float) and fits(1.5, float) and not fits(1.5, int) and not fits(True, float)
    assert (
        fits(None, float | None) and not fits("x", float | None) and fits([1, 2], tuple[float, ...])
    )
    assert "num_envs" in arguments("saferl.envs.intersection.HighwayIntersection")


@pytest.mark.parametrize("members", [1, 2, 4])
def test_any_number_of_critics_is_trained(members: int):
    loss = build_agent(
        compose("algo=rsac", *SMALL, f"critic.members={members}", f"cost_critic.members={members}")
    ).loss
    trained = {name.split(".")[0] for name, _ in loss.named_parameters()}
    assert {"actor_network_params", "qvalue_network_params", "cost_critic_params"} <= trained
