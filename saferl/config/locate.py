"""Where the configuration files and the policies that ship with saferl lie."""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]


def config_dir() -> str:
    """The ``conf`` folder: inside the installed package, or beside it in a checkout.

    Raises:
        FileNotFoundError: it is in neither place.
    """
    for folder in (PACKAGE / "conf", PACKAGE.parent / "conf"):
        if (folder / "config.yaml").is_file():
            return str(folder)
    raise FileNotFoundError(f"saferl's conf folder is neither in {PACKAGE} nor in its parent.")


def shipped(root: Path = PACKAGE / "pretrained") -> list[str]:
    """Names of the policies that ship with saferl."""
    return sorted(path.name for path in root.iterdir() if path.is_dir()) if root.is_dir() else []


def pretrained_run(name: str, root: Path = PACKAGE / "pretrained") -> Path:
    """Folder of a policy that ships with saferl, as :func:`saferl.checkpoint.run.export` wrote it.

    Raises:
        ValueError: no policy has this name; lists those that there are.
    """
    names = shipped(root)
    if name not in names:
        raise ValueError(
            f"pretrained must be one of {', '.join(names)}, got {name!r}."
            if names
            else f"pretrained={name}: no policy ships with this version; use checkpoint=RUN."
        )
    return root / name
