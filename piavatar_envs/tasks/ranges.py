"""Settings that are ranges: a lower and an upper bound that episodes draw between."""

from __future__ import annotations

from piavatar_envs.envs.config import ConfigError, EnvConfig


def check_ranges(config: EnvConfig, *names: str) -> None:
    """See that ranges of ``config`` are positive and do not fall.

    Raises:
        ConfigError: one is not.
    """
    for name in names:
        low, high = getattr(config, name)
        if not 0.0 < low <= high:
            raise ConfigError(f"{name}={[low, high]} must be positive and not fall; give the lower bound first")
