"""Reduce a run to its policy: ``python -m saferl.export checkpoint=RUN out=DIR``."""

from saferl.cli.launch import launch

if __name__ == "__main__":
    launch("export", "export")
