"""Train: ``python -m saferl algo=arsac task=gs``."""

from saferl.cli.launch import launch

if __name__ == "__main__":
    launch("train", "config")
