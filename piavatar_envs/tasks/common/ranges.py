"""Types of settings that tasks share: weights, margins, and ranges from which episodes draw."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from piavatar_envs.config import ConfigError, EnvConfig

#: Weights of rewards and costs, single rewards, points [any unit].
Weight = Annotated[float, Field(ge=0.0, le=1.0e6)]
#: Distances at which a reward is small, or an episode ends [m, rad, m/s or N s].
Margin = Annotated[float, Field(gt=0.0, le=1000.0)]
_Mass = Annotated[float, Field(ge=1.0e-3, le=1000.0)]
_Speed = Annotated[float, Field(ge=1.0e-2, le=100.0)]
_Distance = Annotated[float, Field(le=100.0)]
_Impulse = Annotated[float, Field(le=1.0e4)]
#: Ranges of masses [kg], speeds [m/s], distances [m] and impulses [N s]; :func:`check_ranges` checks their order.
MassRange = tuple[_Mass, _Mass]
SpeedRange = tuple[_Speed, _Speed]
DistanceRange = tuple[_Distance, _Distance]
ImpulseRange = tuple[_Impulse, _Impulse]


def check_ranges(config: EnvConfig, *names: str) -> None:
    """Check that ranges of ``config`` are positive and their lower bounds no greater than the upper ones.

    Raises:
        ConfigError: a range is not.
    """
    for name in names:
        low, high = getattr(config, name)
        if not 0.0 < low <= high:
            raise ConfigError(f"{name}={[low, high]} must be positive, with the lower bound first")
