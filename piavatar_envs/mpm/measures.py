"""In which units relays count: see :mod:`piavatar_envs.mpm.counts`.

A field's unit of mass is of its heaviest particle. Momenta are counted at a speed that is a power of two, four times
what the fastest had a substep before, at least: by all that it adds to its nodes, also by what its stress does, and its
own mass. Who has gained more since fails. Both are measured anew whenever blocks are marked: masses may have changed.

A launch adds while it measures, so sums are counted by what was measured when those before them were added. With sums
in the order in which they are added, launch ``s`` of a relay

- gathers sums ``s``, the first of which a scatter has added, and adds sums ``s + 1``;
- measures those, for sums ``s + 2``;
- prepares the speed of sums ``s + 3``: half of what sums ``s + 1`` are counted by, until somebody is faster.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.counts import SPEEDS, UNITS, Counts
from piavatar_envs.mpm.shared_memory import native, power_of_two
from piavatar_envs.mpm.sweep import lane_of_thread
from piavatar_envs.mpm.types import FAILURE_CFL, FAILURE_NONFINITE

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

_CFL, _NONFINITE = wp.constant(FAILURE_CFL), wp.constant(FAILURE_NONFINITE)


@wp.func
def forget_measures(counts: Counts, e: int):
    """Nobody has been measured, when a relay has ended."""
    for n in range(SPEEDS):
        counts.fastest[e, n] = 0
    for f in range(counts.heaviest.shape[1]):
        counts.heaviest[e, f] = 0


@wp.func
def measure_mass(counts: Counts, e: int, f: int, mass: float):
    """Let field ``f`` count masses in units that suit a particle of this ``mass`` [kg].

    All threads of a warp come here, of one environment; some may have none, which is 0.
    """
    for field in range(counts.heaviest.shape[1]):
        bits = most_of_warp(wp.where(f == field, wp.cast(mass, int), 0))
        if bits > counts.heaviest[e, field] and lane_of_thread() == 0:
            wp.atomic_max(counts.heaviest, e, field, bits)


@wp.func
def prepare_speeds(counts: Counts, e: int, index: int):
    """Let the sums after the next of number ``index`` begin with half of what those are counted by.

    And the second sums with what the first are counted by. The threads of an environment's first particle see to that,
    before anybody measures for them.
    """
    bits = counts.fastest[e, index % SPEEDS]
    if index == 0:
        counts.fastest[e, 1] = bits
    counts.fastest[e, (index + 2) % SPEEDS] = wp.cast(0.5 * wp.cast(bits, float), int)


@wp.func
def speed_of_counts(counts: Counts, e: int, index: int):
    """Speed [m/s] at which the sums of number ``index`` since blocks were marked count momenta."""
    return power_of_two(4.0 * wp.max(counts.slowest, wp.cast(counts.fastest[e, index % SPEEDS], float)))


@wp.func_native(
    native(
        """
#if __CUDA_ARCH__ >= 800
return __reduce_max_sync(0xffffffffu, value);
#else
for (int distance = 16; distance > 0; distance /= 2) value = max(value, __shfl_xor_sync(0xffffffffu, value, distance));
return value;
#endif
""",
        "return value;",
    )
)
def most_of_warp(value: int) -> int:
    """The greatest of a warp's values; all of its threads come here."""
    ...


@wp.func
def known_speed(counts: Counts, e: int, index: int):
    """For :func:`measure_speed`, to be asked for early."""
    return counts.fastest[e, index % SPEEDS]


@wp.func
def measure_speed(counts: Counts, e: int, index: int, known: int, speed: float):
    """Let the sums of number ``index`` count momenta at speeds that suit particles with ``speed`` [m/s].

    All threads of a warp come here, of one environment; some may have none, which is 0.
    """
    bits = most_of_warp(wp.cast(speed, int))  # of numbers that are not negative, the larger one has the larger bits
    if bits > known and lane_of_thread() == 0:  # seldom: it begins with half of the fastest
        wp.atomic_max(counts.fastest, e, index % SPEEDS, bits)


@wp.func
def countable(takes: bool, speed: float, counted: float, e: int, failure: wp.array(dtype=int)):
    """Whether a particle of this ``speed`` is added up where momenta are ``counted`` at another; or its world fails."""
    if takes and not speed <= counted:  # what is no number is not, either
        wp.atomic_or(failure, e, wp.where(wp.isfinite(speed), _CFL, _NONFINITE))
    return takes and speed <= counted


@wp.struct
class Speeds:
    """Speeds that a launch of a relay has to do with, see :func:`speeds_of_launch`."""

    gathered: float
    added: float
    known: int


@wp.func
def speeds_of_launch(counts: Counts, e: int, substep: int):
    """:func:`speed_of_counts` of what it gathers and of what it adds, and :func:`known_speed` of what it measures."""
    return Speeds(
        speed_of_counts(counts, e, substep),
        speed_of_counts(counts, e, substep + 1),
        known_speed(counts, e, substep + 2),
    )


@wp.func
def pass_speeds(
    counts: Counts,
    e: int,
    substep: int,
    speeds: Speeds,
    first: bool,
    takes: bool,
    most: float,
    mass: float,
    unit: float,
    failure: wp.array(dtype=int),
):
    """Whether a particle that ``takes`` part is :func:`countable`; those that are, are measured.

    ``most`` is the greatest momentum that it adds, ``unit`` that of mass. All threads of a warp come here; the
    ``first`` of an environment sees to speeds that are to come.
    """
    takes = countable(takes, speed_counted(most, unit), speeds.added, e, failure)
    # who is light may be fast, and what it hits will be, too
    measure_speed(counts, e, substep + 2, speeds.known, wp.where(takes, most / mass, 0.0))
    if first:
        prepare_speeds(counts, e, substep + 1)
    return takes


@wp.func
def unit_of_mass(heaviest: float):
    """Unit of mass [kg] of a field whose heaviest particle is this [kg]."""
    return power_of_two(heaviest) / UNITS


@wp.func
def units_at(unit: float, speed: float):
    """Units of mass [kg], which is ``unit``, and of momentum [kg m/s] at a ``speed``."""
    return unit * wp.vec2(1.0, speed)


@wp.func
def speed_counted(most: float, unit: float):
    """Speed at which a momentum ``most`` is as much as 32 bits count of one particle, ``unit`` being that of mass."""
    return most / (UNITS * unit)


@wp.func
def mass_unit_of(counts: Counts, e: int, f: int):
    """:func:`unit_of_mass` of field ``f``."""
    return unit_of_mass(wp.cast(counts.heaviest[e, f], float))
