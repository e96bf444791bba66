"""What a batch may look like: shapes, masks, weights, missing observations."""

from __future__ import annotations

import pytest
import torch
from outputs import LOSSES, SCALARS, assert_same, run
from tensordict import TensorDict


@pytest.mark.parametrize("critics", [1, 2, 3])
def test_reductions_agree(make_loss, make_batch, critics):
    batch = make_batch()
    outputs = {
        reduction: run(make_loss(reduction=reduction, num_cost_critics=critics), batch)
        for reduction in ("none", "mean", "sum")
    }
    assert outputs["none"].batch_size == batch.batch_size
    assert set(outputs["none"].keys()) == {*LOSSES, "constraint_violation"}
    for key in LOSSES:
        torch.testing.assert_close(outputs["none"][key].mean(), outputs["mean"][key])
        torch.testing.assert_close(outputs["none"][key].sum(), outputs["sum"][key])
    # The violation feeds a step of the multiplier, which must not scale with the batch.
    for reduction in ("mean", "sum"):
        violation = outputs[reduction]["constraint_violation"]
        torch.testing.assert_close(outputs["none"]["constraint_violation"].mean(), violation)
        assert all(outputs[reduction][key].shape == () for key in SCALARS)


def test_scalars_without_reduction(make_loss, make_batch):
    loss = make_loss(reduction="none", scalar_output_mode="non_tensor")
    output = loss(make_batch())
    assert set(output.keys()) == set(loss.out_keys)
    torch.testing.assert_close(output["lagrange_multiplier"], loss.lagrange.value)


def test_time_batches_equal_flat_ones(make_loss, make_batch):
    loss, batch = make_loss(), make_batch(4, 6)
    assert_same(run(loss, batch), run(loss, batch.reshape(-1)))
    each = run(make_loss(reduction="none"), batch)
    assert each.batch_size == (4, 6)
    flat = run(make_loss(reduction="none"), batch.reshape(-1))
    assert_same(TensorDict(each.to_dict()), TensorDict(flat.reshape(4, 6).to_dict()))


@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_priority_weights(make_loss, make_batch, reduction):
    batch = make_batch()
    each = run(make_loss(reduction="none"), batch)
    weights = torch.linspace(0.1, 2.0, 8)
    output = run(make_loss(reduction=reduction), batch.set("priority_weight", weights))
    for key in (*LOSSES, "constraint_violation"):
        expected = (weights * each[key]).sum()
        if reduction == "mean" or key == "constraint_violation":
            expected = expected / weights.sum()
        torch.testing.assert_close(output[key], expected)
    ignoring = make_loss(reduction=reduction, use_prioritized_weights=False)
    plain = batch.exclude("priority_weight")
    assert_same(run(ignoring, batch), run(make_loss(reduction=reduction), plain))


def test_padded_steps_do_not_count(make_loss, make_batch):
    batch = make_batch()
    valid = torch.arange(8) < 5
    each = run(make_loss(reduction="none"), batch)
    output = run(make_loss(), batch.set(("collector", "mask"), valid.unsqueeze(-1)))
    for key in (*LOSSES, "constraint_violation"):
        torch.testing.assert_close(output[key], each[key][valid].mean())


def test_nan_next_observation_at_termination_changes_nothing(make_loss, make_batch):
    loss, batch = make_loss(), make_batch()
    poisoned = batch.clone()
    final = batch["next", "terminated"].squeeze(-1)
    poisoned["next", "observation"][final] = float("nan")
    clean, output = run(loss, batch), run(loss, poisoned)
    assert_same(output, clean)
    sum(output[key] for key in LOSSES).backward()
    assert all(leaf.grad.isfinite().all() for leaf in loss.parameters())
    # Where the episode goes on, a missing observation is an error that must be seen.
    poisoned["next", "observation"][~final] = float("nan")
    output = run(loss, poisoned)
    assert output["loss_cost"].isnan() and output["loss_qvalue"].isnan()


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_dispatch_without_a_tensordict(make_loss, make_batch, reduction):
    loss, batch = make_loss(reduction=reduction), make_batch()
    expected = run(loss, batch)
    entries = {"_".join(key) if isinstance(key, tuple) else key for key in loss.in_keys}
    flat = batch.flatten_keys("_").to_dict()
    torch.manual_seed(3)
    values = loss(**{key: flat[key] for key in entries})
    assert len(values) == len(loss.out_keys)
    assert_same(TensorDict(dict(zip(loss.out_keys, values, strict=True))), expected)
    loss.select_out_keys("loss_cost", "constraint_violation")
    torch.manual_seed(3)
    cost, violation = loss(**{key: flat[key] for key in entries})
    torch.testing.assert_close(cost, expected["loss_cost"])
    torch.testing.assert_close(violation, expected["constraint_violation"])
