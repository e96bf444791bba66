"""Closing tests side by side: ``python -m saferl.summary multirun runs/arsac-gs-seed0``."""

from saferl.evaluation.compare import main

if __name__ == "__main__":
    main()
