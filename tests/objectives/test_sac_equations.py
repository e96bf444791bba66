"""E11 to E14 against a second implementation, and against closed forms."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import SACLoss

from saferl.modules import DualAscent

GAMMA, LIMIT, LAMBDA, ALPHA, TARGET_ENTROPY = 0.9, 0.2, 0.7, 0.3, -2.0
TERMS = ("loss_actor", "loss_qvalue", "loss_cost", "loss_alpha")


class Reference:
    """The terms from plain tensors: no TorchRL, no vmap, no distribution object."""

    def __init__(self, loss) -> None:
        def leaves(params, train=False):
            flat = params.flatten_keys(".").items()
            return {key: leaf.detach().clone().requires_grad_(train) for key, leaf in flat}

        self.actor = leaves(loss.actor_network_params, train=True)
        self.q = leaves(loss.qvalue_network_params, train=True)
        self.qc = leaves(loss.cost_critic_params, train=True)
        self.q_target = leaves(loss.target_qvalue_network_params)
        self.qc_target = leaves(loss.target_cost_critic_params)
        self.log_alpha = loss.log_alpha.detach().clone().requires_grad_()

    def policy(self, observation, noise):
        w = {key.split("module.")[-1]: value for key, value in self.actor.items()}
        hidden = torch.tanh(observation @ w["hidden.weight"].T + w["hidden.bias"])
        out = hidden @ w["out.weight"].T + w["out.bias"]
        loc, scale = out[:, :2], torch.exp(out[:, 2:])
        raw = loc + scale * noise
        density = -0.5 * noise**2 - torch.log(scale) - 0.5 * math.log(2 * math.pi)
        log_prob = (density - torch.log(1 - torch.tanh(raw) ** 2)).sum(-1)
        return torch.tanh(raw), log_prob

    @staticmethod
    def pair(params, observation, action):
        values = []
        for i in (0, 1):
            w = {key.removeprefix("module."): value[i] for key, value in params.items()}
            hidden = torch.cat([observation, action], -1) @ w["0.weight"].T + w["0.bias"]
            values.append((torch.tanh(hidden) @ w["2.weight"].T + w["2.bias"])[:, 0])
        return values

    def __call__(self, batch, next_noise, noise):
        s, a, s2 = batch["observation"], batch["action"], batch["next", "observation"]
        reward, cost = batch["next", "reward"][:, 0], batch["next", "cost"][:, 0]
        alive = 1.0 - batch["next", "terminated"][:, 0].to(s)
        alpha = torch.exp(self.log_alpha)
        with torch.no_grad():
            a2, log_prob2 = self.policy(s2, next_noise)
            value = torch.minimum(*self.pair(self.q_target, s2, a2)) - alpha * log_prob2
            cost_value = torch.maximum(*self.pair(self.qc_target, s2, a2))
            y, y_cost = reward + GAMMA * alive * value, cost + GAMMA * alive * cost_value
        new, log_prob = self.policy(s, noise)
        q = torch.minimum(*self.pair({k: v.detach() for k, v in self.q.items()}, s, new))
        excess = torch.maximum(*self.pair({k: v.detach() for k, v in self.qc.items()}, s, new))
        penalty = torch.where(excess > LIMIT, excess - LIMIT, torch.zeros_like(excess))
        return {
            "loss_actor": (alpha.detach() * log_prob - q + LAMBDA * penalty).mean(),
            "loss_qvalue": sum((0.5 * (x - y) ** 2).mean() for x in self.pair(self.q, s, a)),
            "loss_cost": sum((0.5 * (x - y_cost) ** 2).mean() for x in self.pair(self.qc, s, a)),
            "loss_alpha": (alpha * (-log_prob.detach() - TARGET_ENTROPY)).mean(),
            "constraint_violation": penalty.detach().mean(),
            "entropy": -log_prob.detach().mean(),
            "alpha": alpha.detach(),
            "lagrange_multiplier": torch.tensor(LAMBDA),
        }


@pytest.fixture
def float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.fixture
def draws(monkeypatch, float64):
    """Two draws of the policy, the next states' first; a third would fail."""
    torch.manual_seed(5)
    noise = list(torch.randn(2, 8, 2).unbind(0))
    queue = list(noise)

    def draw(shape, dtype, device):
        taken = queue.pop(0)
        assert taken.shape == shape
        return taken

    monkeypatch.setattr("torch.distributions.normal._standard_normal", draw)
    return noise


def test_every_term_and_its_gradient_match_the_reference(make_loss, make_batch, draws):
    multiplier = DualAscent(init=LAMBDA)
    loss = make_loss(risk_limit=LIMIT, alpha_init=ALPHA, gamma=GAMMA, lagrange=multiplier)
    batch, reference = make_batch(), Reference(loss)
    assert batch["observation"].dtype == torch.float64
    expected = reference(batch, *draws)
    output = loss(batch)
    assert expected["constraint_violation"] > 0
    assert set(output.keys()) == set(expected)
    for key, value in expected.items():
        torch.testing.assert_close(output[key], value.to(output[key]), rtol=1e-6, atol=1e-6)
    sum(output[key] for key in TERMS).backward()
    sum(expected[key] for key in TERMS).backward()
    for params, group in (
        (loss.actor_network_params, reference.actor),
        (loss.qvalue_network_params, reference.q),
        (loss.cost_critic_params, reference.qc),
    ):
        for key, leaf in params.flatten_keys(".").items():
            assert group[key].grad.abs().sum() > 0
            torch.testing.assert_close(leaf.grad, group[key].grad, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(loss.log_alpha.grad, reference.log_alpha.grad)


class Constant(nn.Module):
    def __init__(self, value: float) -> None:
        super().__init__()
        self.value = nn.Parameter(torch.tensor(value))

    def forward(self, action: torch.Tensor) -> torch.Tensor:
        return self.value.expand(*action.shape[:-1], 1)


def constants(key: str, *values: float) -> list[TensorDictModule]:
    return [TensorDictModule(Constant(v), in_keys=["action"], out_keys=[key]) for v in values]


@pytest.fixture
def constant_loss(make_loss):
    """Live critics (1, 2) and (0.1, 0.4), target critics (5, 7) and (2, 3)."""
    loss = make_loss(
        qvalue_network=constants("state_action_value", 1.0, 2.0),
        cost_critic=constants("state_action_cost_value", 0.1, 0.4),
        alpha_init=0.5,
        risk_limit=0.3,
        gamma=0.8,
        lagrange=DualAscent(init=2.0),
    )
    loss.target_qvalue_network_params["module", "value"].copy_(torch.tensor([5.0, 7.0]))
    loss.target_cost_critic_params["module", "value"].copy_(torch.tensor([2.0, 3.0]))
    return loss


def transition(terminated: bool = False, truncated: bool = False) -> TensorDict:
    return TensorDict(
        {
            "observation": torch.zeros(1, 3),
            "action": torch.zeros(1, 2),
            "next": {
                "observation": torch.ones(1, 3),
                "reward": torch.tensor([[0.25]]),
                "cost": torch.tensor([[0.5]]),
                "terminated": torch.tensor([[terminated]]),
                "truncated": torch.tensor([[truncated]]),
                "done": torch.tensor([[terminated or truncated]]),
            },
        },
        batch_size=[1],
    )


def half_squares(target: float, *values: float) -> torch.Tensor:
    return torch.tensor(sum(0.5 * (value - target) ** 2 for value in values))


# (terminated, truncated). A crash on the last step is both, and nothing follows it.
ENDINGS = {
    "running": (False, False),
    "time_limit": (False, True),
    "crash": (True, False),
    "crash_on_the_last_step": (True, True),
}


@pytest.mark.parametrize("ending", ENDINGS)
def test_cost_target_takes_the_larger_value_and_no_entropy(constant_loss, ending):
    terminated, truncated = ENDINGS[ending]
    target = 0.5 if terminated else 0.5 + 0.8 * 3.0
    # The target would move by hundreds if the temperature entered it.
    constant_loss.log_alpha.data.fill_(6.0)
    value, metadata = constant_loss.cost_loss(transition(terminated, truncated))
    torch.testing.assert_close(value, half_squares(target, 0.1, 0.4))
    torch.testing.assert_close(metadata["td_error"], torch.tensor([target - 0.1]))


def test_cost_target_can_be_the_mean(constant_loss):
    constant_loss.cost_target = "mean"
    value, _ = constant_loss.cost_loss(transition())
    torch.testing.assert_close(value, half_squares(0.5 + 0.8 * 2.5, 0.1, 0.4))


@pytest.mark.parametrize("ending", ENDINGS)
def test_reward_target_takes_the_smaller_value_and_the_entropy(constant_loss, ending):
    terminated, truncated = ENDINGS[ending]
    batch = transition(terminated, truncated)
    next_state = batch["next"].clone().set("action", torch.zeros(1, 2))
    target = 0.25 if terminated else 0.25 + 0.8 * (5.0 - 0.5 * 1.5)
    constant_loss.sample_next = lambda _: (next_state, torch.tensor([1.5]))
    value, _ = constant_loss.qvalue_v2_loss(batch)
    torch.testing.assert_close(value, half_squares(target, 1.0, 2.0))


def test_actor_term_penalises_the_larger_cost_value(constant_loss):
    value, metadata = constant_loss.actor_loss(transition())
    # alpha * log_prob - min(1, 2) + lambda * ReLU(max(0.1, 0.4) - 0.3)
    expected = 0.5 * metadata["log_prob"][0] - 1.0 + 2.0 * 0.1
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(metadata["constraint_violation"], torch.tensor(0.1))


def test_the_temperatures_term_is_the_papers_or_torchrls(make_loss, make_batch):
    """alpha or log(alpha) weighs the same distance, so that the slopes in log(alpha) differ by the factor alpha."""
    weights, slopes = [], []
    for weight in ("alpha", "log_alpha"):
        loss = make_loss(alpha_init=ALPHA, alpha_weight=weight)
        torch.manual_seed(3)
        term = loss(make_batch())["loss_alpha"]
        term.backward()
        weights.append(term.item())
        slopes.append(loss.log_alpha.grad.item())
    assert weights[0] * math.log(ALPHA) == pytest.approx(weights[1] * ALPHA)
    assert slopes[0] == pytest.approx(ALPHA * slopes[1]) and slopes[0] != 0
    log_prob = torch.randn(8)
    theirs = SACLoss._alpha_loss(loss, log_prob)
    torch.testing.assert_close(loss.alpha_loss(log_prob), theirs)
    with pytest.raises(ValueError, match="alpha_weight must be one of alpha, log_alpha, got 'b'"):
        make_loss(alpha_weight="b")


class CostOfState(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.tensor(1.0))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self.gain * observation[..., :1]


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_relu_is_taken_for_each_sample_before_the_mean(make_loss, reduction):
    """Cost values 0.9 and 0.1 about a limit of 0.5: the mean is feasible, a sample is not."""
    members = [
        TensorDictModule(
            CostOfState(), in_keys=["observation"], out_keys=["state_action_cost_value"]
        )
        for _ in range(2)
    ]
    multiplier = DualAscent(init=1.0, lr=0.1)
    loss = make_loss(cost_critic=members, risk_limit=0.5, lagrange=multiplier, reduction=reduction)
    batch = torch.cat([transition(), transition()])
    batch["observation"][:, 0] = torch.tensor([0.9, 0.1])
    output = loss(batch)
    loss.lagrange.update(output["constraint_violation"])
    assert loss.lagrange.value.item() == pytest.approx(1.0 + 0.1 * 0.4 / 2)
    if reduction != "none":
        # The output keeps the multiplier the actor was charged, not the new one.
        assert output["lagrange_multiplier"] == 1.0


def test_violation_is_the_derivative_of_the_actor_term(make_loss, make_batch):
    loss, outputs = make_loss(risk_limit=0.0), []
    for multiplier in (0.0, 1.0):
        loss.lagrange.value.fill_(multiplier)
        torch.manual_seed(3)
        outputs.append(loss(make_batch()))
    slope = outputs[1]["loss_actor"] - outputs[0]["loss_actor"]
    assert slope > 0
    torch.testing.assert_close(slope, outputs[0]["constraint_violation"])


def test_n_step_transitions_discount_by_the_steps_taken(constant_loss):
    batch = transition()
    batch["steps_to_next_obs"] = torch.tensor([[3]])
    target = 0.5 + 0.8**3 * 3.0
    torch.testing.assert_close(constant_loss.cost_loss(batch)[0], half_squares(target, 0.1, 0.4))
