"""Where the configuration files lie."""

from __future__ import annotations

from pathlib import Path


def config_dir() -> str:
    """The ``conf`` folder: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parent
    for folder in (package / "conf", package.parent / "conf"):
        if (folder / "config.yaml").is_file():
            return str(folder)
    raise FileNotFoundError(f"saferl's conf folder is neither in {package} nor in its parent.")


def pretrained_run(name: str) -> Path:
    """Folder of a policy that ships with saferl.

    Raises:
        ValueError: no policy has this name; lists those that there are.
    """
    root = Path(__file__).resolve().parent / "pretrained"
    names = sorted(path.name for path in root.iterdir() if path.is_dir()) if root.is_dir() else []
    if name not in names:
        raise ValueError(
            f"pretrained must be one of {', '.join(names) or 'none yet'}, got {name!r}."
        )
    return root / name
