"""A policy's graph as a file of PyTorch (pt2) or ONNX, with what is to be known of it inside."""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Callable, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.export import ExportedProgram

#: What a reader gives: tensors by name in, tensors by name out.
Runs = Callable[[Mapping[str, Tensor]], dict[str, Tensor]]
#: The entry of a pt2 file.
_ABOUT = "saferl.json"


@contextmanager
def _quietly():
    """Without what torch's exporters say of themselves."""
    loggers = [logging.getLogger(name) for name in ("onnxscript", "onnx_ir", "torch.onnx")]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


def write_pt2(program: ExportedProgram, file: Path, about: Mapping[str, Any]) -> None:
    """Write a graph as ``torch.export`` does, ``about`` in its extra file ``saferl.json``."""
    with _quietly():
        torch.export.save(program, file, extra_files={_ABOUT: json.dumps(about)})


def read_pt2(file: Path) -> tuple[Runs, dict[str, Any]]:
    """A graph that :func:`write_pt2` wrote, as a function, and what it says of itself."""
    extra = {_ABOUT: ""}
    run = torch.export.load(file, extra_files=extra).module()
    return torch.no_grad()(lambda inputs: run(dict(inputs))), json.loads(extra[_ABOUT])


def _hypot(x: Tensor, y: Tensor) -> Tensor:
    return (x * x + y * y).sqrt()


def write_onnx(program: ExportedProgram, file: Path, about: Mapping[str, Any]) -> None:
    """Write a graph as ONNX, in ``metadata_props`` each entry of ``about`` as JSON."""
    known = torch.export.default_decompositions()
    known[torch.ops.aten.hypot.default] = _hypot  # pyright: ignore  (ONNX has none)
    with _quietly():
        written = torch.onnx.export(
            program.run_decompositions(known),
            dynamo=True,
            verbose=False,
            input_names=list(about["inputs"]),
            output_names=list(about["outputs"]),
        )
    model: Any = written.model  # pyright: ignore
    names = {
        dim.value: name
        for given, port in zip(model.graph.inputs, about["inputs"].values(), strict=True)
        for dim, name in zip(given.shape, port["shape"], strict=True)
        if isinstance(name, str)
    }
    written.rename_axes(names)  # pyright: ignore  (torch calls them s42)
    for part in (model.graph, *model.functions.values()):  # where each node came from, in paths
        for node in part.all_nodes():
            node.metadata_props.clear()
    model.metadata_props.update({name: json.dumps(value) for name, value in about.items()})
    written.save(file)  # pyright: ignore


def read_onnx(file: Path) -> tuple[Runs, dict[str, Any]]:
    """A graph that :func:`write_onnx` wrote, as a function by onnxruntime, and what it says of itself."""
    import onnxruntime  # late: an extra

    session = onnxruntime.InferenceSession(file)
    names = [output.name for output in session.get_outputs()]

    def run(inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        given = {name: value.numpy() for name, value in inputs.items()}
        return dict(zip(names, map(torch.as_tensor, session.run(names, given)), strict=True))

    props = session.get_modelmeta().custom_metadata_map
    return run, {name: json.loads(value) for name, value in props.items()}


#: How a format is written and read.
FORMATS = {"pt2": (write_pt2, read_pt2), "onnx": (write_onnx, read_onnx)}
