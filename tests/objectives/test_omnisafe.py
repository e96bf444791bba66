"""The losses against OmniSafe 0.5.0, on the weights and batches that its own code was run on.

``tests/fixtures/omnisafe.json`` holds both, and is written by ``benchmarks/omnisafe_losses.py``. Everything
agrees to 1e-5. Where OmniSafe's form is another one, the test asks ours for that form by an option, or states
the exact factor between the two; the one difference that is more than a form is the direction of CPO's step in
its two quadratic cases, at the end of this file.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded, Unbounded
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss, SoftUpdate, ValueEstimators

from saferl.modules import DualAscent, MLPPolicyEncoder, MLPValue, StateValue, value_operator
from saferl.objectives import CPOLoss, PPOLagLoss, SACLagLoss, cpo
from saferl.objectives.trust_region import conjugate_gradient, flat

FIXTURE = json.loads((Path(__file__).parents[1] / "fixtures" / "omnisafe.json").read_text())
OBSERVATION, ACTION, WIDTH = 3, 2, 8
#: Ours to theirs, in the names of parameters: of an action's value, and of a state's.
ACTION_VALUE = {"first": "0", "layers.0": "2"}
STATE_VALUE = {"encoder.layers.0": "0", "head": "2"}
#: OmniSafe's number of a case -> our name.
CASES = {3: "unconstrained", 2: "feasible", 1: "recoverable", 0: "infeasible"}


@pytest.fixture(autouse=True)
def float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


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


# SACLag.


@pytest.fixture
def draws(monkeypatch):
    """Function that says what the next draws of a standard normal distribution are."""
    queue: list[Tensor] = []

    def draw(shape, dtype, device):
        taken = queue.pop(0)
        assert taken.shape == shape and taken.dtype == dtype
        return taken

    monkeypatch.setattr("torch.distributions.normal._standard_normal", draw)
    return queue.extend


@pytest.fixture
def sac() -> tuple[SACLagLoss, TensorDict]:
    found = FIXTURE["sac_lag"]
    settings, weights, batch = found["settings"], found["weights"], found["batch"]
    loss = SACLagLoss(
        actor(SquashedHead(), weights["actor"]),
        action_value("state_action_value"),
        action_value("state_action_cost_value"),
        num_qvalue_nets=2,
        num_cost_critics=1,  # OmniSafe has one
        alpha_init=settings["alpha"],
        target_entropy=settings["target_entropy"],
        # OmniSafe penalises the cost itself and divides the loss by 1 + lambda.
        lagrange=DualAscent(init=settings["lagrangian_multiplier"], signed=True),
        cost_limit=0.0,
        rescale=True,
    )
    loss.make_value_estimator(gamma=settings["gamma"])
    SoftUpdate(loss, tau=0.1)
    set_members(loss.qvalue_network_params, weights["reward_critic"])
    set_members(loss.cost_critic_params, weights["cost_critic"])
    set_members(loss.target_qvalue_network_params, weights["target_reward_critic"])
    set_members(loss.target_cost_critic_params, weights["target_cost_critic"])

    ended = torch.tensor(batch["done"]).bool()[:, None]  # OmniSafe's done is our terminated
    truncated = (torch.arange(len(ended)) % 4 == 2)[:, None]  # which changes no loss
    following = {
        "observation": torch.tensor(batch["next_obs"]),
        "reward": torch.tensor(batch["reward"])[:, None],
        "cost": torch.tensor(batch["cost"])[:, None],
        "terminated": ended,
        "truncated": truncated,
        "done": ended | truncated,
    }
    state = {"observation": torch.tensor(batch["obs"]), "action": torch.tensor(batch["act"])}
    return loss, TensorDict({**state, "next": following}, [len(ended)])


def test_sac_lag(sac, draws):
    """The reward critics', the actor's and the temperature's loss, and their gradients."""
    found, (loss, batch) = FIXTURE["sac_lag"], sac
    draws([torch.tensor(found["noise"]["next"]), torch.tensor(found["noise"]["now"])])
    out = loss(batch)
    theirs, gradients = found["losses"], found["gradients"]
    assert_agrees(out["loss_actor"], theirs["actor"])
    assert_agrees(2 * out["loss_qvalue"], theirs["reward_critic"])  # E12 has a factor 1/2
    # OmniSafe weighs with log alpha where E14 has alpha.
    alpha = found["settings"]["alpha"]
    assert_agrees(out["loss_alpha"] * math.log(alpha) / alpha, theirs["alpha"])
    sum(out[f"loss_{term}"] for term in ("actor", "qvalue", "alpha")).backward()
    assert_gradients_agree(loss.actor_network_params, gradients["actor"])
    assert_critic_gradients_agree(
        loss.qvalue_network_params, gradients["reward_critic"], ACTION_VALUE, 2.0
    )
    assert_agrees(loss.log_alpha.grad / alpha, gradients["log_alpha"][0])


def test_sac_lag_cost_critic(sac, draws):
    """Its next action is the policy's mean at OmniSafe, not the draw that the reward critics have."""
    found, (loss, batch) = FIXTURE["sac_lag"], sac
    noise = torch.tensor(found["noise"]["now"])
    draws([torch.zeros_like(noise), noise])
    out = loss(batch)
    assert_agrees(2 * out["loss_cost"], found["losses"]["cost_critic"])  # E13 has a factor 1/2
    out["loss_cost"].backward()
    theirs = found["gradients"]["cost_critic"]
    assert_critic_gradients_agree(loss.cost_critic_params, theirs, ACTION_VALUE, 2.0)


# PPOLag and the buffer of both on-policy algorithms.


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
    done = terminated.clone()
    done[:, -1] = True
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


def test_advantages():
    """Of reward and cost, before OmniSafe standardises each of them for itself."""
    loss, data = on_policy("ppo_lag", lagrange=DualAscent())
    loss.begin(data)
    theirs = FIXTURE["ppo_lag"]["buffer"]
    for ours, name in (("advantage", "adv_r"), ("cost_advantage", "adv_c")):
        assert_agrees(data[ours][0, :, 0], theirs["before_standardising"][name])
    for ours, name in (("value_target", "target_value_r"), ("cost_value_target", "target_value_c")):
        assert_agrees(data[ours][0, :, 0], theirs[name])


def test_ppo_lag(monkeypatch):
    found = FIXTURE["ppo_lag"]
    loss, data = on_policy(
        "ppo_lag",
        lagrange=DualAscent(init=found["settings"]["lagrangian_multiplier"]),
        clip_epsilon=found["settings"]["clip"],
        # OmniSafe standardises the reward's advantage and centres the cost's, in its buffer, and weighs them
        # then; we weigh first and standardise the sum.
        normalize_advantage=False,
    )
    data = with_their_advantages(data, "ppo_lag")
    for name, leaf in named(loss.actor_network_params).items():
        leaf.data.copy_(torch.tensor(found["weights"]["actor_after"][name]))
    seen = []
    clipped = ClipPPOLoss.forward

    def listen(self, tensordict):
        seen.append(tensordict["advantage"].squeeze(-1))
        return clipped(self, tensordict)

    monkeypatch.setattr(ClipPPOLoss, "forward", listen)
    out = loss(data)
    assert_agrees(seen[0], found["advantage"])
    ratio = torch.tensor(found["ratio"])
    share = ((ratio - 1).abs() > found["settings"]["clip"]).double().mean()
    assert 0.2 < share < 0.8
    theirs, gradients = found["losses"], found["gradients"]
    assert_agrees(out["loss_objective"], theirs["actor"])
    assert_agrees(out["loss_critic"], theirs["reward_critic"])
    assert_agrees(2 * out["loss_cost"], theirs["cost_critic"])  # ours has a factor 1/2
    sum(value for key, value in out.items() if key.startswith("loss_")).backward()
    assert_gradients_agree(loss.actor_network_params, gradients["actor"])
    for params, name, factor in (
        (loss.critic_network_params, "reward_critic", 1.0),
        (loss.cost_critic_params, "cost_critic", 2.0),
    ):
        assert_critic_gradients_agree(params, gradients[name], STATE_VALUE, factor)


def test_multiplier():
    """OmniSafe's optimiser is Adam by default; with plain gradient ascent it is our dual ascent."""
    found = FIXTURE["multiplier"]
    lagrange = DualAscent(init=found["init"], lr=found["lr"], signed=True)
    for cost, value in zip(found["costs"], found["values"], strict=True):
        lagrange.update(torch.tensor(cost - found["cost_limit"]))
        assert float(lagrange.value) == pytest.approx(value, rel=1e-5, abs=1e-12)


# CPO. OmniSafe's KL is the mean over samples and over the dimensions of an action, ours the sum over the
# latter: ours is ACTION times as large. With ACTION times their damping and trust region it is the same problem.
# Their violation is an episode's cost minus its limit, not divided by the decisions of an episode as ours is
# (docs/pitfalls.md, 7), so that it is handed to the step itself.


class Trial:
    """What our CPO does on OmniSafe's batch; vectors come and go in the order of its parameters."""

    def __init__(self, monkeypatch, sign: float = 1.0) -> None:
        settings = FIXTURE["cpo"]["settings"]
        self.loss, data = on_policy(
            "cpo",
            trust=ACTION * settings["target_kl"],
            damping=ACTION * settings["cg_damping"],
        )
        self.data = with_their_advantages(data, "cpo")
        self.data["cost_advantage"] *= sign
        self.parameters = named(self.loss.actor_network_params)
        self.search, self.vector, self.product = self.loss._search, None, None
        # To the end, as OmniSafe's were for the fixture: by default ours stop at a residual of 1e-5.
        monkeypatch.setattr(cpo, "conjugate_gradient", self.solve)
        monkeypatch.setattr(self.loss, "_search", self.listen)

    def solve(self, product, target, steps):
        if self.vector is not None:  # now, as the search moves the parameters of the product
            self.product = product(self.vector)
        return conjugate_gradient(product, target, 200, tolerance=1e-24)

    def listen(self, batch, old, parameters, step, case, violation):
        assert all(a is b for a, b in zip(parameters, self.parameters.values(), strict=True))
        self.direction, self.case = self.to_theirs(step), case
        self.search(batch, old, parameters, step, case, violation)

    def step(self, violation: float) -> None:
        with torch.no_grad():
            self.loss._step(self.data, torch.tensor(violation))

    def to_theirs(self, vector: Tensor) -> Tensor:
        sizes = [parameter.numel() for parameter in self.parameters.values()]
        parts = dict(zip(self.parameters, vector.split(sizes), strict=True))
        return flat(parts[name] for name in FIXTURE["cpo"]["order"])

    def to_ours(self, vector: Tensor) -> Tensor:
        order = FIXTURE["cpo"]["order"]
        parts = dict(
            zip(order, vector.split([self.parameters[n].numel() for n in order]), strict=True)
        )
        return flat(parts[name] for name in self.parameters)

    def policy(self) -> Tensor:
        return self.to_theirs(flat(p.detach() for p in self.parameters.values()))


def test_cpo_surrogates_and_kl(monkeypatch):
    found, trial = FIXTURE["cpo"], Trial(monkeypatch)
    loss, data = trial.loss, trial.data
    with loss.actor_network_params.to_module(loss.actor_network), torch.no_grad():
        old = loss.actor_network.get_dist(data.select("observation"))
    assert_agrees(old.log_prob(data["action"]), found["batch"]["logp"])
    for name, leaf in trial.parameters.items():
        leaf.data.copy_(torch.tensor(found["weights"]["actor_after"][name]))
    reward, cost, kl = loss._surrogates(data, old)
    # A loss at OmniSafe, an objective at ours; its buffer has centred both advantages.
    theirs = found["surrogates"]
    assert_agrees(-reward, theirs["reward"]["loss"])
    assert_agrees(cost, theirs["cost"]["loss"])
    assert_agrees(kl / ACTION, found["kl"])
    parameters = list(trial.parameters.values())
    for value, sign, name in ((reward, -1, "reward"), (cost, 1, "cost")):
        gradient = flat(torch.autograd.grad(value, parameters, retain_graph=True))
        assert_agrees(sign * trial.to_theirs(gradient), theirs[name]["gradient"])


def test_cpo_fisher_product(monkeypatch):
    theirs, trial = FIXTURE["cpo"]["fisher"], Trial(monkeypatch)
    trial.vector = trial.to_ours(torch.tensor(theirs["vector"]))
    trial.step(0.0)
    # Damping included, which is ACTION times theirs too.
    assert_agrees(trial.to_theirs(trial.product) / ACTION, theirs["product"])


def boundary(found: dict, theirs: dict) -> tuple[Tensor, float]:
    """The step to the constraint's boundary, and lambda, from OmniSafe's q, r, s, H^-1 g and H^-1 b."""
    multiplier = (theirs["A"] / theirs["B"]) ** 0.5
    nu = (multiplier * theirs["violation"] + theirs["r"]) / theirs["s"]
    on_reward, on_cost = torch.tensor(found["H_inv_g"]), torch.tensor(found["H_inv_b"])
    return (on_reward - nu * on_cost) / multiplier, multiplier


TRIALS = [
    (name, i)
    for name, found in FIXTURE["cpo"]["steps"].items()
    for i in range(len(found["trials"]))
]


@pytest.mark.parametrize(("name", "number"), TRIALS)
def test_cpo_direction(name: str, number: int, monkeypatch):
    """The same case, and the same direction by OmniSafe's own method with r = g H^-1 b of the sign it needs.

    Its method is written for Achiam's g, the gradient of a loss, as nu = max(0, lambda c - r) / s shows, but it
    hands over the gradient of the objective and with it the other sign of r. Called with -r it gives our step,
    but for where lambda's interval is empty, r / c > 0: ``torch.clamp`` with its bounds the wrong way
    round then makes lambda negative, in place of leaving that half of the dual out.
    """
    found = FIXTURE["cpo"]["steps"][name]
    theirs = found["trials"][number]
    c, case = theirs["violation"], CASES[theirs["optim_case"]]
    trial = Trial(monkeypatch, found["sign"])
    before = trial.policy()
    trial.step(c)
    assert trial.case == case
    if case in ("unconstrained", "infeasible"):  # where r plays no part
        assert_agrees(trial.direction, theirs["step_direction"])
        assert theirs["acceptance_step"] == 1
        assert_agrees(trial.policy() - before, theirs["moved"])
        return
    if theirs["r"] / c < 0:
        assert_agrees(trial.direction, theirs["other_sign"]["step_direction"])
    else:
        assert theirs["other_sign"]["Lambda_star"] < 0
        # The half that is left: the boundary where c > 0, else the trust region alone, which is OmniSafe's case 3.
        unconstrained = found["trials"][0]["step_direction"]
        expected = boundary(found, theirs)[0] if c > 0 else unconstrained
        assert_agrees(trial.direction, expected)
    assert c + torch.tensor(found["b"]) @ trial.direction <= 1e-8


def test_cpo_omnisafes_own_quadratic_steps_are_not_the_optimum():
    """Says where we differ on purpose, and that it is more than rounding."""
    for found in FIXTURE["cpo"]["steps"].values():
        g, b = torch.tensor(found["g"]), torch.tensor(found["b"])
        for theirs in found["trials"]:
            own = torch.tensor(theirs["step_direction"])
            if CASES[theirs["optim_case"]] == "recoverable":
                # Meant to end where the cost is at its limit, it ends above where it began.
                assert b @ own > 0.1 * theirs["violation"]
            if CASES[theirs["optim_case"]] == "feasible" and theirs["r"] > 0:
                assert theirs["Lambda_star"] < 0 and g @ own < 0
