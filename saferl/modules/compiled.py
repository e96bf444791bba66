"""Compiling of functions that meet TensorDicts."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_leaves, tree_unflatten

log = logging.getLogger(__name__)


class _NoState(TorchDispatchMode):
    """Refuses to read the value of a tensor that was there before: it would be a constant of the graph.

    Of what is made meanwhile, torch itself refuses what depends on the arguments; the rest is constant.
    """

    def __init__(self, name: str):
        super().__init__()
        self.name = name
        self.made: dict[int, Any] = {}  # by identity, and kept, so that no other gets it

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func is torch.ops.aten._local_scalar_dense.default and id(args[0]) not in self.made:
            raise RuntimeError(
                f"{self.name} reads the value of a tensor (float(), item(), a branch), which compiled code would "
                "never read again: keep it a tensor, or do not compile."
            )
        out = func(*args, **(kwargs or {}))
        self.made |= {id(leaf): leaf for leaf in tree_leaves(out)}
        return out


class Compiled:
    """A function as one graph of tensor operations for each form of its arguments, compiled.

    The function runs once, on the first arguments of a form, while its operations are written down, the
    gradients that it takes among them; it must change nothing in place. ``torch.compile`` gets that list. So a loss
    with hundreds of TensorDict operations compiles in seconds where following its Python takes minutes, and the
    graphs are this object's own: however many there are in a process, none takes another's place. It draws the
    random numbers that the function would, so that steps may be compiled or not in turn.

    Tensors that are no arguments, such as parameters, are read where they are: change them in place. All else is as
    it was at the first call: a number or an attribute that the function looks up, and what it decided by them; to read
    a tensor's value is refused. No gradient flows out of what is returned. With ``replay``, on a GPU, it is valid only
    until the next call.

    Args:
        function: of nested containers of tensors and constants, TensorDicts among them.
        name: of what is compiled, for the log.
        replay: on a GPU, whether the kernels are replayed as a CUDA graph. If not, what is returned stays valid and may be
            given back.
        cpp: on a CPU, whether the kernels are called from C++, all in one file, so that torch's headers are read once. This
            halves the time to compile hundreds of small kernels; a few large ones compile and run faster apart.

    Attributes:
        graphs: the compiled graphs, by the form of their arguments.

    Raises:
        RuntimeError: in a call, the function reads the value of a tensor.

    Examples:
        >>> import torch
        >>> from saferl.modules.compiled import Compiled
        >>> sine = Compiled(torch.sin, "the sine")
        >>> sine(torch.zeros(2)), sine(torch.zeros(2)), len(sine.graphs)
        (tensor([0., 0.]), tensor([0., 0.]), 1)
    """

    def __init__(self, function: Callable, name: str, replay: bool = True, cpp: bool = True):
        self.function, self.name, self.replay, self.cpp = function, name, replay, cpp
        self.graphs: dict[Any, Callable[[list[Tensor]], Any]] = {}

    def __getstate__(self) -> dict[str, Any]:
        # A graph reads the tensors of this object's function; a copy makes its own.
        return {**self.__dict__, "graphs": {}}

    @torch.no_grad()
    def __call__(self, *args: Any) -> Any:
        leaves, structure = tree_flatten(args)
        # Another object for each argument, or the graph would read one of two that are the same twice.
        tensors = [leaf.detach() for leaf in leaves if isinstance(leaf, Tensor)]
        form = (
            structure,
            *(
                (leaf.shape, leaf.stride(), leaf.dtype, leaf.device)
                if isinstance(leaf, Tensor)
                else (type(leaf), leaf)
                for leaf in leaves
            ),
        )
        if form in self.graphs:
            return self.graphs[form](tensors)
        begin = time.perf_counter()
        log.info("Compiling %s.", self.name)
        graph = self._compile(leaves, structure, tensors)
        result = graph(tensors)
        self.graphs[form] = graph
        log.info("Compiled %s in %.0f s.", self.name, time.perf_counter() - begin)
        return result

    def _compile(self, leaves: list, structure: Any, tensors: list[Tensor]) -> Callable:
        """The compiled function of ``tensors``; torch compiles it when it is first called."""
        returned: list[Any] = []

        def flat(tensors: list[Tensor]) -> list[Tensor]:
            given = iter(tensors)
            args = [next(given) if isinstance(leaf, Tensor) else leaf for leaf in leaves]
            with torch.enable_grad(), _NoState(self.name):
                returned[:] = tree_flatten(self.function(*tree_unflatten(args, structure)))
            return [leaf.detach() for leaf in returned[0] if isinstance(leaf, Tensor)]

        with torch.random.fork_rng():
            graph = make_fx(flat)(tensors)
        values, form = returned
        constants = {i: x for i, x in enumerate(values) if not isinstance(x, Tensor)}
        count = len(values)
        del values
        returned.clear()
        cuda = any(tensor.is_cuda for tensor in tensors)
        options: dict[str, Any] = {
            "fallback_random": True,
            # A GPU would wait for Python between many small kernels.
            "triton.cudagraphs": cuda and self.replay,
            "cpp_wrapper": self.cpp and not cuda,
        }
        fast = torch.compile(graph, fullgraph=True, dynamic=False, options=options)

        def run(tensors: list[Tensor]) -> Any:
            given = iter(fast(tensors))
            leaves = [constants[i] if i in constants else next(given) for i in range(count)]
            return tree_unflatten(leaves, form)

        return run
