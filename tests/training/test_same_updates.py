"""The forms of an update that differ in speed learn the same thing."""

from __future__ import annotations

import pytest
import torch
import torch._inductor.config
from small import compose
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from saferl.algorithms.assemble import algorithm_of, build_agent
from saferl.training.learner import Learner

PLAIN = ("encoder._target_=plain.PlainMMAM",)
LOSSES = ("loss_actor", "loss_qvalue", "loss_cost", "loss_alpha")


@pytest.fixture
def double():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


def learner(*overrides: str, algo: str = "arsac", compile: bool = False) -> Learner:
    """With width 16 in float64, always with the same first weights."""
    cfg = compose(f"algo={algo}", "encoder.width=16", "device=cpu", *overrides)
    torch.manual_seed(0)
    loss = build_agent(cfg).loss.double()
    with torch.no_grad():  # cost critics begin at zero, which would hide what they do
        for name, parameter in loss.named_parameters():
            if "w_mlp" in name or "w_attn" in name:
                parameter.normal_(std=0.3)
    return Learner(
        loss,
        algorithm_of(cfg.learning).optimizer(loss),
        SoftUpdate(loss, tau=cfg.learning.tau),
        compile=compile,
    )


def batch(seed: int) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)

    def scene():
        vehicles = torch.randn(32, 11, 12, generator=generator) * 10
        count = torch.randint(0, 11, (32, 1), generator=generator)
        vehicles[..., 0] = (torch.arange(11) < count).to(vehicles)
        return {"ego": torch.randn(32, 12, generator=generator) * 5, "vehicles": vehicles}

    ended = torch.rand(32, 1, generator=generator) < 0.1
    following = {
        **scene(),
        "reward": torch.randn(32, 1, generator=generator),
        "cost": torch.rand(32, 1, generator=generator),
        "done": ended,
        "terminated": ended,
    }
    action = torch.rand(32, 2, generator=generator) * 2 - 1
    return TensorDict({**scene(), "action": action, "next": following}, [32])


def losses_and_gradients(learner: Learner) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    torch.manual_seed(1)
    ((names, gradients),) = learner.gradients.items()  # not update(), which moves the parameters
    output, _, slopes = gradients(batch(0))
    of = dict(zip(map(id, learner._parameters(names)), slopes, strict=True))
    by_name = {name: of[id(p)] for name, p in learner.loss.named_parameters()}
    return torch.stack([output[key] for key in LOSSES]), by_name


FORMS = [
    pytest.param({}, (), id="keys by default"),
    pytest.param({}, ("encoder.keys=attended",), id="others"),
    pytest.param({"compile": True}, (), id="compiled", marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("how", "options"), FORMS)
def test_losses_and_gradients_equal_the_plain_ones(double, how, options):
    """In float64 to 1e-10."""
    ours = losses_and_gradients(learner(*options, **how))
    plain = losses_and_gradients(learner(*options, *PLAIN))
    torch.testing.assert_close(ours, plain, rtol=1e-10, atol=1e-10)


def test_a_hundred_updates_equal_the_plain_ones(double):
    """From one seed, in float64, to 1e-6 of each parameter's size."""
    ends = []
    for one in (learner(), learner(*PLAIN)):
        torch.manual_seed(2)
        for step in range(100):
            one.update(batch(step))
        ends.append(one.loss.state_dict())
    ours, plain = ends
    assert ours.keys() == plain.keys()
    for key, value in ours.items():
        if isinstance(value, torch.Tensor) and value.is_floating_point():
            scale = value.abs().max().clamp(min=1e-3)
            assert (value - plain[key]).abs().max() <= 1e-6 * scale, key


@pytest.mark.parametrize("compile", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("algo", ["arsac", "asac", "rsac", "sac"])
def test_a_step_is_that_of_backward_and_plain_adam(double, algo, compile):
    """The optimizer reads each gradient as it is meant, however it lies in memory."""
    one, other = learner(algo=algo, compile=compile), learner(algo=algo)
    plain = torch.optim.Adam(
        [{"params": g["params"], "lr": g["lr"]} for g in other.optimizer.param_groups]
    )
    torch.manual_seed(1)
    one.update(batch(0))
    torch.manual_seed(1)
    losses = other.loss(batch(0))
    sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    plain.step()
    ours, theirs = (dict(each.loss.named_parameters()) for each in (one, other))
    for name, parameter in ours.items():
        torch.testing.assert_close(parameter, theirs[name], rtol=1e-7, atol=1e-7, msg=name)
