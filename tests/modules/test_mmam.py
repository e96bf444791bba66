"""MMAM against a plain formulation, and its symmetries."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from plain import PlainMMAMPolicyEncoder, PlainMMAMValue
from tensordict import TensorDict

from saferl.modules import (
    EGO_SCALE,
    VEHICLE_SCALE,
    MMAMPolicyEncoder,
    MMAMValue,
)

WIDTH, HEADS = 16, 4
SCALES = ["paper", "per_head"]
FORMS = [
    *(
        (kind, {"keys": keys})
        for keys in ("attended", "embedded")
        for kind in (MMAMPolicyEncoder, PlainMMAMPolicyEncoder)
    ),
    (MMAMValue, {}),
    (PlainMMAMValue, {}),
]


def scene(batch=(5,), present=3, absent=2, dtype=torch.float32, seed=0):
    generator = torch.Generator().manual_seed(seed)
    ego = torch.randn(*batch, 9, generator=generator, dtype=dtype) * 10
    vehicles = torch.randn(*batch, present + absent, 6, generator=generator, dtype=dtype) * 10
    vehicles[..., :present, 0] = 1.0
    vehicles[..., present:, :] = 0.0
    return ego, vehicles, torch.rand(*batch, 2, generator=generator, dtype=dtype) * 2 - 1


def make(kind, dtype=torch.float32, **options):
    torch.manual_seed(3)
    return kind(width=WIDTH, heads=HEADS, **options).to(dtype)


# --- the printed formulas, sample by sample, head by head, over the present rows only -----------


def multi_head(queries, tokens, w_q, w_k, w_v, w_o, scale):
    size = WIDTH // HEADS
    divisor = math.sqrt(WIDTH) if scale == "paper" else math.sqrt(size)
    heads = []
    for i in range(HEADS):
        rows = slice(i * size, (i + 1) * size)
        q, k, v = queries @ w_q[rows].T, tokens @ w_k[rows].T, tokens @ w_v[rows].T
        heads.append(torch.softmax(q @ k.T / divisor, dim=-1) @ v)
    return torch.cat(heads, dim=-1) @ w_o.T


def embed(net, ego, vehicles):
    tokens = net.tokens
    ego = ego / tokens.ego_scale
    rows = vehicles[vehicles[:, 0] > 0] / tokens.vehicle_scale
    z_ego = F.gelu(tokens.ego.weight @ ego + tokens.ego.bias)
    z_sv = F.gelu(rows @ tokens.vehicle.weight.T + tokens.vehicle.bias)
    return z_ego.unsqueeze(0), z_sv


def weights_of(hop):
    return (m.weight for m in (hop.query, hop.key, hop.value, hop.merge))


def plain_policy(net, ego, vehicles, scale):
    z_1 = torch.cat(embed(net, ego, vehicles))
    hop = net.self_attention
    if net.keys == "attended":
        weights = (*hop.query_key_value.weight.chunk(3), hop.merge.weight)
    else:
        weights = weights_of(hop)
    attended = z_1 + multi_head(z_1, z_1, *weights, scale)
    memory = attended if net.keys == "attended" else z_1
    row = attended[:1] + multi_head(attended[:1], memory, *weights_of(net.ego_attention), scale)
    row = row.squeeze(0)
    for layer in net.layers:
        row = F.gelu(layer(row))
    return row


def plain_value(net, ego, vehicles, action, scale):
    z_ego, z_sv = embed(net, ego, vehicles)
    z_action = F.gelu(net.action(action)).unsqueeze(0)
    z_2 = torch.cat([z_ego, z_sv, z_action])
    y_attn = multi_head(z_ego, z_2, *weights_of(net.attention), scale)
    pairs = [net.pair(torch.cat([row, z_ego[0], z_action[0]])) for row in z_sv]
    # Without any SV what the action and the EV add has nothing to be added to.
    pooled = F.gelu(torch.stack(pairs).amax(0)) if pairs else torch.zeros(WIDTH).to(ego)
    y_mlp = F.gelu(net.joint(torch.cat([z_ego, z_action, pooled.unsqueeze(0)], dim=-1)))
    for layer in net.layers:
        y_mlp = F.gelu(layer(y_mlp))
    return (y_attn @ net.w_attn.weight.T + y_mlp @ net.w_mlp.weight.T).squeeze(0)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize(("kind", "options"), FORMS)
@pytest.mark.parametrize("present", [0, 1, 3])
def test_equals_printed_formulas(kind, options, scale, present):
    """Values and all gradients, in float64, to 1e-10."""
    net = make(kind, torch.float64, scale=scale, **options)
    plain = plain_value if isinstance(net, MMAMValue) else plain_policy
    inputs = scene(present=present, dtype=torch.float64)
    inputs = [x.requires_grad_() for x in inputs[: 3 if isinstance(net, MMAMValue) else 2]]
    leaves = [*net.parameters(), *inputs]

    ours = net(*inputs)
    theirs = torch.stack([plain(net, *(x[i] for x in inputs), scale) for i in range(5)])
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-10)
    weight = torch.randn(ours.shape, dtype=ours.dtype, generator=torch.Generator().manual_seed(1))
    grads = [
        torch.autograd.grad((out * weight).sum(), leaves, allow_unused=True, materialize_grads=True)
        for out in (ours, theirs)
    ]
    for a, b in zip(*grads, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-10)


@pytest.mark.parametrize("kind", [MMAMPolicyEncoder, MMAMValue])
@pytest.mark.parametrize("scale", SCALES)
def test_order_and_absent_rows_do_not_matter(kind, scale):
    net = make(kind, scale=scale)
    ego, vehicles, action = scene(batch=(4, 2), present=5, absent=2)
    rest = () if kind is MMAMPolicyEncoder else (action,)
    expected = net(ego, vehicles, *rest)
    order = torch.tensor([6, 3, 0, 5, 2, 4, 1])
    garbage = torch.full((4, 2, 3, 6), torch.nan)
    garbage[..., 0] = 0.0
    for changed in (
        vehicles[..., order, :],
        vehicles[..., :5, :],
        torch.cat([torch.zeros(4, 2, 9, 6), vehicles], -2),
        torch.cat([garbage, vehicles], -2),  # absent rows are never read
    ):
        torch.testing.assert_close(net(ego, changed, *rest), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("kind", [MMAMPolicyEncoder, MMAMValue])
def test_no_vehicle_at_all(kind):
    net = make(kind)
    ego, _, action = scene()
    rest = () if kind is MMAMPolicyEncoder else (action,)
    none = net(ego, torch.zeros(5, 0, 6), *rest)
    assert none.isfinite().all()
    for rows in (1, 11):
        torch.testing.assert_close(
            net(ego, torch.zeros(5, rows, 6), *rest), none, rtol=0, atol=1e-5
        )


@pytest.mark.parametrize("kind", [MMAMPolicyEncoder, MMAMValue])
@pytest.mark.parametrize("batch", [(), (2, 1)])
def test_batch_dims(kind, batch):
    net = make(kind)
    inputs = scene(batch=batch)[: 2 if kind is MMAMPolicyEncoder else 3]
    out = net(*inputs)
    assert out.shape == (*batch, WIDTH if kind is MMAMPolicyEncoder else 1)
    flat = net(*(x.reshape(-1, *x.shape[len(batch) :]) for x in inputs))
    torch.testing.assert_close(out.reshape(flat.shape), flat)


def test_every_input_matters():
    """Each SV, the EV and the action move the value, and the two branches both do."""
    net = make(MMAMValue, torch.float64)
    ego, vehicles, action = (x.requires_grad_() for x in scene(absent=0, dtype=torch.float64))
    grads = torch.autograd.grad(net(ego, vehicles, action).sum(), [ego, vehicles, action])
    assert (grads[0] != 0).all() and (grads[2] != 0).all()
    assert (grads[1][..., 1:] != 0).all()
    grads = torch.autograd.grad(net(ego, vehicles, action).sum(), list(net.parameters()))
    assert all((g != 0).any() for g in grads)


def test_features_are_divided_by_the_scales():
    ego, vehicles, _ = scene()
    net = make(MMAMPolicyEncoder)
    plain = make(MMAMPolicyEncoder, ego_scale=[1.0] * 9, vehicle_scale=[1.0] * 6)
    scaled = vehicles / torch.tensor(VEHICLE_SCALE)
    torch.testing.assert_close(net(ego, vehicles), plain(ego / torch.tensor(EGO_SCALE), scaled))
    assert set(dict(net.named_buffers())) == {"tokens.ego_scale", "tokens.vehicle_scale"}


@pytest.mark.parametrize("kind", [MMAMPolicyEncoder, MMAMValue])
def test_functional_transforms(kind):
    """vmap over stacked parameters, vmap over samples, per-sample Jacobians, compile."""
    torch.manual_seed(0)
    nets = [kind(width=WIDTH, heads=HEADS) for _ in range(2)]
    inputs = scene()[: 2 if kind is MMAMPolicyEncoder else 3]
    params = TensorDict.from_modules(*nets, as_module=True)

    def call(params, *inputs):
        with params.to_module(nets[0], preserve_module_state=False):
            return nets[0](*inputs)

    each = torch.stack([net(*inputs) for net in nets])
    stacked = torch.vmap(call, (0, *(None for _ in inputs)))(params, *inputs)
    torch.testing.assert_close(stacked, each)
    torch.testing.assert_close(torch.vmap(nets[0])(*inputs), each[0])

    jacobian = torch.func.vmap(torch.func.jacrev(lambda *x: nets[0](*x).sum(), argnums=0))(*inputs)
    ego = inputs[0].clone().requires_grad_()
    (expected,) = torch.autograd.grad(nets[0](ego, *inputs[1:]).sum(), ego)
    torch.testing.assert_close(jacobian, expected)

    torch._dynamo.reset()
    compiled = torch.compile(nets[0], backend="aot_eager", fullgraph=True)
    torch.testing.assert_close(compiled(*inputs), each[0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"heads": 0}, "heads must be >= 1, got 0"),
        ({"width": 0}, "width must be >= 1, got 0"),
        ({"depth": -1}, r"depth must be >= \d, got -1"),
        ({"heads": 3}, "multiple of heads, got 16 and 3"),
        ({"scale": "sqrt"}, "'paper' or 'per_head', got 'sqrt'"),
        ({"ego_scale": [1.0, 0.0]}, r"ego_scale must be positive .* got \(1.0, 0.0\)"),
        ({"vehicle_scale": [1.0, math.inf]}, "vehicle_scale must be positive"),
    ],
)
@pytest.mark.parametrize("kind", [MMAMPolicyEncoder, MMAMValue])
def test_errors(kind, options, message):
    with pytest.raises(ValueError, match=message):
        kind(**{"width": 16, **options})


def test_unknown_forms_are_refused():
    with pytest.raises(ValueError, match="keys must be 'attended' or 'embedded', got 'both'"):
        MMAMPolicyEncoder(16, keys="both")
    with pytest.raises(ValueError, match="outputs must be >= 1, got 0"):
        MMAMValue(16, outputs=0)


def test_other_features_are_refused():
    """A single one would be repeated."""
    ego, vehicles, _ = scene()
    encoder = make(MMAMPolicyEncoder)
    with pytest.raises(ValueError, match=r"ego must have 9 features, got shape \(\d+, 1\)"):
        encoder(ego[..., :1], vehicles)
    with pytest.raises(ValueError, match="vehicles must have 6 features, got shape"):
        encoder(ego, vehicles[..., :1])
