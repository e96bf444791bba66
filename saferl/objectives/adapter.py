"""What TorchRL's losses keep under an underscore: saferl's touch it here and nowhere else.

But for ``_AcceptedKeys``, which TorchRL asks every loss to define.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import SACLoss

if TYPE_CHECKING:
    from torchrl.objectives import LossModule as _Loss
else:
    _Loss = object


class LossMixin(_Loss):
    """What a loss of ours adds to one of TorchRL's; comes before it among the bases of a class.

    It is no :class:`~torchrl.objectives.LossModule` itself: TorchRL gives every subclass of that a ``forward``, which
    would hide the loss's from ``super()``. A subclass says which entries it reads (:meth:`read_keys`) and names them
    to the estimators that it adds (:meth:`name_keys`); :meth:`reduced` reduces its terms.
    """

    tensor_keys: Any  # of the loss, with the keys of ours

    def read_keys(self) -> list[NestedKey]:
        """The entries that ``forward`` reads, as ``in_keys`` lists them."""
        raise NotImplementedError

    def name_keys(self) -> None:
        """Tell the estimators of ours what the entries are called; nothing where there is none yet."""

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
        self.name_keys()


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
