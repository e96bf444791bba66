"""Compiling of functions that meet TensorDicts."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import torch


def compiled(function: Callable, mode: str | None = None, cpp: bool = False) -> Callable:
    """``function`` compiled, each shape of its inputs anew, without warnings about how TensorDict compiles.

    Args:
        function: of tensors, TensorDicts and modules.
        mode: as of ``torch.compile``; ``"reduce-overhead"`` replays CUDA graphs, so that a GPU does not
            wait for Python, and what a call returns is valid until the next call.
        cpp: call the kernels from C++ in place of Python, for a ``function`` on CPU that is many small ones;
            without ``mode``.

    Examples:
        >>> import torch
        >>> from saferl.modules import compiled
        >>> compiled(torch.sin)(torch.zeros(2))
        tensor([0., 0.])
    """
    options = {"cpp_wrapper": True} if cpp else None
    fast = torch.compile(function, dynamic=False, mode=mode, options=options)

    def quietly(*args, **kwargs):
        with warnings.catch_warnings():  # at the first call, or at a later one with another shape
            warnings.filterwarnings("ignore", module="tensordict|torch._dynamo")
            return fast(*args, **kwargs)

    return quietly
