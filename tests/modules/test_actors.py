"""The tanh-Gaussian actor, alone and in TorchRL's SAC loss."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SACLoss

from saferl.modules import MMAMPolicyEncoder, MMAMValue, tanh_gaussian_actor, value_operator


@pytest.fixture
def actor():
    torch.manual_seed(0)
    return tanh_gaussian_actor(MMAMPolicyEncoder(width=16), width=16)


def scene(batch=(6,)):
    torch.manual_seed(1)
    return TensorDict(
        ego=torch.randn(*batch, 9), vehicles=torch.zeros(*batch, 3, 6), batch_size=batch
    )


@pytest.mark.parametrize("batch", [(), (2, 1)])
def test_deterministic_action_is_tanh_of_loc(actor, batch):
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        td = actor(scene(batch))
    torch.testing.assert_close(td["action"], td["loc"].tanh())
    assert td["action"].shape == (*batch, 2)


def test_samples_are_squashed_gaussians(actor):
    td = scene((1,)).expand(40_000).contiguous()
    td = actor(td)
    loc, scale = td["loc"][0], td["scale"][0]
    raw = td["action"].double().atanh()
    torch.testing.assert_close(raw.mean(0).float(), loc, rtol=0, atol=0.03)
    torch.testing.assert_close(raw.std(0).float(), scale, rtol=0.03, atol=0)
    # Change of variables by hand.
    normal = torch.distributions.Normal(loc.double(), scale.double())
    log_prob = (normal.log_prob(raw) - (1 - td["action"].double() ** 2).log()).sum(-1)
    inner = (td["action"].abs() < 0.999).all(-1)
    torch.testing.assert_close(
        td["action_log_prob"][inner].double(), log_prob[inner], rtol=0, atol=2e-3
    )


def test_saturated_actions_stay_inside_and_have_a_log_prob(actor):
    with torch.no_grad():
        actor.module[0].module.head.bias[:2] = 50.0
    td = actor(scene())
    assert (td["action"].abs() < 1).all()
    assert actor.get_dist(td).log_prob(td["action"]).isfinite().all()
    assert td["action_log_prob"].isfinite().all()


def test_in_the_sac_loss(actor):
    critics = [value_operator(MMAMValue(width=16)) for _ in range(2)]
    loss = SACLoss(actor, critics, action_spec=actor.spec["action"])
    loss.make_value_estimator(gamma=0.99)
    td = scene()
    td["action"] = torch.rand(6, 2) * 2 - 1
    td["next"] = scene().update({"reward": torch.randn(6, 1)})
    td["next"].update({key: torch.zeros(6, 1, dtype=torch.bool) for key in ("done", "terminated")})
    out = loss(td)
    sum(value for key, value in out.items() if key.startswith("loss_")).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in loss.parameters())
    # The list of critics keeps its initialisation.
    weight = loss.qvalue_network_params["module", "w_attn", "weight"]
    torch.testing.assert_close(
        weight.data, torch.stack([c.module.w_attn.weight for c in critics]).data
    )
