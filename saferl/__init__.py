"""Safe reinforcement learning from parts, for people who use TorchRL."""

import os

# TorchRL announces every storage and every rounded frame count; warnings and errors still show.
os.environ.setdefault("RL_WARNINGS", "False")
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

__version__ = "0.1.0"
