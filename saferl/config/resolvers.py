"""What a configuration can ask: resolvers of OmegaConf."""

from __future__ import annotations

import os
import shutil
import sys
import sysconfig
from pathlib import Path

from omegaconf import OmegaConf

from saferl.config.comments import groups, settings

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


def job_name(differing: str, number: int) -> str:
    """The folder of a job of a sweep: what is its own, as one name that stays in the sweep's folder.

    >>> job_name("algo-sac_init-../../a run", 1), job_name("", 0)
    ('algo-sac_init-.._.._a run', '0')
    """
    name = differing.replace("/", "_").replace("\\", "_")
    return name[:200] if name.strip(".") else str(number)


# ${job_name:${hydra.job.override_dirname},${hydra.job.num}}
OmegaConf.register_new_resolver("job_name", job_name, replace=True)

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


def env_name(identity: str) -> str:
    """What runs on an environment are called: its name without module and name space.

    >>> env_name("my_envs:space/Walk-v0")
    'Walk-v0'
    """
    return identity.replace(":", "/").rpartition("/")[2]


# ${env_name:${task.id}}
OmegaConf.register_new_resolver("env_name", env_name, replace=True)

# In a help text: ${groups:}, what there is to choose from, and ${settings:}, every setting with its comment.
OmegaConf.register_new_resolver("groups", groups, replace=True)
OmegaConf.register_new_resolver("settings", lambda *, _root_: settings(_root_), replace=True)
