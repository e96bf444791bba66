"""OmniSafe's algorithms with networks and a batch, but no environment: for ``omnisafe_losses.py``."""

from __future__ import annotations

import contextlib
from types import SimpleNamespace
from typing import Any

import torch
from gymnasium.spaces import Box
from omnisafe_sac_lag import array_defaults

with array_defaults():
    from omnisafe.utils.config import get_default_kwargs_yaml

OBSERVATION, ACTION, HIDDEN = 3, 2, [8]
#: Of the two paths of an on-policy batch: the first is ended by termination, the second cut off.
PATHS = (9, 15)


class Log:
    """Stands in for OmniSafe's logger: keeps what is stored and says what an episode costs."""

    def __init__(self) -> None:
        self.stored: dict[str, Any] = {}
        self.episode_cost = 0.0

    def store(self, values: dict[str, Any]) -> None:
        self.stored |= values

    def get_stats(self, key: str) -> tuple[float]:
        assert key == "Metrics/EpCost"
        return (self.episode_cost,)

    def log(self, *message: Any) -> None:
        pass


def bare(kind: type, folder: str, **changes: dict[str, Any]) -> Any:
    """An algorithm of OmniSafe with networks and buffer, but no environment."""
    config = get_default_kwargs_yaml(kind.__name__, "", folder)
    sizes = {"hidden_sizes": HIDDEN, "lr": 0.0}
    config.recurisve_update({"model_cfgs": {"actor": sizes, "critic": sizes}})
    config.recurisve_update({"train_cfgs": {"epochs": 1}} | changes)
    agent = object.__new__(kind)
    agent._cfgs, agent._device, agent._epochs, agent._epoch = config, torch.device("cpu"), 1, 1
    agent._steps_per_epoch = sum(PATHS)
    agent._env = SimpleNamespace(
        observation_space=Box(-1.0, 1.0, (OBSERVATION,)), action_space=Box(-1.0, 1.0, (ACTION,))
    )
    agent._logger = Log()
    agent._init_model()
    agent._init()
    return agent


@contextlib.contextmanager
def draws(*noise: torch.Tensor):
    """Makes the next draws from a standard normal distribution these, and any further one an error."""
    module, queue = torch.distributions.normal, list(noise)
    original = module._standard_normal

    def draw(shape, dtype, device):
        taken = queue.pop(0)
        assert taken.shape == shape and taken.dtype == dtype
        return taken

    module._standard_normal = draw
    try:
        yield
        assert not queue
    finally:
        module._standard_normal = original


def weights(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: parameter.detach().clone() for name, parameter in module.named_parameters()}


def gradients(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: parameter.grad.clone() for name, parameter in module.named_parameters()}


def disturb(module: torch.nn.Module, size: float) -> None:
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(size * torch.randn_like(parameter))


def collect(agent: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Two paths of the agent's policy through its buffer: the batch, and what the buffer makes of it."""
    networks, steps = agent._actor_critic, sum(PATHS)
    (buffer,) = agent._buf.buffers
    states = [torch.randn(length + 1, OBSERVATION) for length in PATHS]
    batch = {
        "obs": torch.cat([path[:-1] for path in states]),
        "next_obs": torch.cat([path[1:] for path in states]),
        "reward": torch.randn(steps),
        "cost": torch.rand(steps),
    }
    with draws(torch.randn(steps, ACTION)):
        batch["act"], value_r, value_c, batch["logp"] = networks.step(batch["obs"])
    stored = {key: batch[key] for key in ("obs", "act", "reward", "cost", "logp")}
    for step in range(steps):
        agent._buf.store(
            **{key: value[None, step] for key, value in stored.items()},
            value_r=value_r[None, step],
            value_c=value_c[None, step],
        )
        if step == PATHS[0] - 1:
            agent._buf.finish_path(*torch.zeros(2, 1, dtype=torch.float32))
    with torch.no_grad():
        last = states[-1][-1:]
        values = networks.reward_critic(last)[0], networks.cost_critic(last)[0]
        agent._buf.finish_path(*(value.float() for value in values))
    raw = {key: buffer.data[key].double() for key in ("adv_r", "adv_c")}
    data = agent._buf.get()
    batch |= {"paths": list(PATHS)}
    targets = ("adv_r", "adv_c", "target_value_r", "target_value_c")
    return batch, {"before_standardising": raw} | {key: data[key].double() for key in targets}


def on_policy(kind: type, **algorithm: Any) -> tuple[Any, dict[str, Any]]:
    """An on-policy algorithm, and the record of its networks and its batch."""
    algorithm = {"use_max_grad_norm": False, "use_critic_norm": False, "gamma": 0.9} | algorithm
    agent = bare(kind, "on-policy", algo_cfgs=algorithm)
    networks = agent._actor_critic
    # As built, the standard deviation is 1 in each dimension.
    networks.actor.log_std.data.copy_(torch.tensor([-0.3, 0.2]))
    batch, buffer = collect(agent)
    record = {
        "settings": {key: agent._cfgs.algo_cfgs[key] for key in ("gamma", "lam")},
        "weights": {
            name: weights(getattr(networks, name))
            for name in ("actor", "reward_critic", "cost_critic")
        },
        "batch": batch,
        "buffer": buffer,
    }
    return agent, record
