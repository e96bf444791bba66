"""CPO's step against OmniSafe 0.5.0, on the weights and batches that its own code was run on."""

from __future__ import annotations

import pytest
import torch
from omnisafe_fixture import (
    ACTION,
    FIXTURE,
    assert_agrees,
    named,
    on_policy,
    with_their_advantages,
)
from torch import Tensor

from saferl.objectives import policy_step
from saferl.objectives.trust_region import conjugate_gradient, flat

#: OmniSafe's number of a case -> our name.
CASES = {3: "unconstrained", 2: "feasible", 1: "recoverable", 0: "infeasible"}


@pytest.fixture(autouse=True)
def float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


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
        self.stepper = self.loss.policy_step()
        self.search, self.vector, self.product = self.stepper.search, None, None
        # To the end, as OmniSafe's were for the fixture: by default ours stop at a residual of 1e-5.
        monkeypatch.setattr(policy_step, "conjugate_gradient", self.solve)
        monkeypatch.setattr(self.stepper, "search", self.listen)

    def solve(self, product, target, steps):
        if self.vector is not None:  # now, as the search moves the parameters of the product
            self.product = product(self.vector)
        return conjugate_gradient(product, target, 200, tolerance=1e-24)

    def listen(self, batch, old, direction, violation):
        moved = self.stepper.policy_parameters
        assert all(a is b for a, b in zip(moved, self.parameters.values(), strict=True))
        self.direction, self.case = self.to_theirs(direction.step), direction.case
        return self.search(batch, old, direction, violation)

    def step(self, violation: float) -> None:
        self.stepper.move(self.data, violation)

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
    reward, cost, kl = loss.surrogates(data, old)
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
