"""MMAM as the paper prints it, with nothing folded or shared: the reference for the fast form.

The classes have the parameters of :class:`MMAMPolicyEncoder` and :class:`MMAMValue`, so that weights
can be exchanged, and project every token to keys and values. Use them to check a change, or to see
what the algebra of ``mmam.py`` saves (``benchmarks/update.py``).
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from saferl.modules.attention import EgoAttention
from saferl.modules.mmam import MMAM, MMAMPolicyEncoder, MMAMValue
from saferl.modules.scene import MASKED, largest


def _attend(
    queries: Tensor, keys: Tensor, values: Tensor, present: Tensor, heads: int, divisor: float
) -> Tensor:
    """Multi-head attention (AttnE1): queries [*B, R, d], keys and values [*B, N, d] -> [*B, R, d]."""
    query, key, value = (
        x.unflatten(-1, (heads, -1)).transpose(-3, -2) for x in (queries, keys, values)
    )
    logits = query @ key.mT / divisor
    logits = logits.masked_fill(~present[..., None, None, :], MASKED)
    return (logits.softmax(-1) @ value).transpose(-3, -2).flatten(-2)


def _ego_attend(hop: EgoAttention, row: Tensor, tokens: Tensor, present: Tensor) -> Tensor:
    """Attention of the EV's row [*B, d] to all tokens [*B, N, d]."""
    query = hop.query(row).unsqueeze(-2)
    keys, values = hop.key(tokens), hop.value(tokens)
    return hop.merge(_attend(query, keys, values, present, hop.heads, hop.divisor)).squeeze(-2)


class PlainMMAMPolicyEncoder(MMAMPolicyEncoder):
    """:class:`MMAMPolicyEncoder` as printed: the same arguments, parameters and output.

    Examples:
        >>> import torch
        >>> from plain import PlainMMAMPolicyEncoder
        >>> from saferl.modules import MMAMPolicyEncoder
        >>> encoder, plain = MMAMPolicyEncoder(width=32), PlainMMAMPolicyEncoder(width=32)
        >>> _ = plain.load_state_dict(encoder.state_dict())
        >>> scene = torch.randn(5, 9), torch.ones(5, 3, 6)
        >>> torch.allclose(plain(*scene), encoder(*scene), atol=1e-5)
        True
    """

    def forward(self, ego: Tensor, vehicles: Tensor) -> Tensor:
        embedded, present = self.tokens(ego, vehicles)
        hop = self.self_attention
        if isinstance(hop, EgoAttention):
            query, key, value = hop.query(embedded), hop.key(embedded), hop.value(embedded)
        else:
            query, key, value = hop.query_key_value(embedded).chunk(3, dim=-1)
        seen = _attend(query, key, value, present, hop.heads, hop.divisor)
        attended = embedded + hop.merge(seen)
        row = attended[..., 0, :]
        tokens = attended if self.keys == "attended" else embedded
        row = row + _ego_attend(self.ego_attention, row, tokens, present)
        for layer in self.layers:
            row = F.gelu(layer(row))
        return row


class PlainMMAMValue(MMAMValue):
    """:class:`MMAMValue` as printed: the same arguments, parameters and output.

    Examples:
        >>> import torch
        >>> from plain import PlainMMAMValue
        >>> from saferl.modules import MMAMValue
        >>> value, plain = MMAMValue(width=32), PlainMMAMValue(width=32)
        >>> _ = plain.load_state_dict(value.state_dict())
        >>> scene = torch.randn(5, 9), torch.ones(5, 3, 6), torch.zeros(5, 2)
        >>> torch.allclose(plain(*scene), value(*scene), atol=1e-5)
        True
    """

    encode = None  # pyright: ignore  (not split: an ensemble evaluates it whole for each action)

    def forward(self, ego: Tensor, vehicles: Tensor, action: Tensor) -> Tensor:
        tokens, present = self.tokens(ego, vehicles)
        action_token = F.gelu(self.action(action)).unsqueeze(-2)
        tokens = torch.cat([tokens, action_token], dim=-2)
        y_attn = _ego_attend(
            self.attention, tokens[..., 0, :], tokens, F.pad(present, (0, 1), value=True)
        )

        ego_token, vehicle_tokens = tokens[..., :1, :], tokens[..., 1:-1, :]
        rest = [x.expand_as(vehicle_tokens) for x in (ego_token, action_token)]
        pairs = self.pair(torch.cat([vehicle_tokens, *rest], dim=-1))
        pooled = F.gelu(largest(pairs, present[..., 1:, None]))
        parts = [ego_token.squeeze(-2), action_token.squeeze(-2), pooled]
        y_mlp = self._activate(self.joint(torch.cat(parts, dim=-1)))
        for layer in self.layers:
            y_mlp = self._activate(layer(y_mlp))
        return self.w_attn(y_attn) + self.w_mlp(y_mlp)


class PlainMMAM(MMAM):
    """MMAM with the networks as printed (``encoder._target_=plain.PlainMMAM``)."""

    def policy(self) -> PlainMMAMPolicyEncoder:
        return PlainMMAMPolicyEncoder(**self.settings("action_dim"))

    def value(self, **options: Any) -> PlainMMAMValue:
        return PlainMMAMValue(**self.settings("keys"), **options)
