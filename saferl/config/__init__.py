"""Where the configuration lies, what it may ask and what it may hold."""

from saferl.config import resolvers, schema  # which register themselves  # noqa: F401
