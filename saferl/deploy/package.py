"""A policy as one graph in one file, which says what it reads and writes."""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from saferl.algorithms.parts import make
from saferl.algorithms.policy import REPORTED, SafePolicy, load_policy
from saferl.checkpoint.run import progress, run_config
from saferl.deploy.formats import FORMATS, Runs
from saferl.deploy.graph import policy_graph
from saferl.envs.ports import Port
from saferl.envs.task import Task


def package(
    source: Path, file: Path, project: bool = True, observation: str = "features"
) -> dict[str, Any]:
    """Write a policy as one graph.

    Args:
        source: a run, a checkpoint, or an exported policy.
        file: whose ending, ``.pt2`` or ``.onnx``, says the format.
        project: with its projector, if it was trained with one.
        observation: what the graph reads: ``features``, what the policy observes, or ``state``, from which the task makes
            that (``Task.from_state``).

    Returns:
        What the file says of itself: ``inputs`` and ``outputs`` with shapes, units and ranges, ``task``, ``projector``; ``compared`` with the policy.

    Raises:
        ValueError: the task observes its state itself, or its projector cannot be a graph.
    """
    cfg = run_config(source)
    task: Task = make(cfg.task).as_test()
    observe = task.from_state() if observation == "state" else None
    policy = load_policy(source, project=project)
    ports = observe.ports if observe else {key: task.ports[key] for key in policy.in_keys}
    about = {
        "saferl": version("saferl"),
        "algo": cfg.algo_name,
        "observation": observation,
        "trained": {"seed": cfg.seed, **progress(source)},
        "task": task.describe(),
        "projector": _projector(policy),
        "inputs": {name: port.describe() for name, port in ports.items()},
        "outputs": {name: port.describe() for name, port in _outputs(policy, task).items()},
    }
    about = json.loads(json.dumps(about))  # as its reader gets it
    program = policy_graph(policy, ports, observe)
    write, read = FORMATS[file.suffix[1:]]
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f".{file.name}")
    write(program, part, about)
    about["compared"] = compared(policy, read(part)[0], ports, observe)
    part.replace(file)
    return about


def _projector(policy: SafePolicy) -> dict[str, Any] | None:
    projector: Any = policy.projector
    if projector is None:
        return None
    settings = {k: v for k, v in projector.settings.items() if k != "compile"}
    return {"limit": projector.limit, **settings, "acts": projector.enabled}


def _outputs(policy: SafePolicy, task: Task) -> dict[str, Port]:
    action = task.ports["action"]
    reports = policy.projector.reports if policy.projector is not None else {}
    found = {"action": action}
    for name in policy.out_keys[1:]:
        shape = action.shape if name == "action_proposed" else ("batch", reports[name][1])
        features = action.features if name == "action_proposed" else {}
        kind = action.dtype if name == "action_proposed" else reports[name][0]
        found[name] = Port(shape, features, kind, says=REPORTED[name])
    return found


def examples(ports: dict[str, Port], count: int, seed: int = 0) -> dict[str, torch.Tensor]:
    """Random tensors for these ports, numbers of the size of their features and within their ranges; open dimensions have ``count``."""
    generator, drawn = torch.Generator().manual_seed(seed), {}
    for name, port in ports.items():
        shape = [count if isinstance(size, str) else size for size in port.shape]
        value = torch.randn(shape, generator=generator)
        if port.features:
            row = [(each.scale, each.low, each.high) for each in port.features.values()]
            scale, low, high = torch.tensor(row).unbind(-1)
            value = (value * scale).clamp(low, high)
        whole = port.dtype is torch.int64  # a number of a route
        drawn[name] = torch.randint(2, shape, generator=generator) if whole else value
    return drawn


def compared(policy: SafePolicy, run: Runs, ports: dict[str, Port], observe: Any) -> str:
    """How near a file's actions are to the policy's own on 64 random observations."""
    given = examples(ports, 64)
    seen = given if observe is None else observe(**given)
    eager = policy(TensorDict(seen, [64]))["action"]
    apart = (run(given)["action"] - eager).abs().amax(-1)
    near = int((apart <= 1e-5).sum())
    return f"{near} of 64 actions within 1e-05 of saferl's own, all within {float(apart.max()):.1g}"
