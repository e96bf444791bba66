"""What there is to compose: ``python -m saferl.catalog algo task``."""

from saferl.config.catalog import main

if __name__ == "__main__":
    main()
