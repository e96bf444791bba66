"""What there is to compose: ``python -m saferl.catalog``, or ``python -m saferl.catalog algo task``."""

from __future__ import annotations

import sys
from pathlib import Path

from saferl.paths import config_dir

#: Groups in the order in which a user meets them.
GROUPS = (
    *("algo", "task", "env", "encoder", "loss", "critic", "cost_critic", "risk", "lagrange"),
    *("projector", "shaping", "collector", "experience", "logger", "experiment"),
)


def options(group: str) -> dict[str, str]:
    """The options of a group, each with the first comment of its file.

    Args:
        group: a folder of ``conf``.

    Raises:
        ValueError: there is no such group; lists those that there are.

    >>> options("projector")["none"]
    'Actions are executed as the policy proposes them.'
    """
    if group not in GROUPS:
        raise ValueError(f"group must be one of {', '.join(GROUPS)}, got {group!r}.")
    found = {}
    for path in sorted((Path(config_dir()) / group).glob("*.yaml")):
        lines = path.read_text(encoding="utf-8").splitlines()
        comments = [line[2:] for line in lines if line.startswith("# ") and line[2] != "@"]
        found[path.stem] = comments[0] if comments else ""
    return found


def main(groups: list[str]) -> None:
    """Print the options of these groups, or of all."""
    try:
        tables = {group: options(group) for group in groups or GROUPS}
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None
    width = max(len(name) for table in tables.values() for name in table)
    for group, table in tables.items():
        print(f"{group}=")
        for name, line in table.items():
            print(f"  {name:<{width}}  {line}")


if __name__ == "__main__":
    main(sys.argv[1:])
