"""What particles of relays add up on nodes, in whole numbers of 32 bits, two of which are added to at once.

As in :mod:`piavatar_envs.mpm.sums`, sums of whole numbers do not depend on the order of their summands. Those of 64
bits are as fine as anybody could wish, and so large that they do not fit into the second-level cache of a GPU where
several sets of them are in use in turns. 32 bits are fine enough where they count what is there, see
:mod:`piavatar_envs.mpm.measures`: 2^26 units are the mass of a field's heaviest particle, rounded up to a power of two,
or its momentum at a speed that the fastest does not reach.

A word has two numbers: it is the higher one times 2^32, plus the lower one. So one addition adds to both; where the
lower one is negative, the higher half of the word is less by one. Four numbers are 16 bytes, and two nodes in a row a
sector of memory, for which a GPU takes the time of one.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.mpm.records import half_of
from piavatar_envs.mpm.shared_memory import native
from piavatar_envs.mpm.stencil import BLOCK_NODES
from piavatar_envs.mpm.types import Grid, Model, group

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


def is_sparse(model: Model) -> bool:
    """Whether cells of matter at rest are few enough of their field's largest particles for these numbers."""
    volume, field = model.particles.volume.numpy(), model.particles.field.numpy()
    largest = min(volume[:, field == f].max(1).min() for f in np.unique(field))
    return bool(model.grid.dx**3 <= MOST_AT_REST * largest)


#: In CUDA: the four numbers of two words.
NUMBERS_OF = """
auto numbers_of = [](const void* words) {
    const int4 two = *reinterpret_cast<const int4*>(words);
    return make_int4(two.x, two.y - (two.x >> 31), two.z, two.w - (two.z >> 31));
};
"""


@wp.func_native(
    native(
        NUMBERS_OF
        + """
const int4 n = numbers_of(&wp::index(words, e, at));
return wp::vec_t<4, wp::int32>(n.x, n.y, n.z, n.w);
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
