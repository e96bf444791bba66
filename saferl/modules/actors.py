"""Stochastic policies over the action box [-1, 1]^A."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType
from torchrl.modules import ProbabilisticActor, TanhNormal


class GaussianHead(nn.Module):
    """An encoder followed by a linear map to the location and scale of a Gaussian.

    Args:
        encoder: maps its inputs to features [*B, width].
        width: size of these features.
        action_dim: A, size of the action.
        scale_lb: smallest standard deviation before the tanh.
        scale_init: the one that the policy begins with, about.

    Returns ``loc`` and ``scale``, each [*B, A]; the scale is ``scale_init`` where the map gives 0.

    Raises:
        ValueError: ``scale_init`` is not above ``scale_lb``.

    Examples:
        >>> import torch
        >>> from saferl.modules import GaussianHead
        >>> loc, scale = GaussianHead(torch.nn.Linear(3, 8), width=8)(torch.zeros(4, 3))
        >>> loc.shape, bool((scale > 0).all())
        (torch.Size([4, 2]), True)
    """

    def __init__(
        self,
        encoder: nn.Module,
        width: int,
        action_dim: int = 2,
        scale_lb: float = 0.01,
        scale_init: float = 1.0,
    ):
        super().__init__()
        if not scale_init > scale_lb:
            raise ValueError(f"scale_init must be > scale_lb={scale_lb}, got {scale_init}.")
        self.encoder = encoder
        self.head = nn.Linear(width, 2 * action_dim)
        mapping = f"biased_softplus_{scale_init}_{scale_lb}"
        self.extract = NormalParamExtractor(mapping, scale_lb=scale_lb)  # pyright: ignore[reportArgumentType]

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        return self.extract(self.head(self.encoder(*inputs)))


def tanh_gaussian_actor(
    encoder: nn.Module,
    width: int,
    action_dim: int = 2,
    in_keys: Sequence[NestedKey] = ("ego", "vehicles"),
    *,
    scale_lb: float = 0.01,
    scale_init: float = 1.0,
) -> ProbabilisticActor:
    """A tanh-squashed Gaussian policy, as soft actor-critic needs (Haarnoja et al., 2018).

    With u ~ N(loc, scale^2) the action is tanh(u), in the box [-1, 1]^A (TorchRL's ``ActionScaling`` brings another box
    to this one); under ``set_exploration_type(ExplorationType.DETERMINISTIC)`` it is tanh(loc). Actions stay 1e-6
    (float32) inside the box so that their log-probability can be computed from a stored action too.

    Args:
        encoder: maps the entries ``in_keys`` to features [*B, width].
        width: size of these features.
        action_dim: A, size of the action.
        in_keys: entries that the encoder takes, in its order.
        scale_lb: smallest standard deviation before the tanh.
        scale_init: the one that the policy begins with, about.

    Reads ``in_keys``. Writes ``loc``, ``scale`` and ``action`` [*B, A], ``action_log_prob`` [*B].

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from saferl.modules import MLPPolicyEncoder, tanh_gaussian_actor
        >>> actor = tanh_gaussian_actor(MLPPolicyEncoder(rows=3, width=32), width=32)
        >>> td = TensorDict(ego=torch.randn(5, 9), vehicles=torch.zeros(5, 3, 6), batch_size=5)
        >>> actor(td)["action"].shape, td["action_log_prob"].shape
        (torch.Size([5, 2]), torch.Size([5]))
    """
    head = GaussianHead(encoder, width, action_dim, scale_lb, scale_init)
    return ProbabilisticActor(
        TensorDictModule(head, in_keys=list(in_keys), out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=["action"],
        spec=Bounded(low=-1.0, high=1.0, shape=torch.Size((action_dim,))),
        distribution_class=TanhNormal,
        # Without safe_tanh float32 rounds tanh(9.1) to 1, whose inverse is infinite.
        distribution_kwargs={"low": -1.0, "high": 1.0, "safe_tanh": True},
        return_log_prob=True,
        default_interaction_type=ExplorationType.RANDOM,
    )
