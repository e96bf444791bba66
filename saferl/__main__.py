"""Train: ``python -m saferl algo=arsac task=gs``."""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from saferl.cli import guard, train
from saferl.paths import config_dir


@hydra.main(version_base="1.3", config_path=config_dir(), config_name="config")
def main(cfg: DictConfig) -> None:
    guard(train, cfg)


if __name__ == "__main__":
    main()
