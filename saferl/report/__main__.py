"""The paper's tables from folders of runs: ``python -m saferl.report paper --out report``."""

from saferl.report.command import main

if __name__ == "__main__":
    main()
