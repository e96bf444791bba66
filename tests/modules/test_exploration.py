"""Random actions that are held: how many, for how long, and when none."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Unbounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from saferl.modules import HeldActions

SPEC = Bounded(torch.tensor([-1.0, 2.0]), torch.tensor([1.0, 3.0]), (2,))


def actions(share: float, hold: int, steps: int = 400, envs: int = 300) -> torch.Tensor:
    """Actions [steps, envs, 2] of a policy that always says 0, which no random action's second entry is."""
    torch.manual_seed(0)
    explore, data, seen = HeldActions(SPEC, share, hold), TensorDict(batch_size=envs), []
    for _ in range(steps):
        seen.append(explore(data.set("action", torch.zeros(envs, 2)))["action"].clone())
    return torch.stack(seen)


@pytest.mark.parametrize(("share", "hold"), [(0.05, 5), (0.3, 1), (0.5, 10), (0.0, 5), (1.0, 5)])
def test_the_share_is_random_and_each_is_held(share, hold):
    seen = actions(share, hold)
    random = seen[..., 1] != 0
    assert abs(random[50:].float().mean().item() - share) < 0.01
    values = seen[random]
    assert (values >= SPEC.low).all() and (values <= SPEC.high).all()
    if share > 0:
        middle = (values - SPEC.low) / (SPEC.high - SPEC.low)
        assert (middle.mean(0) - 0.5).abs().max() < 0.02  # uniform in the box
    lengths = set()
    for env in seen.unbind(1):
        values, counts = torch.unique_consecutive(env, dim=0, return_counts=True)
        inner = [int(c) for v, c in zip(values, counts, strict=True) if v[1] != 0][1:-1]
        lengths |= set(inner)
    assert lengths == ({hold} if share > 0 else set())


def test_tests_see_none():
    data = TensorDict(action=torch.zeros(50, 2), batch_size=50)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert (HeldActions(SPEC, 1.0)(data)["action"] == 0).all()


def test_what_a_rollout_keeps_is_all_its_state():
    """Another object goes on with what is held."""
    first = HeldActions(SPEC, 1.0, 3)
    data = first(TensorDict(action=torch.zeros(4, 2), batch_size=4))
    held = data["action"].clone()
    assert data["held_steps"].flatten().tolist() == [2] * 4
    data = HeldActions(SPEC, 0.0, 3)(data.set("action", torch.zeros(4, 2)))
    assert torch.equal(data["action"], held)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"spec": SPEC, "share": 1.5}, r"share must be in \[0, 1\], got 1.5"),
        ({"spec": SPEC, "share": 0.1, "hold": 0}, "hold must be >= 1, got 0"),
        ({"spec": Unbounded((2,)), "share": 0.1}, "need bounds, got Unbounded"),
    ],
)
def test_errors(settings, message):
    with pytest.raises(ValueError, match=message):
        HeldActions(**settings)
