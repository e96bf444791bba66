"""A policy whose projector acts in half of all states, and its files."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from small import EMPTY, SMALL, compose

from saferl.algorithms.assemble import build_agent
from saferl.checkpoint.policy import write_policy
from saferl.deploy.package import package


def write_small(folder: Path, *options: str) -> Path:
    """A policy with random networks. Its penalty is so large that a correction descends straight to the limit: one that
    swings about an infeasible point has no result that two machines round alike."""
    cfg = compose(*SMALL, *EMPTY, "risk_limit=0", *options)
    OmegaConf.update(cfg, "projector.penalty", 100.0)
    OmegaConf.update(cfg, "projector.start", 0.0)
    torch.manual_seed(0)
    agent = build_agent(cfg)
    for name, parameter in agent.loss.named_parameters():
        if "network_params" in name or "cost_critic_params" in name:
            parameter.data.normal_(std=0.3)
    write_policy(folder, agent.loss.state_dict(), cfg, {"frames": 24, "episodes": 1})
    return folder


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small(tmp_path_factory.mktemp("small"), "algo=rsac")


@pytest.fixture(scope="session")
def from_state(small: Path) -> Path:
    """Its graph as ONNX, which observes by itself."""
    file = small.parent / "from_state" / "policy.onnx"
    if not file.is_file():
        package(small, file, observation="state")
    return file
