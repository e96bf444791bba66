"""What ``--help`` says of each setting: the comments of the files that it is composed of."""

from __future__ import annotations

import re
import shutil
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from saferl.config.catalog import GROUPS, headline

#: Column in which comments begin where a setting leaves room, and the least room that they get.
COLUMN, NARROWEST = 36, 40


def groups() -> str:
    """The groups of the configuration and their choices, those of the user's folder too, for Hydra's help."""
    loader = GlobalHydra.instance().config_loader()
    found = {group: loader.get_group_options(group) for group in GROUPS}
    return "\n".join(
        f"{group}: {', '.join(name for name in sorted(names) if not name.endswith('_schema'))}"
        for group, names in found.items()
    )


def settings(root: DictConfig) -> str:
    """The composed settings as YAML, each with its comment, for Hydra's help.

    Args:
        root: as Hydra composes it, with its own node ``hydra``.
    """
    loader = GlobalHydra.instance().config_loader()
    given = [*root.hydra.overrides.hydra, *root.hydra.overrides.task]
    composed = loader.compute_defaults_list(root.hydra.job.config_name, given, RunMode.RUN)
    folders = [Path(source.path) for source in loader.get_sources() if source.scheme() == "file"]
    notes: dict[str, tuple[str, str]] = {}
    for part in composed.defaults:
        group, _, choice = str(part.config_path).rpartition("/")
        for file in (folder / f"{part.config_path}.yaml" for folder in folders):
            if file.is_file() and not group.startswith("hydra"):
                text = file.read_text(encoding="utf-8")
                notes[group] = "", f"{choice}: {headline(text)}"
                prefix = f"{part.package}." if part.package else ""
                for name, (above, behind) in comments(text).items():
                    old = notes.get(f"{prefix}{name}", ("", ""))
                    notes[f"{prefix}{name}"] = above or old[0], behind or old[1]
    own: Any = OmegaConf.to_container(root, resolve=False)
    del own["hydra"]
    width = shutil.get_terminal_size((120, 24)).columns
    # Hydra would fill in what follows a single $.
    return "\n".join(_explained(own, notes, width)).replace("$", "$$")


def comments(text: str) -> dict[str, tuple[str, str]]:
    """The comments of a YAML file by dotted keys: what stands above a key, and behind it on its line.

    Lines above the first key are of the file. Lists are not looked into.

    >>> comments("# Of the file.\\nseed: 0 # of all\\n# How long.\\ntest: # at the end\\n  episodes: 50\\n")
    {'seed': ('', 'of all'), 'test': ('How long.', 'at the end')}
    """
    lines = text.splitlines()
    found: dict[str, tuple[str, str]] = {}
    for name, number, end in _keys(yaml.compose(text, yaml.SafeLoader)):
        first = number
        while first and lines[first - 1].lstrip().startswith("# "):
            first -= 1
        above = " ".join(line.strip()[2:] for line in lines[first:number]) if found else ""
        behind = re.match(r"\s*# (.*)", lines[number][end:])
        found[name] = above, behind[1] if behind else ""
    return {name: note for name, note in found.items() if any(note)}


def _keys(node: Any, prefix: str = "") -> Iterator[tuple[str, int, int]]:
    """Of each key below a node: its dotted name, its line, and the column behind what stands there of its value."""
    if isinstance(node, yaml.MappingNode) and not node.flow_style:
        for key, value in node.value:
            name, line = f"{prefix}{key.value}", key.start_mark.line
            ends_there = value.end_mark.line == line
            yield name, line, value.end_mark.column if ends_there else key.end_mark.column + 1
            yield from _keys(value, f"{name}.")


def _explained(
    node: Mapping, notes: Mapping[str, tuple[str, str]], width: int, prefix: str = ""
) -> Iterator[str]:
    """Lines of YAML, with comments above and behind them."""
    indent = "  " * prefix.count(".")
    for key, value in node.items():
        above, behind = notes.get(f"{prefix}{key}", ("", ""))
        yield from (f"{indent}# {line}" for line in textwrap.wrap(above, width - 2 - len(indent)))
        line = f"{indent}{key}:"
        if nested := isinstance(value, dict) and bool(value):
            shown = ""
        else:
            shown = yaml.safe_dump(value, default_flow_style=True, width=2**31, sort_keys=False)
        line = f"{line} {shown.strip().removesuffix('...').strip()}".rstrip()
        room = max(COLUMN, len(line) + 2)
        first, *rest = textwrap.wrap(behind, max(NARROWEST, width - room - 2)) or [""]
        yield f"{line:<{room}}# {first}" if first else line
        yield from (f"{'':<{room}}# {more}" for more in rest)
        if nested:
            yield from _explained(value, notes, width, f"{prefix}{key}.")
