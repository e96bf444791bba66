"""Gradient updates per second of OmniSafe's own SACLag, for a comparison with ours.

    python benchmarks/omnisafe_sac_lag.py [--seconds 3] [--same-work]

OmniSafe wants old packages, so this runs in an environment of its own, which has no saferl. On
Python 3.11 (``pip install omnisafe`` alone fails there: it asks for a pygame without a wheel):

    python3.11 -m venv omnisafe_env
    omnisafe_env/bin/pip install --only-binary :all: torch==2.13.0 "numpy<2" gymnasium==0.28.1 \\
        mujoco==2.3.3 pygame==2.6.1 pandas==2.0.3 xmltodict pyyaml imageio tensorboard wandb moviepy \\
        typing-extensions typer rich seaborn matplotlib gdown
    omnisafe_env/bin/pip install --no-deps omnisafe==0.5.0 safety-gymnasium==1.0.0 \\
        gymnasium-robotics==1.2.2 pettingzoo==1.22.4
    omnisafe_env/bin/python benchmarks/omnisafe_sac_lag.py --seconds 3

What is timed is ``SACLag._update`` as OmniSafe ships it: the reward critics, the cost critic, the
actor, the target networks, the multiplier and its bookkeeping for the log, with its default
configuration but for three hidden layers of 256 units. Only the replay buffer's draw is replaced, by
one fixed random batch of 256 transitions with 75 observed numbers and 2 actions, and no environment is
stepped. One thread; 20 updates to warm up, then the median of three rounds, by the wall clock and by
this process's own CPU time (the one to read on a machine that is busy with other work).

By default OmniSafe moves its actor and target networks in every second update only and keeps the
temperature fixed. ``--same-work`` has it do so in every update and learn the temperature, as saferl does.
Prints one line of JSON.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import statistics
import sys
import tempfile
import time
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium.spaces import Box

OBSERVATION, ACTION, BATCH, HIDDEN = 9 + 11 * 6, 2, 256, [256, 256, 256]
ENV_ID = "Nothing-v0"


class HashableArray(np.ndarray):
    """An array that Python 3.11 takes for a dataclass's default, which must be hashable."""

    __hash__ = object.__hash__


@contextlib.contextmanager
def array_defaults():
    """Lets dataclasses that are declared meanwhile have arrays for defaults, as on Python 3.10."""
    original = dataclasses.dataclass

    def dataclass(cls: type | None = None, /, **options: Any):
        if cls is None:
            return lambda cls: dataclass(cls, **options)
        for name, value in list(vars(cls).items()):
            if isinstance(value, np.ndarray):
                setattr(cls, name, value.view(HashableArray))
        return original(cls, **options)

    dataclasses.dataclass = dataclass
    try:
        yield
    finally:
        dataclasses.dataclass = original


with array_defaults():
    import omnisafe
    from omnisafe.envs.core import CMDP, env_register


@env_register
class Nothing(CMDP):
    """The spaces of the intersection and nothing behind them."""

    _support_envs: ClassVar[list[str]] = [ENV_ID]
    need_auto_reset_wrapper = False
    need_time_limit_wrapper = False

    def __init__(self, env_id: str, num_envs: int = 1, **options: Any):
        self._num_envs = num_envs
        self._observation_space = Box(-1.0, 1.0, (OBSERVATION,))
        self._action_space = Box(-1.0, 1.0, (ACTION,))

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None):
        return torch.zeros(OBSERVATION), {}

    def step(self, action: torch.Tensor):
        raise NotImplementedError

    def set_seed(self, seed: int) -> None:
        pass

    def render(self) -> None:
        pass

    def close(self) -> None:
        pass


def learner(same_work: bool, log_dir: str) -> Any:
    """OmniSafe's SACLag, ready to update on one batch for ever."""
    sizes = {"hidden_sizes": HIDDEN}
    algorithm: dict[str, Any] = {"batch_size": BATCH, "size": 2 * BATCH}
    if same_work:
        algorithm |= {"policy_delay": 1, "auto_alpha": True}
    config = {
        "train_cfgs": {"device": "cpu", "torch_threads": 1},
        "algo_cfgs": algorithm,
        "logger_cfgs": {"use_tensorboard": False, "use_wandb": False, "log_dir": log_dir},
        "model_cfgs": {"actor": sizes, "critic": sizes},
    }
    agent = omnisafe.Agent("SACLag", ENV_ID, custom_cfgs=config).agent

    generator = torch.Generator().manual_seed(0)
    batch = {
        "obs": torch.randn(BATCH, OBSERVATION, generator=generator),
        "act": 2 * torch.rand(BATCH, ACTION, generator=generator) - 1,
        "reward": torch.randn(BATCH, generator=generator),
        "cost": torch.randint(2, (BATCH,), generator=generator).float(),
        "done": torch.randint(2, (BATCH,), generator=generator).float(),
        "next_obs": torch.randn(BATCH, OBSERVATION, generator=generator),
    }
    agent._buf.sample_batch = lambda: batch
    # As in a run that is under way: episodes have ended, and the multiplier's warm-up is over.
    for _ in range(50):
        agent.logger.store({"Metrics/EpCost": 30.0})
    agent._epoch = agent._cfgs.algo_cfgs.warmup_epochs + 1
    return agent


def rates(agent: Any, seconds: float) -> tuple[float, float]:
    """Updates per second of the wall clock and of this process's CPU time."""
    count, cpu, wall = 0, time.process_time(), time.perf_counter()
    while time.perf_counter() - wall < seconds or count == 0:
        agent._update()
        count += 1
    return count / (time.perf_counter() - wall), count / (time.process_time() - cpu)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=3.0, help="of each of the three rounds")
    parser.add_argument(
        "--same-work",
        action="store_true",
        help="actor, target networks and temperature in every update, as saferl does",
    )
    options = parser.parse_args()
    torch.set_num_threads(1)

    with tempfile.TemporaryDirectory() as log_dir:
        with contextlib.redirect_stdout(sys.stderr):
            agent = learner(options.same_work, log_dir)
        for _ in range(20):
            agent._update()
        rounds = [rates(agent, options.seconds) for _ in range(3)]
    wall, cpu = (statistics.median(values) for values in zip(*rounds, strict=True))
    networks = agent._actor_critic
    print(
        json.dumps(
            {
                "updates_per_second": wall,
                "updates_per_cpu_second": cpu,
                "reward_critics": len(networks.reward_critic.net_lst),
                "cost_critics": len(networks.cost_critic.net_lst),
            }
        )
    )


if __name__ == "__main__":
    main()
