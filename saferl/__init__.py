"""Safe reinforcement learning from parts, for people who use TorchRL."""

import os
from typing import Any

# TorchRL announces every storage and every rounded frame count; warnings and errors still show.
os.environ.setdefault("RL_WARNINGS", "False")
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name == "load_policy":  # late: commands that only print need no torch
        from saferl.algorithms.policy import load_policy

        return load_policy
    raise AttributeError(f"module 'saferl' has no attribute {name!r}")
