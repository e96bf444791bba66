"""Search for hyper-parameters: ``python -m saferl.tune algo=sac "learning.tau=interval(0.001,0.02)"``."""

from saferl.cli.tune import main

if __name__ == "__main__":
    main()
