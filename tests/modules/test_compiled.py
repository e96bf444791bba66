"""A function as a graph of its own: values, forms, random numbers, and what is read where it is."""

import functools
import pickle
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict

from saferl.modules.compiled import Compiled

BACKENDS = ["eager", pytest.param("inductor", marks=pytest.mark.slow)]


@pytest.fixture(autouse=True, params=BACKENDS)
def backend(request, monkeypatch):
    """The list of operations is the same; only inductor turns it into code, in seconds."""
    if request.param != "inductor":
        monkeypatch.setattr(
            torch, "compile", lambda graph, **_: torch._dynamo.optimize(request.param)(graph)
        )
    return request.param


def test_values_of_nested_containers_and_constants():
    def function(data, factor):
        return {"sum": data["a"] + data["b"]}, [factor, data["a"] * factor, None]

    data = TensorDict(a=torch.randn(3), b=torch.randn(3), batch_size=3)
    compiled = Compiled(function, "a sum")
    for other in (data, data + 1.0):
        torch.testing.assert_close(compiled(other, 2.0), function(other, 2.0))
    assert len(compiled.graphs) == 1
    torch.testing.assert_close(compiled(data, 3.0), function(data, 3.0))
    assert len(compiled.graphs) == 2
    longer = torch.cat([data, data])
    torch.testing.assert_close(compiled(longer, 3.0), function(longer, 3.0))
    assert len(compiled.graphs) == 3


def test_gradients_within():
    """They are taken though nothing outside may be differentiated."""
    weight = torch.nn.Parameter(torch.randn(3))

    def slope(x):
        return torch.autograd.grad((x * weight).sin().sum(), weight)[0]

    compiled, x = Compiled(slope, "a slope"), torch.randn(3)
    with torch.no_grad():
        out = compiled(x)
    torch.testing.assert_close(out, slope(x))
    assert not out.requires_grad


def test_what_is_no_argument_is_read_where_it_is():
    weight = torch.nn.Parameter(torch.ones(2))
    compiled = Compiled(lambda x: x * weight, "a product")
    assert compiled(torch.ones(2)).tolist() == [1.0, 1.0]
    with torch.no_grad():
        weight.fill_(5.0)
    assert compiled(torch.ones(2)).tolist() == [5.0, 5.0]


def test_two_arguments_that_are_one_tensor():
    """The graph reads both, or the first call would decide what later ones mean."""
    compiled, one = Compiled(lambda a, b: a - b, "a difference"), torch.ones(2)
    assert compiled(one, one).tolist() == [0.0, 0.0]
    assert compiled(one, 3 * one).tolist() == [-2.0, -2.0]
    assert len(compiled.graphs) == 1


def test_random_numbers_are_those_of_the_function():
    """Also in the call that compiles."""

    def noise(x):
        return x + torch.randn_like(x)

    compiled = Compiled(noise, "noise")
    for seed in (0, 1):
        torch.manual_seed(seed)
        ours = compiled(torch.zeros(4)), torch.rand(1)
        torch.manual_seed(seed)
        torch.testing.assert_close(ours, (noise(torch.zeros(4)), torch.rand(1)))


def test_to_read_a_value_is_refused():
    """It would stay what it was at the first call, of an argument or of a buffer."""
    buffer = torch.ones(())
    readers = (
        lambda x: x if x.sum() > 0 else -x,
        lambda x: x * float(buffer),
        lambda x: x + buffer.item(),
    )
    for reader in readers:
        with pytest.raises(RuntimeError, match="value"):
            Compiled(reader, "reader")(torch.ones(2))


def test_numbers_of_another_type_are_another_form():
    compiled, x = Compiled(lambda x, k: x * k, "a product"), torch.ones(2, dtype=torch.int64)
    for number in (1, 1.0, True):
        assert compiled(x, number).dtype == (x * number).dtype
    assert len(compiled.graphs) == 3


def test_a_copy_reads_its_own_tensors():
    layer = torch.nn.Linear(2, 2)
    compiled = Compiled(layer, "a layer")
    compiled(torch.ones(1, 2))
    for copy in (deepcopy(compiled), pickle.loads(pickle.dumps(compiled))):
        with torch.no_grad():
            copy.function.weight.zero_(), copy.function.bias.fill_(3.0)
        assert copy(torch.ones(1, 2)).tolist() == [[3.0, 3.0]]
    torch.testing.assert_close(compiled(torch.ones(1, 2)), layer(torch.ones(1, 2)).detach())


def test_each_owns_its_graphs(backend):
    """Twelve of one code, alive at once: torch keeps eight versions of one code object."""
    counter = torch._dynamo.testing.CompileCounterWithBackend(backend)
    torch._dynamo.reset()

    def power(exponent, x):
        return x**exponent + exponent

    original = torch.compile
    torch.compile = lambda graph, **_: torch._dynamo.optimize(counter)(graph)  # type: ignore
    try:
        twelve = [Compiled(functools.partial(power, n), f"power {n}") for n in range(2, 14)]
        for _ in range(2):
            for n, one in enumerate(twelve, start=2):
                torch.testing.assert_close(one(torch.ones(3)), torch.full((3,), 1.0 + n))
    finally:
        torch.compile = original
    assert counter.frame_count == 12
    assert all(len(one.graphs) == 1 for one in twelve)
