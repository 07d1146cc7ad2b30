"""Elastic bodies that meet a wall or their mirror image, beside what textbooks say: cases of ``elastodynamics``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.physics.matter import ball, build_matter, lattice
from benchmarks.physics.textbook import BarImpact, HertzImpact
from piavatar_envs.mpm.model import Fields, MaterialPoints

YOUNG_MODULUS, DENSITY = 1.0e5, 1000.0
#: Control steps in which an impact is looked at, in a duration of contact by theory.
LOOKS = 80
#: Times at which forces are compared, from where the velocity turns, in such durations.
WATCHED = np.linspace(-0.8, 0.8, 81)
#: Places of the grid, for what a contact does depends on where nodes lie [grid spacings].
SHIFTS = (0.0, 0.25, 0.5, 0.75)


def bar_impact(
    cells: int, mirrored: bool = False, shifts: Sequence[float] = SHIFTS, device: str = "cpu"
) -> dict[str, Any]:
    """Bounce a bar at a hundredth of its wave speed off a smooth wall, or off another bar, end on.

    Args:
        cells: along a side; the bar is six sides long.
        mirrored: whether it meets another bar.
        shifts: of the grid against the bar, in spacings; the row has the mean over them.
        device: Warp device.
    """
    side, speed = 0.1, 0.1
    theory = BarImpact(6.0 * side, side**2, DENSITY, YOUNG_MODULUS, speed)
    dx = side / cells
    points = lattice((-side / 2, -side / 2, 0.0), (side / 2, side / 2, theory.length), dx / 2)
    return {"cells": cells, **_met(theory, points, dx, 0.0, mirrored, shifts, device)}


def ball_impact(
    cells: int, mirrored: bool = False, shifts: Sequence[float] = SHIFTS, device: str = "cpu"
) -> dict[str, Any]:
    """Bounce a ball at a hundredth of its wave speed off a smooth plane, or off another ball.

    It has three particles to a cell along every axis: the steps of a coarser lattice are as deep as the contact.

    Args:
        cells: in the radius.
        mirrored: whether it meets another ball.
        shifts: as of :func:`bar_impact`.
        device: Warp device.
    """
    radius, poisson_ratio, speed = 0.2, 0.3, 0.1
    volume = 4.0 / 3.0 * np.pi * radius**3
    theory = HertzImpact(radius, DENSITY * volume, YOUNG_MODULUS, poisson_ratio, speed)
    dx = radius / cells
    points = ball((0.0, 0.0, radius), radius, dx / 3)
    depth = {"depth_cells": theory.depth / dx, "contact_radius_cells": theory.contact_radius / dx}
    return {"cells": cells, **depth, **_met(theory, points, dx, poisson_ratio, mirrored, shifts, device)}


def _met(
    theory: BarImpact | HertzImpact,
    points: np.ndarray,
    dx: float,
    poisson_ratio: float,
    mirrored: bool,
    shifts: Sequence[float],
    device: str,
) -> dict[str, Any]:
    """Return means over places of the grid; see :class:`Bounce`."""
    found = [bounce(theory, points, dx, poisson_ratio, mirrored, shift, device) for shift in shifts]
    errors = np.array([bounced.errors for bounced in found])
    return {
        "time_error": errors[:, 0].mean(),
        "time_error_range": [errors[:, 0].min(), errors[:, 0].max()],
        "force_error": errors[:, 1].mean(),
        "force_error_range": [errors[:, 1].min(), errors[:, 1].max()],
        "speed_after": np.mean([bounced.upward[-1] for bounced in found]),
        "energy_left": np.mean([bounced.energy_left for bounced in found]),
        "time_of_duration": WATCHED,
        "force_of_theory": np.mean([bounced.course for bounced in found], axis=0),
    }


@dataclass(frozen=True)
class Bounce:
    """Record of a body that has bounced.

    Attributes:
        theory: what it should have done.
        dt: time between two looks [s].
        upward: velocity at every look, in units of the speed before.
        energy_left: share of the energy after it.
    """

    theory: BarImpact | HertzImpact
    dt: float
    upward: np.ndarray
    energy_left: float

    @property
    def force(self) -> np.ndarray:
        """Return the force between two samples [N]."""
        return np.diff(self.upward) * self.theory.speed * self.theory.mass / self.dt

    def time_at(self, upward: float) -> float:
        """Return the time at which the body had a velocity [s]."""
        return float(np.interp(upward, self.upward, self.dt * np.arange(len(self.upward))))

    @property
    def errors(self) -> tuple[float, float]:
        """Return relative errors of the time of reversal, and of the force then."""
        turned = self.time_at(0.5) - self.time_at(-0.5)
        return turned / self.theory.reversal_time - 1.0, float(self.course[len(WATCHED) // 2]) - 1.0

    @property
    def course(self) -> np.ndarray:
        """Return forces at the times ``WATCHED`` around the reversal, in units of the greatest by theory."""
        times = (np.arange(len(self.force)) + 0.5) * self.dt - self.time_at(0.0)
        return np.interp(WATCHED * self.theory.duration, times, self.force / self.theory.force)


def bounce(
    theory: BarImpact | HertzImpact,
    points: np.ndarray,
    dx: float,
    poisson_ratio: float,
    mirrored: bool,
    shift: float,
    device: str,
) -> Bounce:
    """Simulate one impact along z.

    Args:
        theory: of it.
        points: particles of the body, which touches the ground [m], shape ``(n, 3)``.
        dx: grid spacing [m].
        poisson_ratio: of the body.
        mirrored: whether it meets its mirror image, with a velocity field of its own, or a plane.
        shift: of the grid [spacings].
        device: Warp device.

    Raises:
        RuntimeError: the body did not come back, or the simulation failed.
    """
    count, gap = len(points), [0.0, 0.0, 0.5 * dx]
    rest = points + gap
    if mirrored:
        rest = np.concatenate([rest, points * [1.0, 1.0, -1.0] - gap])
        other = {"fields": Fields((0, 1), 0.0, np.full(2, DENSITY))}
    else:
        other = {"planes": [((0.0, 0.0, 1.0), 0.0, 0.0)]}
    field = np.arange(len(rest)) // count
    volume = np.full(len(rest), theory.mass / DENSITY / count)
    matter = replace(MaterialPoints.uniform(volume, DENSITY, YOUNG_MODULUS, poisson_ratio), field=field)
    corners = rest.min(0) - shift * dx, rest.max(0)
    about = {"control_dt": theory.duration / LOOKS, "device": device, **other}
    sim = build_matter(*corners, dx=dx, margin=4.0 * dx, rest=rest, points=matter, **about)
    sim.set(u=np.where(field == 0, -theory.speed, theory.speed)[:, None] * [0.0, 0.0, 1.0])
    before, upward = sim.totals(), [-1.0]
    for _ in range(2 * LOOKS + round(gap[2] / (theory.speed * sim.model.control_dt))):
        upward.append(sim.run().get("u")[field == 0, 2].mean() / theory.speed)
    after = sim.totals()
    if max(upward) < 0.5 or any(sim.failures):
        raise RuntimeError(f"the body came back at {max(upward):.3g} of its speed, failures {sim.failures}")
    left = (after.kinetic + after.elastic) / (before.kinetic + before.elastic)
    return Bounce(theory, sim.model.control_dt, np.array(upward), left)
