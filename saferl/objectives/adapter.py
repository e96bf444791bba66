"""What TorchRL's losses keep under an underscore: saferl's touch it here and nowhere else.

But for ``_AcceptedKeys``, which TorchRL asks every loss to define.
"""

from __future__ import annotations

from copy import deepcopy
from typing import TYPE_CHECKING, Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Distribution
from torchrl.objectives import ClipPPOLoss, SACLoss

from saferl.objectives.checks import check_gamma

if TYPE_CHECKING:
    from torchrl.objectives import LossModule as _Loss
else:
    _Loss = object


class LossMixin(_Loss):
    """What a loss of ours adds to one of TorchRL's; comes before it among the bases of a class.

    It is no :class:`~torchrl.objectives.LossModule` itself: TorchRL gives every subclass of that a ``forward``, which
    would hide the loss's from ``super()``. A subclass says which entries it reads (:meth:`read_keys`), and what a second
    value estimator, of the cost, calls them (:meth:`cost_estimator_keys`); :meth:`reduced` reduces its terms.
    """

    tensor_keys: Any  # of the loss, with the keys of ours
    cost_critic: TensorDictModule
    _cost_value_estimator: Any

    def read_keys(self) -> list[NestedKey]:
        """The entries that ``forward`` reads, as ``in_keys`` lists them."""
        raise NotImplementedError

    def cost_estimator_keys(self) -> dict[str, NestedKey]:
        """The entries of the cost's estimator, by its own names for them."""
        raise NotImplementedError

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> None:
        """Build the value estimators of the reward and of the cost, alike.

        Args:
            value_type (ValueEstimators, ValueEstimatorBase or type, optional): as in
                TorchRL's losses, with the same default.
            **hyperparams: of the estimator, such as ``gamma``.

        Raises:
            ValueError: ``gamma`` lies outside [0, 1].
        """
        check_gamma(hyperparams)
        super().make_value_estimator(value_type, **hyperparams)
        self._cost_value_estimator = deepcopy(self.value_estimator)
        if self.value_estimator.value_network is not None:
            # The copy shares the functional network's structure only; whose values it takes is said here.
            self._cost_value_estimator.value_network = self.cost_critic
        self.set_keys()  # no other ones: both estimators are told

    def reduced(
        self,
        loss: Tensor,
        tensordict: TensorDictBase,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> Tensor:
        """A term ``[*B]`` reduced as the loss says: without padded steps, weighed by a prioritised buffer's weights.

        Args:
            loss: of each sample.
            tensordict: the batch ``[*B]``, which holds masks and weights.
            reduction (optional): another one than the loss's own.
        """
        weights = self._maybe_get_priority_weight(tensordict)
        return self._reduce_loss(loss, tensordict, reduction=reduction, weights=weights)

    def release(self, *tensordicts: TensorDictBase | str) -> None:
        """What ``torch.compile`` asks for at the end of a ``forward``: no references to parameters and batches."""
        self._clear_weakrefs(*tensordicts)

    @property
    def buffer_device(self) -> torch.device:
        """That of the first parameter, as TorchRL's losses have it; without any, the default device."""
        return next((p.device for p in self.parameters()), torch.get_default_device())

    def _maybe_get_priority_weight(self, tensordict: TensorDictBase) -> Tensor | None:
        key = getattr(self.tensor_keys, "priority_weight", None)
        if key is None or self.use_prioritized_weights not in (True, "auto"):
            return None
        # TorchRL looks for a nested key among the flat ones, and raises.
        return tensordict.get(key, None)

    def _set_in_keys(self) -> None:
        self.in_keys = self.read_keys()  # pyright: ignore[reportAttributeAccessIssue]

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        super()._forward_value_estimator_keys(**kwargs)
        estimator = getattr(self, "_cost_value_estimator", None)
        if estimator is not None:
            estimator.set_keys(**self.cost_estimator_keys())


class SACTerms(SACLoss):
    """:class:`~torchrl.objectives.SACLoss` with its temperature and that one's term in the open."""

    log_alpha: Tensor

    @property
    def temperature(self) -> Tensor:
        """alpha, within its bounds; no gradient."""
        return self._alpha

    def temperature_term(self, log_prob: Tensor) -> Tensor:
        """The temperature's loss ``[*B]`` from the policy's log-probabilities ``[*B]``; a subclass may have another."""
        return super()._alpha_loss(log_prob)

    def _alpha_loss(self, log_prob: Tensor) -> Tensor:
        return self.temperature_term(log_prob)


class PPOTerms(ClipPPOLoss):
    """:class:`~torchrl.objectives.ClipPPOLoss` with what its objective is made of in the open."""

    def log_ratio(self, tensordict: TensorDictBase) -> tuple[Tensor, Distribution]:
        """Of the policy's probability of each action to that of the policy that acted ``[*B, 1]``, and the policy."""
        log_ratio, policy, *_ = self._log_weight(tensordict.copy(), adv_shape=tensordict.shape)
        return log_ratio, policy

    def clip(self, log_ratio: Tensor) -> Tensor:
        """The logarithm of a ratio that is held within ``clip_epsilon`` of 1."""
        return log_ratio.clamp(*self._clip_bounds)

    def standardised(self, tensordict: TensorDictBase) -> Tensor:
        """``"advantage"`` as the objective has it ``[*B, 1]``."""
        advantage = tensordict.get(self.tensor_keys.advantage)
        return self._maybe_normalize_advantage(advantage, tensordict, update_norm=False)
