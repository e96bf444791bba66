"""Safe reinforcement learning from parts, for people who use TorchRL."""

import logging
import os

# TorchRL announces every storage and every rounded frame count; warnings and errors still show.
os.environ.setdefault("RL_WARNINGS", "False")
logging.getLogger("torchrl").setLevel(logging.WARNING)

__version__ = "0.1.0"
