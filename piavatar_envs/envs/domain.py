"""The box in which bodies may move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from piavatar_envs.mpm.boundaries import Collider

#: More room for bodies that nothing holds up: as far as one reaches when it falls [m].
FALL = 1.2


@dataclass(frozen=True)
class Domain:
    """Box in which particles may move [m]; leaving it is a failure.

    The default holds a body with outstretched limbs wherever its root may be before it lets go.

    Attributes:
        lower, upper: corners [m].
        fenced: whether walls belong to the world, such as ropes around a ring: they stand there also for one body
            alone, and where nothing holds bodies up.
    """

    lower: tuple[float, float, float] = (-1.6, -1.6, -0.3)
    upper: tuple[float, float, float] = (1.6, 1.6, 2.6)
    fenced: bool = False

    def around(self, places: Sequence[Sequence[float]]) -> Domain:
        """The box moved to every one of ``places`` (x, y) [m], and what holds them all."""
        at = np.array([(*place[:2], 0.0) for place in places])
        lower, upper = np.array(self.lower) + at.min(0), np.array(self.upper) + at.max(0)
        return Domain(tuple(lower.tolist()), tuple(upper.tolist()))

    def including(self, *points: Sequence[float]) -> Domain:
        """The smallest box that holds this one and ``points`` [m]."""
        every = np.array([self.lower, self.upper, *points])
        return Domain(tuple(every.min(0).tolist()), tuple(every.max(0).tolist()))

    def for_falls(self, walled: bool) -> Domain:
        """The box for bodies that nothing holds up; ``walled`` says whether walls stand around it."""
        if walled and self.fenced:
            return self
        aside = np.array([FALL, FALL, 0.0])
        return Domain(tuple((np.array(self.lower) - aside).tolist()), tuple((np.array(self.upper) + aside).tolist()))

    def walls(self) -> tuple[Collider, ...]:
        """Smooth planes at the sides and the top of the box."""
        walls = []
        for axis in range(3):
            normal = np.eye(3)[axis]
            walls += [Collider.plane(normal, self.lower[axis])] if axis < 2 else []
            walls += [Collider.plane(-normal, -self.upper[axis])]
        return tuple(walls)
