"""What the losses take from TorchRL's, and from whom."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
import torch
from torchrl.objectives import ClipPPOLoss, PPOLoss, SACLoss

import saferl.objectives
from saferl.objectives import CPOLoss, FOCOPSLoss, P3OLoss, PPOLagLoss, RiskPPOLoss, SACLagLoss
from saferl.objectives.adapter import LossMixin

FOLDER = Path(saferl.objectives.__file__).parent
#: What TorchRL asks every loss to define.
ASKED = {"_AcceptedKeys"}


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_the_adapter_alone_touches_what_is_torchrls_own(path: Path):
    theirs = {name for loss in (PPOLoss, ClipPPOLoss, SACLoss) for name in dir(loss)}
    theirs |= {"_value_estimator", "_in_keys", "_out_keys", "_target_entropy", "_tensor_keys"}
    touched = {
        node.attr if isinstance(node, ast.Attribute) else node.name
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Attribute | ast.FunctionDef)
    }
    private = {n for n in touched & theirs if n.startswith("_") and not n.startswith("__")}
    assert private <= ASKED or path.stem == "adapter"
    if path.stem == "adapter":
        assert {"_reduce_loss", "_alpha_loss"} <= private


@pytest.mark.parametrize(
    "kind", [SACLagLoss, PPOLagLoss, RiskPPOLoss, CPOLoss, P3OLoss, FOCOPSLoss]
)
def test_a_mixin_hides_no_method_of_the_loss_behind_it(kind: type):
    """super() from a loss of ours reaches the one of TorchRL."""
    mixins = [base for base in kind.__mro__ if issubclass(base, LossMixin)]
    plain = [base for base in mixins if not issubclass(base, torch.nn.Module)]
    assert plain and all("forward" not in vars(base) for base in plain)
