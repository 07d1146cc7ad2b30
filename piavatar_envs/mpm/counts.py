"""What particles of relays add up on nodes, in whole numbers of 32 bits, two of which are added to at once.

As in :mod:`piavatar_envs.mpm.sums`, sums of whole numbers do not depend on the order of their summands. Those of 64
bits are as fine as anybody could wish, and so large that they do not fit into the second-level cache of a GPU where
several sets of them are in use in turns. 32 bits are fine enough where they count what is there: 2^26 units are the
mass of a field's heaviest particle, rounded up to a power of two, or its momentum at a speed that the fastest does not
reach. That speed is a power of two, four times what the fastest had a substep before, at least: by all that it adds to
its nodes, also by what its stress does, and its own mass. Who has gained more since fails. Both are measured anew
whenever blocks are marked: masses may have changed. A launch adds while it measures, so sums are counted by what was
measured when those before them were added. With sums in the order in which they are added, launch ``s`` of a relay

- gathers sums ``s``, the first of which a scatter has added, and adds sums ``s + 1``;
- measures those, for sums ``s + 2``;
- prepares the speed of sums ``s + 3``: half of what sums ``s + 1`` are counted by, until somebody is faster.

A word has two numbers: it is the higher one times 2^32, plus the lower one. So one addition adds to both; where the
lower one is negative, the higher half of the word is less by one. Four numbers are 16 bytes, and two nodes in a row a
sector of memory, for which a GPU takes the time of one.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.mpm.records import half_of
from piavatar_envs.mpm.shared_memory import native, power_of_two
from piavatar_envs.mpm.stencil import BLOCK_NODES
from piavatar_envs.mpm.sweep import lane_of_thread
from piavatar_envs.mpm.types import FAILURE_CFL, FAILURE_NONFINITE, Grid, Model, group

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

#: Units in a field's heaviest particle, and in its momentum at the speed at which that is counted.
UNITS = wp.constant(2.0**26)
#: More mass at a node is too much, that of 24 of the heaviest particles at least: there is room for a third more, and
#: momenta are a quarter of what there is room for. (Of more than 64 the first substep may not know.)
MOST_MASS = wp.constant(3 * 2**29)
#: So many of a field's largest particles in a cell at rest leave room for matter to be compressed to half.
MOST_AT_REST = 12.0
#: Speeds that are kept: for the sums that are gathered, for those that are added to, and for two that are to come.
SPEEDS = wp.constant(4)
#: Momenta are counted as if somebody had this speed, in grid spacings a time step, at least, and at least what gravity
#: makes it in so many time steps: who is at rest may begin to move.
SLOWEST, FALLS = 2.0**-9, 4.0
_CFL, _NONFINITE = wp.constant(FAILURE_CFL), wp.constant(FAILURE_NONFINITE)

#: Two words, of two numbers each.
vec2l = wp.types.vector(length=2, dtype=wp.int64)
#: Mass and physical momentum; kinematic momentum and nothing; places and the mass of seams.
vec4i = wp.types.vector(length=4, dtype=wp.int32)


@wp.struct
class Counts:
    """Sets of sums, one after the other, records as in :mod:`piavatar_envs.mpm.records`, and what they are counted by.

    Slots of all sets: ``S``. All but ``slowest`` is zero between the portions of a control step that are relays.
    """

    sum: wp.array2d(dtype=vec2l)  # (num_envs, 128 S) halves of records: mass, physical momentum; kinematic momentum
    offset: wp.array2d(dtype=vec2l)  # (num_envs, 64 S) of w m (x_i - x_p) / dx, and of w m of seam particles
    told: wp.array2d(dtype=int)  # (num_envs, S) not 0: nodes of this slot were told where particles are and go
    heaviest: wp.array2d(dtype=int)  # (num_envs, F) bits of the greatest mass of a particle [kg]
    # (num_envs, SPEEDS) bits of the greatest speed of a particle, momenta are counted at four times that [m/s]
    fastest: wp.array2d(dtype=int)
    slowest: float  # [m/s]


def allocate_counts(model: Model, sets: int) -> Counts:
    """Zeroed sums, ``sets`` of them."""
    n, slots, nodes = model.num_envs, model.max_slots * sets, int(BLOCK_NODES)

    def zeros(count: int, dtype: type) -> wp.array:
        return wp.zeros((n, count), dtype=dtype, device=model.device)

    slowest = max(SLOWEST * model.grid.dx / model.step.dt, FALLS * model.step.dt * np.linalg.norm(model.step.gravity))
    return group(
        Counts,
        sum=zeros(2 * nodes * slots, vec2l),
        offset=zeros(nodes * slots, vec2l),
        told=zeros(slots, int),
        heaviest=zeros(model.contact.num_fields, int),
        fastest=zeros(int(SPEEDS), int),
        slowest=float(slowest),
    )


@wp.func_native(
    native(
        """
const int4 two = *reinterpret_cast<const int4*>(&wp::index(words, e, at));
return wp::vec_t<4, wp::int32>(two.x, two.y - (two.x >> 31), two.z, two.w - (two.z >> 31));
""",
        "return wp::vec_t<4, wp::int32>();",
    )
)
def numbers_at(words: wp.array2d(dtype=vec2l), e: int, at: int) -> vec4i:
    """The four numbers of ``words[e, at]``, in one load."""
    ...


@wp.func_native(native("return *reinterpret_cast<const int*>(&wp::index(words, e, at));", "return 0;"))
def first_number(words: wp.array2d(dtype=vec2l), e: int, at: int) -> int:
    """The first of them alone."""
    ...


@wp.func_native(
    native("""
longlong2* const two = reinterpret_cast<longlong2*>(&wp::index(words, e, at));
auto word = [](int low, int high) { return ((long long)high << 32) + low; };
two->x += word(n[0], n[1]), two->y += word(n[2], n[3]);
""")
)
def give_numbers(words: wp.array2d(dtype=vec2l), e: int, at: int, n: vec4i):
    """Add to the four numbers of ``words[e, at]``, where nobody else adds."""
    ...


def is_sparse(model: Model) -> bool:
    """Whether cells of matter at rest are few enough of their field's largest particles for these numbers."""
    volume, field = model.particles.volume.numpy(), model.particles.field.numpy()
    largest = min(volume[:, field == f].max(1).min() for f in np.unique(field))
    return bool(model.grid.dx**3 <= MOST_AT_REST * largest)


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
    takes = countable(takes, most / (UNITS * unit), speeds.added, e, failure)
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
def mass_unit_of(counts: Counts, e: int, f: int):
    """:func:`unit_of_mass` of field ``f``."""
    return unit_of_mass(wp.cast(counts.heaviest[e, f], float))


@wp.func
def physical_numbers(counts: Counts, e: int, r: int):
    """Mass and physical momentum of record ``r``."""
    return numbers_at(counts.sum, e, half_of(r, 0))


@wp.func
def kinematic_numbers(counts: Counts, e: int, r: int):
    """Kinematic momentum of record ``r``, and nothing."""
    return numbers_at(counts.sum, e, half_of(r, 1))


@wp.func
def mass_counted(counts: Counts, e: int, r: int):
    """How many units of mass record ``r`` has."""
    return first_number(counts.sum, e, half_of(r, 0))


@wp.func
def counted(n: vec4i):
    """Four numbers in floating point."""
    return wp.vec4(float(n[0]), float(n[1]), float(n[2]), float(n[3]))


@wp.func
def place_counted(grid: Grid, unit: float, n: vec4i):
    """Sum of ``w m (x_i - x_p)`` [kg m] and of the mass of seam particles [kg], ``unit`` being that of mass."""
    s = unit * counted(n)
    return wp.vec4(grid.dx * s[0], grid.dx * s[1], grid.dx * s[2], s[3])


@wp.func
def in_units(J: wp.vec3, unit: float):
    """The nearest multiple of a ``unit``, which is one of any smaller unit, too: all units are powers of two."""
    return unit * wp.vec3(wp.rint(J[0] / unit), wp.rint(J[1] / unit), wp.rint(J[2] / unit))


@wp.func
def give_momentum(counts: Counts, e: int, unit: float, r: int, J: wp.vec3):
    """Add an impulse [N s] to record ``r``, ``unit`` being that of momentum, where nobody else adds."""
    n = J / unit
    units = vec4i(0, int(wp.rint(n[0])), int(wp.rint(n[1])), int(wp.rint(n[2])))
    give_numbers(counts.sum, e, half_of(r, 0), units)
