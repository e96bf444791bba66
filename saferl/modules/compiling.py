"""Compiling of functions that meet TensorDicts."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import torch


def compiled(function: Callable, mode: str | None = None) -> Callable:
    """``function`` compiled, each shape of its inputs anew, without warnings about how TensorDict compiles.

    Args:
        function: of tensors, TensorDicts and modules.
        mode: as of ``torch.compile``; ``"reduce-overhead"`` replays CUDA graphs, so that a GPU does not
            wait for Python, and what a call returns is valid until the next call.

    Examples:
        >>> import torch
        >>> from saferl.modules import compiled
        >>> compiled(torch.sin)(torch.zeros(2))
        tensor([0., 0.])
    """
    fast = torch.compile(function, dynamic=False, mode=mode)

    def quietly(*args, **kwargs):
        with warnings.catch_warnings():  # at the first call, or at a later one with another shape
            warnings.filterwarnings("ignore", module="tensordict|torch._dynamo")
            return fast(*args, **kwargs)

    return quietly
