"""The card beside a policy's file: what it reads and writes, how it was trained and tested, its checksum."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from saferl.checkpoint.policy import EXPORTED
from saferl.checkpoint.run import latest, progress, run_config
from saferl.evaluation.statistics import FIGURES, each_cost, short, span

CARD = "README.md"
_USE = {
    ".safetensors": """\
import saferl

policy = saferl.load_policy("{folder}")  # reads and writes a TensorDict
""",
    ".pt2": """\
import torch

policy = torch.export.load("{file}").module()
seen = policy({{{tensors}}})
""",
    ".onnx": """\
import onnxruntime

policy = onnxruntime.InferenceSession("{file}")
(action,) = policy.run(["action"], {{{tensors}}})
""",
}
_CAUTION = """## Not for

Any road. It has seen a simulation and its exact states in place of a sensor's. A risk is an estimate for that simulation, and a projector no guarantee.
"""


def card(
    source: Path, file: Path, about: Mapping[str, Any] | None = None, project: bool = True
) -> Path:
    """Write the card of a file into its folder.

    Args:
        source: the run, checkpoint or policy that it was made of; what its own card or its closing test tells is taken over.
        file: of the policy.
        about: what :func:`saferl.deploy.package.package` says of it; None for a ``policy.safetensors``.
        project: whether the file has the projector of the source; if not, tests of both tell nothing of it.

    Returns:
        ``README.md``.
    """
    cfg = run_config(source)
    text = [
        f"# {file.parent.resolve().name}",
        "",
        f"`{file.name}`: {cfg.algo_name} on task={cfg.task.task}.",
    ]
    names = [] if about is None else list(about["inputs"])
    use = _USE[file.suffix].format(
        folder=file.parent.name,
        file=file.name,
        tensors=", ".join(f'"{name}": {name}' for name in names),
    )
    text += ["", "```python", use.strip(), "```", ""]
    if about is not None:
        text += _interface(about)
    told, alone = source / CARD, not project and cfg.projector._target_ is not None
    if alone:
        note = (
            "Not without its projector: `python -m saferl.evaluate checkpoint=... project=false`."
        )
        text += [*_trained(source, cfg), "## Tested", "", note, "", _CAUTION]
    elif (
        latest(source).is_file()
        and told.is_file()
        and (found := told.read_text(encoding="utf-8").find("## Trained")) >= 0
    ):
        text += [told.read_text(encoding="utf-8")[found:].split("\n## Checksum")[0].rstrip(), ""]
    else:
        text += [*_trained(source, cfg), *_tested(source), _CAUTION]
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    text += ["## Checksum", "", f"SHA-256 of `{file.name}`: `{digest}`"]
    path = file.parent / CARD
    path.write_text("\n".join(text) + "\n", encoding="utf-8")
    return path


def _interface(about: Mapping[str, Any]) -> Iterator[str]:
    """What goes in and comes out, feature by feature."""
    projector = about["projector"]
    yield (
        "Its projector is inside: " + json.dumps(projector) + "."
        if projector
        else "No projector is inside: actions are the policy's own."
    )
    yield f"Random observations: {about['compared']}. An action that is not finite is returned, not refused."
    yield "The file says the same as JSON (`metadata_props` of ONNX, `saferl.json` among the extra files of pt2)."
    for title in ("inputs", "outputs"):
        yield f"\n## {title.capitalize()}\n"
        yield "| name | shape | kind | feature | unit | range | |"
        yield "|---|---|---|---|---|---|---|"
        for name, port in about[title].items():
            shape = ", ".join(map(str, port["shape"]))
            yield f"| `{name}` | [{shape}] | {port['dtype']} | | | | {port['says']} |"
            for each in port["features"]:
                low, high = (
                    ("any" if each[end] is None else f"{each[end]:.4g}") for end in ("low", "high")
                )
                yield f"| | | | `{each['name']}` | {each['unit']} | {low} to {high} | {each['says']} |"
    yield ""


def _trained(source: Path, cfg: DictConfig) -> list[str]:
    counted = progress(source)
    command = f"python -m saferl algo={cfg.algo_name} task={cfg.task.task} seed={cfg.seed}"
    line = f"`{command}`, its settings as `{EXPORTED}` and the run hold them: {counted['frames']:,} decisions, {counted['episodes']:,} episodes."
    return ["## Trained", "", line, ""]


def _tested(source: Path) -> list[str]:
    """The figures of the run's closing test."""
    file = source / "evaluation" / "metrics.json"
    if not file.is_file():
        return ["## Tested", "", "Not yet: `python -m saferl.evaluate checkpoint=...`.", ""]
    metrics = json.loads(file.read_text())
    lines = [
        "## Tested",
        "",
        f"{metrics['episodes']} episodes of seed {metrics['seed']}, 95% intervals.",
        "",
    ]
    lines += ["| figure | mean | |", "|---|---|---|"]
    for name in (name for figure in FIGURES for name in each_cost(figure, metrics)):
        value, share = metrics[name], name.endswith("_rate")
        scale = 100.0 if share else 1.0
        interval = span(value["low"], value["high"], ".2f", scale)
        lines.append(f"| {short(name)}{' %' * share} | {value['mean'] * scale:.2f} | {interval} |")
    return [*lines, ""]
