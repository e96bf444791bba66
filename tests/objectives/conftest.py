"""Small networks and batches for the tests of the losses."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SoftUpdate

from saferl.modules import DualAscent
from saferl.objectives import SACLagLoss

OBS, ACT = 3, 2


class GaussianHead(nn.Module):
    """One hidden layer, then a location and the logarithm of a scale."""

    def __init__(self) -> None:
        super().__init__()
        self.hidden = nn.Linear(OBS, 6)
        self.out = nn.Linear(6, 2 * ACT)

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        loc, log_scale = self.out(self.hidden(observation).tanh()).chunk(2, -1)
        return loc, log_scale.exp()


def actor(
    action: NestedKey = "action",
    observation: str = "observation",
    log_prob: NestedKey | None = None,
) -> ProbabilisticActor:
    return ProbabilisticActor(
        TensorDictModule(GaussianHead(), in_keys=[observation], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[action],
        spec=Bounded(-1, 1, (ACT,)),
        distribution_class=TanhNormal,
        return_log_prob=True,
        log_prob_key=log_prob,
    )


def critic(
    out_key: NestedKey, action: NestedKey = "action", dropout: float | None = None
) -> ValueOperator:
    net = MLP(
        in_features=OBS + ACT,
        out_features=1,
        num_cells=[6],
        activation_class=nn.Tanh,
        dropout=dropout,
    )
    return ValueOperator(net, in_keys=["observation", action], out_keys=[out_key])


@pytest.fixture
def make_actor() -> Callable[..., ProbabilisticActor]:
    return actor


@pytest.fixture
def make_critic() -> Callable[..., ValueOperator]:
    return critic


@pytest.fixture
def make_loss() -> Callable[..., SACLagLoss]:
    """Function that builds a loss whose target critics differ from its critics."""

    def make(seed: int = 0, gamma: float = 0.9, **options) -> SACLagLoss:
        torch.manual_seed(seed)
        options.setdefault("actor_network", actor())
        options.setdefault("qvalue_network", critic("state_action_value"))
        options.setdefault("cost_critic", critic("state_action_cost_value"))
        options.setdefault("lagrange", DualAscent(init=0.7))
        options.setdefault("scalar_output_mode", "exclude")
        loss = SACLagLoss(**options)
        loss.make_value_estimator(gamma=gamma)
        SoftUpdate(loss, tau=0.1)
        for name in ("target_qvalue_network_params", "target_cost_critic_params"):
            for leaf in getattr(loss, name).values(True, True):
                leaf.data.add_(0.3 * torch.randn_like(leaf))
        return loss

    return make


@pytest.fixture
def make_batch() -> Callable[..., TensorDict]:
    """Function that builds transitions of every kind of ending."""

    def make(*shape: int, seed: int = 1) -> TensorDict:
        shape = shape or (8,)
        generator = torch.Generator().manual_seed(seed)
        rows = torch.arange(torch.Size(shape).numel()).reshape(*shape, 1)
        terminated, truncated = rows % 4 == 1, rows % 8 >= 5

        def normal(size: int) -> torch.Tensor:
            return torch.randn(*shape, size, generator=generator)

        return TensorDict(
            {
                "observation": normal(OBS),
                "action": normal(ACT).tanh(),
                "next": {
                    "observation": normal(OBS),
                    "reward": normal(1),
                    "cost": normal(1).abs(),
                    "terminated": terminated,
                    "truncated": truncated,
                    "done": terminated | truncated,
                },
            },
            batch_size=shape,
        )

    return make
