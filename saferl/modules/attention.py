"""Attention over the vehicles of a scene: embedded tokens, and the two hops of MMAM."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from saferl.modules.scene import (
    MASKED,
    check_sizes,
    feature_scale,
    flat_linear,
    scale_ego,
    scale_vehicles,
)


class Linear(nn.Linear):
    def forward(self, input: Tensor) -> Tensor:
        return flat_linear(input, self.weight, self.bias)


class SceneTokens(nn.Module):
    """Embeds the EV and the SVs apart (linear + GELU): tokens [*B, 1 + M, d] and presence."""

    ego_scale: Tensor
    vehicle_scale: Tensor

    def __init__(self, width: int, ego_scale: Sequence[float], vehicle_scale: Sequence[float]):
        super().__init__()
        self.register_buffer("ego_scale", feature_scale("ego_scale", ego_scale))
        self.register_buffer("vehicle_scale", feature_scale("vehicle_scale", vehicle_scale))
        self.ego = Linear(len(ego_scale), width)
        self.vehicle = Linear(len(vehicle_scale), width)

    def forward(self, ego: Tensor, vehicles: Tensor) -> tuple[Tensor, Tensor]:
        features, present = scale_vehicles(vehicles, self.vehicle_scale)
        ego_token = F.gelu(self.ego(scale_ego(ego, self.ego_scale))).unsqueeze(-2)
        tokens = torch.cat([ego_token, F.gelu(self.vehicle(features))], dim=-2)
        # The EV is always there, so no softmax ever runs over absent rows alone. Not F.pad: in float64
        # torch 2.13 generates C++ from it that does not compile for AVX2.
        return tokens, torch.cat([present.new_ones((*present.shape[:-1], 1)), present], dim=-1)


class _Attention(nn.Module):
    """What both hops share: the number of heads and the divisor of the logits (AttnE1)."""

    def __init__(self, width: int, heads: int, scale: str):
        super().__init__()
        check_sizes(width=width, heads=heads)
        if width % heads:
            raise ValueError(f"width must be a multiple of heads, got {width} and {heads}.")
        if scale not in ("paper", "per_head"):
            raise ValueError(f"scale must be 'paper' or 'per_head', got {scale!r}.")
        self.heads = heads
        self.divisor = math.sqrt(width if scale == "paper" else width // heads)
        self.merge = Linear(width, width, bias=False)


class SelfAttention(_Attention):
    """Multi-head self-attention over all rows: tokens [*B, N, d] -> [*B, N, d]."""

    def __init__(self, width: int, heads: int, scale: str):
        super().__init__(width, heads, scale)
        self.query_key_value = Linear(width, 3 * width, bias=False)

    def forward(self, tokens: Tensor, present: Tensor) -> Tensor:
        split = self.query_key_value(tokens).unflatten(-1, (3, self.heads, -1))
        query, key, value = split.unbind(-3)
        # Keys first: a softmax over a long way through memory is several times faster than over 12 neighbours.
        logits = torch.einsum("...qhd,...khd->...kqh", query / self.divisor, key)
        weights = logits.masked_fill(~present[..., None, None], MASKED).softmax(-3)
        return self.merge(torch.einsum("...kqh,...khd->...qhd", weights, value).flatten(-2))


class EgoAttention(_Attention):
    """Multi-head attention whose only query is the EV's row.

    One query needs no keys or values of the tokens: with key_j = W_K x_j, a head's logit is
    x_j . (W_K^T q), and its output W_V (sum_j w_j x_j). Both are exact, and cost O(d^2) for a scene
    in place of O(N d^2).
    """

    def __init__(self, width: int, heads: int, scale: str):
        super().__init__(width, heads, scale)
        self.query = Linear(width, width, bias=False)
        self.key = Linear(width, width, bias=False)
        self.value = Linear(width, width, bias=False)

    def folded_query(self, row: Tensor) -> Tensor:
        """W_K^T q / divisor of each head: row [*B, d] -> [*B, h, d]."""
        query = self.query(row).unflatten(-1, (self.heads, -1))
        weight = self.key.weight.unflatten(0, (self.heads, -1))
        return torch.einsum("...hk,hkd->...hd", query, weight) / self.divisor

    def folded_value(self, readout: Tensor) -> Tensor:
        """What a token adds to `readout . output` in each head: readout [d] -> [h, d]."""
        readout = (readout @ self.merge.weight).unflatten(-1, (self.heads, -1))
        return torch.einsum("hk,hkd->hd", readout, self.value.weight.unflatten(0, (self.heads, -1)))

    def weights(self, row: Tensor, tokens: Tensor, present: Tensor) -> Tensor:
        """Of each head on each token: [*B, h, N]."""
        logits = self.folded_query(row) @ tokens.mT
        return logits.masked_fill(~present.unsqueeze(-2), MASKED).softmax(-1)

    def forward(self, row: Tensor, tokens: Tensor, present: Tensor) -> Tensor:
        weights = self.weights(row, tokens, present)
        weight = self.value.weight.unflatten(0, (self.heads, -1))
        heads = torch.einsum("...hd,hkd->...hk", weights @ tokens, weight)
        return self.merge(heads.flatten(-2))
