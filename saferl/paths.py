"""Where the configuration files and the policies that ship with saferl lie, and what conf can ask."""

from __future__ import annotations

import os
import shutil
import sys
import sysconfig
from pathlib import Path

from omegaconf import OmegaConf

# ${first:a,b} in a configuration is the first of its arguments that is not null.
OmegaConf.register_new_resolver(
    "first", lambda *values: next(v for v in values if v is not None), replace=True
)
# ${when:a,b} is b where a is not null, else null.
OmegaConf.register_new_resolver(
    "when", lambda given, value: None if given is None else value, replace=True
)

# ${unless:a,b} is b where a is null, else null.
OmegaConf.register_new_resolver(
    "unless", lambda given, value: value if given is None else None, replace=True
)
# ${ceil_div:a,b} is a / b, rounded up; a where the two are not whole, as the check of a and b will say.
OmegaConf.register_new_resolver(
    "ceil_div",
    lambda a, b: -(-a // b) if isinstance(a, int) and isinstance(b, int) and b else a,
    replace=True,
)

# ${decisions:${task}}: how many an episode has at most.
OmegaConf.register_new_resolver(
    "decisions",
    lambda task: task["horizon"] if "horizon" in task else task.duration * task.policy_frequency,
    replace=True,
)

PACKAGE = Path(__file__).resolve().parent
#: A budget for which compiling pays, which takes minutes.
LONG = {"episodes": 2_000, "frames": 100_000}


def pays_to_compile(episodes: int | None, frames: int | None) -> bool:
    """Whether a budget is long and torch finds what it compiles with: a C++ compiler, Python's headers.

    >>> pays_to_compile(episodes=10, frames=None)
    False
    """
    usual = {"darwin": "clang++", "win32": "cl"}.get(sys.platform, "g++")
    able = (
        shutil.which(os.environ.get("CXX", usual))
        and (Path(sysconfig.get_path("include")) / "Python.h").is_file()
    )
    budget = {"episodes": episodes, "frames": frames}
    long = any(isinstance(n, int) and n >= LONG[kind] for kind, n in budget.items())
    return bool(able and long)


# ${pays_to_compile:${episodes},${frames}}
OmegaConf.register_new_resolver("pays_to_compile", pays_to_compile, replace=True)


def config_dir() -> str:
    """The ``conf`` folder: inside the installed package, or beside it in a checkout.

    Raises:
        FileNotFoundError: it is in neither place.
    """
    for folder in (PACKAGE / "conf", PACKAGE.parent / "conf"):
        if (folder / "config.yaml").is_file():
            return str(folder)
    raise FileNotFoundError(f"saferl's conf folder is neither in {PACKAGE} nor in its parent.")


def pretrained_run(name: str, root: Path = PACKAGE / "pretrained") -> Path:
    """Folder of a policy that ships with saferl, as :func:`saferl.checkpoint.export` wrote it.

    Raises:
        ValueError: no policy has this name; lists those that there are.
    """
    names = sorted(path.name for path in root.iterdir() if path.is_dir()) if root.is_dir() else []
    if name not in names:
        raise ValueError(
            f"pretrained must be one of {', '.join(names)}, got {name!r}."
            if names
            else f"pretrained={name}: no policy ships with this version; use checkpoint=RUN."
        )
    return root / name
