"""OmniSafe 0.5.0's weights, batches and numbers (``tests/fixtures/omnisafe.json``) in modules of ours."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded, Unbounded
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal
from torchrl.objectives import ValueEstimators

from saferl.modules import MLPPolicyEncoder, MLPValue, StateValue, value_operator
from saferl.objectives import CPOLoss, PPOLagLoss

FIXTURE = json.loads((Path(__file__).parents[1] / "fixtures" / "omnisafe.json").read_text())
OBSERVATION, ACTION, WIDTH = 3, 2, 8
#: Ours to theirs, in the names of parameters: of an action's value, and of a state's.
ACTION_VALUE = {"first": "0", "layers.0": "2"}
STATE_VALUE = {"encoder.layers.0": "0", "head": "2"}


def assert_agrees(ours: Tensor | float, theirs: list | float, tolerance: float = 1e-5) -> None:
    """Equal but for ``tolerance``, relative to the largest entry."""
    ours, theirs = torch.as_tensor(ours).detach(), torch.as_tensor(theirs)
    assert ours.shape == theirs.shape
    assert theirs.abs().max() > 0
    error = float((ours - theirs).abs().max() / theirs.abs().max())
    assert error <= tolerance, f"{ours} is not {theirs}: relative error {error:.1e}"


class SquashedHead(nn.Module):
    """The network of OmniSafe's ``GaussianSACActor``."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.Linear(OBSERVATION, WIDTH), nn.ReLU(), nn.Linear(WIDTH, 2 * ACTION)
        )

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        loc, log_scale = self.net(observation).chunk(2, -1)
        return loc, log_scale.clamp(-20, 2).exp()


class PlainHead(nn.Module):
    """The network of OmniSafe's ``GaussianLearningActor``: a scale that no state changes."""

    def __init__(self) -> None:
        super().__init__()
        self.mean = nn.Sequential(
            nn.Linear(OBSERVATION, WIDTH), nn.Tanh(), nn.Linear(WIDTH, ACTION)
        )
        self.log_std = nn.Parameter(torch.zeros(ACTION))

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        loc = self.mean(observation)
        return loc, self.log_std.exp().expand_as(loc)


def actor(head: nn.Module, weights: dict) -> ProbabilisticActor:
    head.load_state_dict({name: torch.tensor(value) for name, value in weights.items()})
    squashed = isinstance(head, SquashedHead)
    return ProbabilisticActor(
        TensorDictModule(head, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=["action"],
        spec=Bounded(-1, 1, (ACTION,)) if squashed else Unbounded((ACTION,)),
        distribution_class=TanhNormal if squashed else IndependentNormal,
        return_log_prob=True,
    )


def members(weights: dict, names: dict[str, str]) -> list[dict[str, Tensor]]:
    """State dicts of ours from OmniSafe's critic, one for each of its members."""
    found: dict[str, dict[str, Tensor]] = {}
    back = {theirs: ours for ours, theirs in names.items()}
    for name, value in weights.items():
        member, *_, layer, kind = name.split(".")
        found.setdefault(member, {})[f"{back[layer]}.{kind}"] = torch.tensor(value)
    return [found[member] for member in sorted(found)]


def action_value(key: str) -> TensorDictModule:
    network = MLPValue(size=OBSERVATION, width=WIDTH, depth=1, activation=nn.ReLU)
    return value_operator(network, in_keys=["observation", "action"], out_key=key)


def state_value(weights: dict, key: str) -> TensorDictModule:
    encoder = MLPPolicyEncoder(size=OBSERVATION, width=WIDTH, depth=1, activation=nn.Tanh)
    network = StateValue(encoder, WIDTH)
    (state,) = members(weights, STATE_VALUE)
    network.load_state_dict(state)
    return value_operator(network, in_keys=["observation"], out_key=key)


def named(params: TensorDictBase) -> dict[str, Tensor]:
    """The leaves of a loss's parameters by the names they have in their network."""
    return {
        ".".join(path).split("module.")[-1]: leaf
        for path, leaf in params.items(True, True)
        if isinstance(leaf, Tensor)
    }


def set_members(params: TensorDictBase, weights: dict) -> None:
    """The stacked weights of a loss's action values."""
    for name, leaf in named(params).items():
        leaf.data.copy_(torch.stack([state[name] for state in members(weights, ACTION_VALUE)]))


def assert_gradients_agree(params: TensorDictBase, theirs: dict, factor: float = 1.0) -> None:
    """Of an actor, whose parameters have the same names."""
    ours = named(params)
    assert set(ours) == set(theirs)
    for name, leaf in ours.items():
        assert_agrees(leaf.grad * factor, theirs[name])


def assert_critic_gradients_agree(
    params: TensorDictBase, theirs: dict, names: dict[str, str], factor: float
) -> None:
    """Of critics, stacked in our loss where there may be more than one."""
    states = members(theirs, names)
    for name, leaf in named(params).items():
        expected = [state[name] for state in states]
        expected = torch.stack(expected) if leaf.ndim > expected[0].ndim else expected[0]
        assert_agrees(leaf.grad * factor, expected)


def on_policy(kind: str, **options) -> tuple[PPOLagLoss | CPOLoss, TensorDict]:
    """A loss with OmniSafe's networks, and its batch [1, T] as two episodes one after the other."""
    found = FIXTURE[kind]
    settings, weights, batch = found["settings"], found["weights"], found["batch"]
    parts = (
        actor(PlainHead(), weights["actor"]),
        state_value(weights["reward_critic"], "state_value"),
        state_value(weights["cost_critic"], "state_cost_value"),
    )
    loss = {"ppo_lag": PPOLagLoss, "cpo": CPOLoss}[kind](*parts, **options)
    loss.make_value_estimator(ValueEstimators.GAE, gamma=settings["gamma"], lmbda=settings["lam"])
    first, steps = batch["paths"][0], sum(batch["paths"])
    terminated = torch.zeros(1, steps, 1, dtype=torch.bool)
    terminated[:, first - 1] = True
    done = terminated.clone()  # the second is cut off by the end of the batch
    following = {
        "observation": torch.tensor(batch["next_obs"])[None],
        "reward": torch.tensor(batch["reward"])[None, :, None],
        "cost": torch.tensor(batch["cost"])[None, :, None],
        "terminated": terminated,
        "done": done,
    }
    data = {
        "observation": torch.tensor(batch["obs"])[None],
        "action": torch.tensor(batch["act"])[None],
        "action_log_prob": torch.tensor(batch["logp"])[None],
        "next": following,
    }
    return loss, TensorDict(data, [1, steps])


def with_their_advantages(data: TensorDict, kind: str) -> TensorDict:
    """The batch [T] with the advantages and targets of OmniSafe's buffer in the place of ours."""
    buffer, data = FIXTURE[kind]["buffer"], data.reshape(-1)
    for ours, theirs in (
        ("advantage", "adv_r"),
        ("cost_advantage", "adv_c"),
        ("value_target", "target_value_r"),
        ("cost_value_target", "target_value_c"),
    ):
        data[ours] = torch.tensor(buffer[theirs])[:, None]
    return data
