"""Multi-hop and MLP-mixed attention (MMAM): the paper's policy encoder and value network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from saferl.modules.attention import EgoAttention, Linear, SceneTokens, SelfAttention
from saferl.modules.encoder import Encoder
from saferl.modules.scene import (
    EGO_SCALE,
    MASKED,
    VEHICLE_SCALE,
    check_sizes,
    flat_linear,
    largest,
)


class MMAMPolicyEncoder(nn.Module):
    """Two-hop attention features of a scene for a policy (paper, Fig. f5 and AttnE1).

    The EV and the SVs are embedded apart (linear + GELU) into Z_1; multi-head self-attention over
    all rows is added to Z_1; the EV's row of that sum is then the only query of a multi-head
    ego-attention, which is added to that row and passed through ``depth`` layers (ours: without them
    an empty road would leave a policy with one hidden layer). The operator T and the W_i of AttnE1
    are two linear maps in a row, hence one matrix here. All activations are GELU.

    The paper does not say where the keys and values of the second hop come from. With
    ``keys="attended"`` it is the sum, so that what the SVs mean to each other reaches the EV; with
    ``keys="embedded"`` it is Z_1, and of the first hop only the EV's row is ever computed, at about
    a fifth of the arithmetic.

    Absent rows (I_veh = 0) are zeroed and get -1e9 before the softmax, so neither the order of the
    SVs nor the number of absent rows matters, and any number of rows works, none included.

    Args:
        width: d, the size of a token and of the output.
        heads: h, a divisor of ``width``.
        scale: logits are divided by sqrt(d) (``"paper"``, as printed) or sqrt(d / h)
            (``"per_head"``, the usual one).
        keys: where the second hop looks, ``"attended"`` or ``"embedded"`` (see above).
        depth: layers of ``width`` units after the attention (ours).
        ego_scale: divisors of the ego features; their number is the size of ``ego``.
        vehicle_scale: divisors of a vehicle's features; I_veh comes first.

    Reads ``ego`` [*B, F] and ``vehicles`` [*B, M, G], SI units, as many features as scales; returns features [*B, width].

    Raises:
        ValueError: if ``heads`` does not divide ``width``, ``scale`` or ``keys`` is unknown, or a
            feature scale is not positive and finite.

    Examples:
        >>> import torch
        >>> from saferl.modules import MMAMPolicyEncoder
        >>> encoder = MMAMPolicyEncoder(width=32)
        >>> encoder(torch.randn(5, 9), torch.zeros(5, 11, 6)).shape
        torch.Size([5, 32])
    """

    in_keys = ("ego", "vehicles")

    def __init__(
        self,
        width: int = 256,
        heads: int = 4,
        scale: str = "paper",
        keys: str = "attended",
        depth: int = 2,
        ego_scale: Sequence[float] = EGO_SCALE,
        vehicle_scale: Sequence[float] = VEHICLE_SCALE,
    ):
        super().__init__()
        check_sizes(width=width)
        if depth < 0:
            raise ValueError(f"depth must be >= 0, got {depth}.")
        if keys not in ("attended", "embedded"):
            raise ValueError(f"keys must be 'attended' or 'embedded', got {keys!r}.")
        self.keys = keys
        self.tokens = SceneTokens(width, ego_scale, vehicle_scale)
        # With one row to compute, self-attention is ego-attention.
        first = SelfAttention if keys == "attended" else EgoAttention
        self.self_attention = first(width, heads, scale)
        self.ego_attention = EgoAttention(width, heads, scale)
        self.layers = nn.ModuleList(Linear(width, width) for _ in range(depth))

    def _first_hop(self, ego: Tensor, vehicles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What the second hop looks from and at: the EV's row [*B, d], tokens [*B, N, d], which are there."""
        tokens, present = self.tokens(ego, vehicles)
        if self.keys == "attended":
            tokens = tokens + self.self_attention(tokens, present)
            return tokens[..., 0, :], tokens, present
        row = tokens[..., 0, :]
        return row + self.self_attention(row, tokens, present), tokens, present

    def attention(self, ego: Tensor, vehicles: Tensor) -> Tensor:
        """The weights of the ego-attention, the second hop, for pictures of what the EV looks at.

        Args:
            ego, vehicles: as the encoder reads them, [*B, F] and [*B, M, G].

        Returns:
            [*B, h, M + 1], which sum to 1 over the last dimension: on the EV itself first, then on each row of
            ``vehicles``, 0 on absent ones.

        Examples:
            >>> import torch
            >>> from saferl.modules import MMAMPolicyEncoder
            >>> MMAMPolicyEncoder(width=32).attention(torch.randn(5, 9), torch.zeros(5, 3, 6))[0, 0]
            tensor([1., 0., 0., 0.], grad_fn=<SelectBackward0>)
        """
        return self.ego_attention.weights(*self._first_hop(ego, vehicles))

    def forward(self, ego: Tensor, vehicles: Tensor) -> Tensor:
        row, tokens, present = self._first_hop(ego, vehicles)
        row = row + self.ego_attention(row, tokens, present)
        for layer in self.layers:
            row = F.gelu(layer(row))
        return row


class MMAMValue(nn.Module):
    """Action value from ego-attention and an MLP branch (paper, Fig. f5 and AttnE2).

    Q(s, a) = Y_attn . W_attn + Y_mlp . W_mlp over the N + 2 tokens of Z_2 (EV, SVs, action). Y_attn
    is one hop of multi-head ego-attention. Y_mlp is permutation-invariant (ours): a layer sees each SV
    together with the EV and the action, and the largest of its outputs over the SVs that are present goes, with
    the tokens of EV and action, through ``depth`` layers. All have ``width`` units and GELU; the largest is
    taken before the activation, where the action shifts all SVs alike, so that no action changes which it is.

    Args:
        width: d, the size of a token and of both branches.
        heads: h, a divisor of ``width``.
        scale: ``"paper"`` or ``"per_head"``, see :class:`MMAMPolicyEncoder`.
        action_dim: size of the action.
        depth: layers of the MLP branch after that, at least one (ours).
        ego_scale: divisors of the ego features.
        vehicle_scale: divisors of a vehicle's features; I_veh comes first.
        outputs: K, more than one for the quantiles of a distributional critic; what the attention reads
            shifts them all alike (ours).
        layer_norm: normalise each layer of the MLP branch but the first, on the SVs, before its activation, without gain
            or bias.

    Reads ``ego`` [*B, F], ``vehicles`` [*B, M, G] (SI units, as many features as scales) and ``action`` [*B, 2] in [-1, 1];
    returns values [*B, K].

    Raises:
        ValueError: as :class:`MMAMPolicyEncoder`.

    Examples:
        >>> import torch
        >>> from saferl.modules import MMAMValue
        >>> value = MMAMValue(width=32)
        >>> ego, vehicles, action = torch.randn(5, 9), torch.zeros(5, 11, 6), torch.zeros(5, 2)
        >>> value(ego, vehicles, action).shape
        torch.Size([5, 1])
        >>> scene = value.encode(ego, vehicles)  # once for any number of actions
        >>> torch.allclose(value.value(scene, action), value(ego, vehicles, action))
        True
    """

    in_keys = ("ego", "vehicles")

    def __init__(
        self,
        width: int = 256,
        heads: int = 4,
        scale: str = "paper",
        action_dim: int = 2,
        depth: int = 2,
        ego_scale: Sequence[float] = EGO_SCALE,
        vehicle_scale: Sequence[float] = VEHICLE_SCALE,
        outputs: int = 1,
        layer_norm: bool = False,
    ):
        super().__init__()
        check_sizes(width=width, depth=depth, outputs=outputs)
        self.tokens = SceneTokens(width, ego_scale, vehicle_scale)
        self.action = Linear(action_dim, width)
        self.attention = EgoAttention(width, heads, scale)
        # On (SV, EV, action), and on (EV, action, the largest of that).
        self.pair = Linear(3 * width, width)
        self.joint = Linear(3 * width, width)
        self.layers = nn.ModuleList(Linear(width, width) for _ in range(depth - 1))
        self.w_attn = Linear(width, 1, bias=False)
        self.w_mlp = Linear(width, outputs, bias=False)
        self.layer_norm = layer_norm

    @property
    def readouts(self) -> list[nn.Linear]:
        """What the output is the sum of."""
        return [self.w_attn, self.w_mlp]

    def _activate(self, hidden: Tensor) -> Tensor:
        return F.gelu(F.layer_norm(hidden, hidden.shape[-1:]) if self.layer_norm else hidden)

    def encode(self, ego: Tensor, vehicles: Tensor) -> dict[str, Any]:
        """All that :meth:`value` needs: what no action changes, and the weights on the action."""
        tokens, present = self.tokens(ego, vehicles)
        ego_token, vehicle_tokens = tokens[..., 0, :], tokens[..., 1:, :]
        width = ego_token.shape[-1]
        query = self.attention.folded_query(ego_token)
        readout = self.attention.folded_value(self.w_attn.weight.squeeze(0))
        logits = (query @ tokens.mT).masked_fill(~present.unsqueeze(-2), MASKED)
        # A layer on concatenated tokens is a sum of one product for each of them.
        on_vehicle, on_ego, pair_on_action = self.pair.weight.split(width, dim=-1)
        pair = flat_linear(vehicle_tokens, on_vehicle, self.pair.bias)
        pair = largest(pair, present[..., 1:, None]) + flat_linear(ego_token, on_ego)
        on_ego, joint_on_action, on_pair = self.joint.weight.split(width, dim=-1)
        joint = flat_linear(ego_token, on_ego, self.joint.bias)
        scene = {"query": query, "logits": logits, "readings": flat_linear(tokens, readout).mT}
        scene |= {"pair": pair, "joint": joint, "joint_on_pair": on_pair}
        scene |= {"on_token": torch.cat([readout, joint_on_action, pair_on_action])}
        scene |= {"action": [self.action.weight, self.action.bias], "w_mlp": self.w_mlp.weight}
        return scene | {"layers": [[layer.weight, layer.bias] for layer in self.layers]}

    def value(self, scene: dict[str, Any], action: Tensor) -> Tensor:
        """The value of ``action`` [*B, A] in the states of ``scene``, [*B, K]."""
        token = F.gelu(flat_linear(action, *scene["action"]))
        logit = (scene["query"] @ token.unsqueeze(-1)).squeeze(-1)
        weights = torch.cat([scene["logits"], logit.unsqueeze(-1)], dim=-1).softmax(-1)
        heads, width = scene["query"].shape[-2:]
        # All that reads the action's token reads it in one product.
        reading, on_joint, on_pair = flat_linear(token, scene["on_token"]).split(
            [heads, width, width], dim=-1
        )
        y_attn = (weights[..., :-1] * scene["readings"]).sum((-2, -1))
        y_attn = y_attn + (weights[..., -1] * reading).sum(-1)
        pair = flat_linear(F.gelu(scene["pair"] + on_pair), scene["joint_on_pair"])
        y_mlp = scene["joint"] + on_joint + pair
        for weight, bias in scene["layers"]:
            y_mlp = flat_linear(self._activate(y_mlp), weight, bias)
        return y_attn.unsqueeze(-1) + flat_linear(self._activate(y_mlp), scene["w_mlp"])

    def forward(self, ego: Tensor, vehicles: Tensor, action: Tensor) -> Tensor:
        return self.value(self.encode(ego, vehicles), action)


@dataclass(frozen=True)
class MMAM(Encoder):
    """The paper's attention for all networks of an algorithm.

    Args:
        width, heads, scale, keys, depth: see :class:`MMAMPolicyEncoder` and :class:`MMAMValue`, which has no ``keys``.
        action_dim: size of the action.
        ego_scale: divisors of the ego features.
        vehicle_scale: divisors of a vehicle's features; I_veh comes first.

    Examples:
        >>> from saferl.modules import MMAM
        >>> encoder = MMAM(width=32)
        >>> type(encoder.policy()).__name__, type(encoder.value(outputs=8)).__name__
        ('MMAMPolicyEncoder', 'MMAMValue')
    """

    width: int = 256
    heads: int = 4
    scale: str = "paper"
    keys: str = "attended"
    depth: int = 2
    action_dim: int = 2
    ego_scale: Sequence[float] = EGO_SCALE
    vehicle_scale: Sequence[float] = VEHICLE_SCALE

    def policy(self) -> MMAMPolicyEncoder:
        return MMAMPolicyEncoder(**self.settings("action_dim"))

    def value(self, **options: Any) -> MMAMValue:
        return MMAMValue(**self.settings("keys"), **options)
