"""What there is to compose: ``python -m saferl.catalog``, or ``python -m saferl.catalog algo task``; with
``--config-dir my_conf`` the options of your own folder too.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from saferl.config.locate import config_dir

#: Groups in the order in which a user meets them.
GROUPS = (
    *("algo", "task", "env", "encoder", "loss", "critic", "cost_critic", "risk", "lagrange"),
    *("projector", "transform", "shaping", "learning", "collector", "logger", "experiment"),
)


def options(group: str, own: Path | None = None) -> dict[str, str]:
    """The options of a group, each with the first comment of its file.

    Args:
        group: a folder of ``conf``.
        own: a user's folder beside it.

    Raises:
        ValueError: there is no such group or folder; lists the groups that there are.

    >>> options("projector")["none"]
    'Actions are executed as the policy proposes them.'
    """
    if group not in GROUPS:
        raise ValueError(f"group must be one of {', '.join(GROUPS)}, got {group!r}.")
    if own is not None and not own.is_dir():
        raise ValueError(f"--config-dir: no such folder: {own}.")
    found = {}
    folders = [Path(config_dir()), *([own] if own else [])]
    for path in sorted(file for folder in folders for file in (folder / group).glob("*.yaml")):
        found[path.stem] = headline(path.read_text(encoding="utf-8"))
    return found


def headline(text: str) -> str:
    """The first comment of a file of ``conf``, which says what it is; "" where there is none."""
    lines = [line[2:] for line in text.splitlines() if line.startswith("# ") and line[2] != "@"]
    return lines[0] if lines else ""


def main(arguments: list[str] | None = None) -> None:
    """Print the options of these groups, or of all."""
    parser = argparse.ArgumentParser("python -m saferl.catalog", description=__doc__)
    parser.add_argument("groups", nargs="*", metavar="GROUP", help=", ".join(GROUPS))
    parser.add_argument("--config-dir", type=Path, help="a folder of your own")
    given = parser.parse_args(arguments)
    try:
        tables = {group: options(group, given.config_dir) for group in given.groups or GROUPS}
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None
    width = max(len(name) for table in tables.values() for name in table)
    for group, table in tables.items():
        print(f"{group}=")
        for name, line in table.items():
            print(f"  {name:<{width}}  {line}")
