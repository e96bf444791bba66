"""Test a policy: ``python -m saferl.evaluate checkpoint=RUN task=gs episodes=500``."""

from saferl.cli.launch import launch

if __name__ == "__main__":
    launch("evaluate", "evaluate")
