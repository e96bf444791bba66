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
