"""What an update steps, and at which parameters."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from saferl.training.learner import Learner


class Chain(nn.Module):
    """Each term follows the parameter that the one before it trains."""

    def __init__(self):
        super().__init__()
        self.critic, self.actor, self.alpha = (nn.Parameter(torch.zeros(())) for _ in range(3))

    def forward(self, batch):
        return TensorDict(
            loss_qvalue=(self.critic - 1) ** 2 / 2,
            loss_actor=(self.actor - self.critic.detach()) ** 2 / 2,
            loss_alpha=(self.alpha - self.actor.detach()) ** 2 / 2,
            seen=self.critic.detach().clone(),
        )


def learner(order, **names):
    loss = Chain()
    groups = [{"params": [p], "name": names.get(name, name)} for name, p in loss.named_parameters()]
    optimizer = torch.optim.SGD(groups, lr=1.0)  # a step goes to the minimum of each term
    calls = []
    targets = SimpleNamespace(step=lambda: calls.append("targets"))
    hook = lambda losses: calls.append(losses["seen"].item())  # noqa: E731
    return loss, Learner(loss, optimizer, targets, [hook], order=order), calls  # type: ignore


@pytest.mark.parametrize(
    ("order", "after", "seen"),
    [("joint", [[1, 0, 0], [1, 1, 0], [1, 1, 1]], [0, 1, 1]), ("sequential", [[1, 1, 1]], [1])],
)
def test_the_order_decides_what_a_term_sees(order, after, seen):
    loss, one, calls = learner(order)
    for expected in after:
        one.update(TensorDict())
        assert [p.item() for p in loss.parameters()] == expected
        assert all(p.grad is None for p in loss.parameters())
    assert calls == [x for value in seen for x in ("targets", value)]


def test_an_unknown_order_is_refused():
    with pytest.raises(ValueError, match="order must be one of joint, sequential, got 'paper'"):
        learner("paper")


@pytest.mark.parametrize("name", ["policy", None])
def test_a_group_that_no_step_would_move_is_refused(name):
    with pytest.raises(ValueError, match=f"must be called critic, actor, alpha, got .*{name}"):
        learner("joint", actor=name)


def test_a_group_without_a_schedule_keeps_its_rate():
    _, one, _ = learner("joint")
    one.optimizer.param_groups[0]["schedule"] = (1.0, 0.5)
    one.schedule(0.5)
    assert [group["lr"] for group in one.optimizer.param_groups] == [0.75, 1.0, 1.0]
