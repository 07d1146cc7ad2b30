"""What a node has, in records of two halves: mass and a physical vector; a kinematic one and nothing.

Both are asked for by few: the kinematic half only where contact is at hand. So the first halves of a slot's 64 nodes
lie together, and then the second ones: a row of nodes is a row in memory, and who wants one half of them fetches no
other. Record ``r`` is node ``r % 64`` of slot ``r // 64``.

What particles add up on the nodes, in floating or in fixed point.

Floating-point sums depend on the order of their summands, which on a GPU is another one every time. In fixed point
they do not, and a run can be repeated bit for bit. 32 bits are too few: they leave an affine velocity right to 1e-4
only. 64 count units of 2^-36 of
what a full cell of matter has, at rest or at a grid spacing a time step; a summand may be of 4,000 such cells, and
there is room for thousands of them. Summands are rounded to the nearest unit, which is unbiased: rounding masses up
would slow all motion down.

Four numbers lie together: 32 bytes, which a GPU's memory takes at a time. They are mass and physical momentum, and
elsewhere kinematic momentum and nothing, as in :mod:`piavatar_envs.mpm.grid_arrays`; offsets and the mass of seams. So
what is added up together, and the first without the second, is of whole such sectors, and four threads add to one at
once.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.core.arrays import vec4l, vec8
from piavatar_envs.mpm.types import Accumulators, Grid, Step, row

wp.set_module_options({"enable_backward": False})

#: Nodes lighter than this [kg] carry nothing but round-off.
MASS_MIN = wp.constant(1.0e-15)


#: From the first half of a record to its second; as many as a block has nodes.
TO_KINEMATIC = wp.constant(64)


@wp.func_native(f"return r + (r & ~{int(TO_KINEMATIC) - 1}) + half * {int(TO_KINEMATIC)};")
def half_of(r: int, half: int) -> int:
    """Where the first half of record ``r`` is, or with ``half`` 1 the second."""
    ...


@wp.func_native("return (wp::uint64)&wp::index(halves, e, 0);")
def first_of_halves(halves: wp.array2d(dtype=wp.vec4), e: int) -> wp.uint64:
    """Address of ``halves[e, 0]``, for :func:`read_half_from`."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
const float4 a = (reinterpret_cast<const float4*>(first) + (wp::int64)at)[next];
return wp::vec_t<4, wp::float32>(a.x, a.y, a.z, a.w);
#else
return reinterpret_cast<const wp::vec_t<4, wp::float32>*>(first)[at + next];
#endif
""")
def read_half_from(first: wp.uint64, at: int, next: int) -> wp.vec4:
    """The ``next``-th half after that at a place; on a GPU in one load. A constant, ``next`` takes it no arithmetic."""
    ...


_FIND = f"""
constexpr int TO_KINEMATIC = {int(TO_KINEMATIC)};
auto* const first = &wp::index(halves, e, r + (r & ~(TO_KINEMATIC - 1)));
"""
_READ = (
    _FIND
    + """
wp::vec_t<8, wp::float32> value;
for (int half = 0; half < 2; ++half) {
#if defined(__CUDA_ARCH__)
    const float4 a = *reinterpret_cast<const float4*>(first + TO_KINEMATIC * half);
    value[4 * half] = a.x, value[4 * half + 1] = a.y, value[4 * half + 2] = a.z, value[4 * half + 3] = a.w;
#else
    for (int c = 0; c < 4; ++c) value[4 * half + c] = first[TO_KINEMATIC * half][c];
#endif
}
return value;
"""
)
_WRITE = (
    _FIND
    + """
for (int half = %d; half < %d; ++half) {
#if defined(__CUDA_ARCH__)
    *reinterpret_cast<float4*>(first + TO_KINEMATIC * half)
        = make_float4(value[4 * half], value[4 * half + 1], value[4 * half + 2], value[4 * half + 3]);
#else
    for (int c = 0; c < 4; ++c) first[TO_KINEMATIC * half][c] = value[4 * half + c];
#endif
}
"""
)


@wp.func_native(_FIND + "return (*first)[0];")
def mass_of(halves: wp.array2d(dtype=wp.vec4), e: int, r: int) -> float:
    """Mass in record ``r``."""
    ...


@wp.func_native(_READ)
def read_record(halves: wp.array2d(dtype=wp.vec4), e: int, r: int) -> vec8:
    """Mass, physical and kinematic vector of record ``r``; a GPU reads and writes each half at once."""
    ...


@wp.func_native(_WRITE % (0, 1))
def write_physical(halves: wp.array2d(dtype=wp.vec4), e: int, r: int, value: vec8):
    """The first half of :func:`write_record`."""
    ...


@wp.func_native(_WRITE % (0, 2))
def write_record(halves: wp.array2d(dtype=wp.vec4), e: int, r: int, value: vec8):
    """Write what :func:`read_record` reads."""
    ...


#: Units in a full cell.
QUANTA_PER_CELL = 2.0**36


def choose_quanta(density: np.ndarray, grid: Grid, step: Step) -> tuple[np.ndarray, np.ndarray]:
    """Units of mass [kg] and of momentum [kg m/s] of fields with reference ``density`` [kg/m^3], in its shape.

    They are powers of two, into and out of which numbers go without rounding: a factor that is off by 3e-8 each time
    has taken 1e-5 of a body's momentum after twenty steps.
    """
    mass = np.asarray(density, float) * grid.dx**3 / QUANTA_PER_CELL
    return np.exp2(np.round(np.log2(mass))), np.exp2(np.round(np.log2(mass * grid.dx / step.dt)))


@wp.func_native("""
const wp::int64* const own = reinterpret_cast<const wp::int64*>(&wp::index(numbers, e, at));
#if defined(__CUDA_ARCH__)
const longlong2 a = reinterpret_cast<const longlong2*>(own)[0], b = reinterpret_cast<const longlong2*>(own)[1];
return wp::vec_t<4, wp::int64>(a.x, a.y, b.x, b.y);
#else
return wp::vec_t<4, wp::int64>(own[0], own[1], own[2], own[3]);
#endif
""")
def quanta_at(numbers: wp.array2d(dtype=vec4l), e: int, at: int) -> vec4l:
    """``numbers[e, at]``, on a GPU in two loads."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
int4* const mine = reinterpret_cast<int4*>(&wp::index(numbers, e, at));
const int4 zero = make_int4(0, 0, 0, 0);
constexpr unsigned ALL = 0xffffffffu;
if (__activemask() == ALL) {
    const int lane = threadIdx.x & 31;
    int4* const first = (int4*)__shfl_sync(ALL, (unsigned long long)mine, 0);
    if (__all_sync(ALL, mine == first + 2 * lane)) {  // those of a warp lie together, and are cleared as they lie
        const unsigned cleared = __ballot_sync(ALL, clears);
        __syncwarp();  // all have read theirs
#pragma unroll
        for (int half = lane; half < 64; half += 32)
            if (cleared >> (half >> 1) & 1u) first[half] = zero;
        __syncwarp();
        return;
    }
}
if (clears) mine[0] = zero, mine[1] = zero;
#else
if (clears) wp::index(numbers, e, at) = wp::vec_t<4, wp::int64>(0, 0, 0, 0);
#endif
""")
def clear_quanta(numbers: wp.array2d(dtype=vec4l), e: int, at: int, clears: bool):
    """Zero ``numbers[e, at]`` if ``clears``; at best all threads of a warp come here."""
    ...


@wp.func
def quanta_to_float(n: vec4l):
    """How many units there are, in floating point."""
    return wp.vec4(float(n[0]), float(n[1]), float(n[2]), float(n[3]))


@wp.func
def decode_physical(quanta: wp.vec2, a: wp.vec4):
    """Mass and physical momentum that ``a`` counts."""
    p = quanta[1]
    return vec8(quanta[0] * a[0], p * a[1], p * a[2], p * a[3], 0.0, 0.0, 0.0, 0.0)


@wp.func
def quanta_of(accumulators: Accumulators, e: int, f: int):
    """Units of mass [kg] and of momentum [kg m/s] of field ``f``."""
    return wp.vec2(
        accumulators.mass_quantum[row(e, accumulators.mass_quantum.shape[0]), f],
        accumulators.momentum_quantum[row(e, accumulators.momentum_quantum.shape[0]), f],
    )


@wp.func
def load_accumulator(accumulators: Accumulators, e: int, r: int):
    """What :func:`finish_take` begins with, mass and physical momentum in fixed point, to be asked for early.

    Nothing where sums are in floating point.
    """
    s = vec4l()
    if accumulators.is_fixed != 0:
        s = quanta_at(accumulators.fixed, e, half_of(r, 0))
    return s


@wp.func
def take_accumulator(accumulators: Accumulators, e: int, f: int, r: int):
    """Mass, physical and kinematic momentum of record ``r`` of field ``f``, which is cleared."""
    return finish_take(accumulators, e, quanta_of(accumulators, e, f), r, load_accumulator(accumulators, e, r), True)


@wp.func
def decode_record(accumulators: Accumulators, e: int, quanta: wp.vec2, r: int, loaded: vec4l):
    """Mass, physical and kinematic momentum in fixed point, of what has ``loaded``; nothing is cleared."""
    b = quanta_to_float(quanta_at(accumulators.fixed, e, half_of(r, 1)))
    p = quanta[1]
    return decode_physical(quanta, quanta_to_float(loaded)) + vec8(
        0.0, 0.0, 0.0, 0.0, p * b[0], p * b[1], p * b[2], 0.0
    )


@wp.func
def finish_take(accumulators: Accumulators, e: int, quanta: wp.vec2, r: int, loaded: vec4l, driven: bool):
    """:func:`take_accumulator` of what has ``loaded``, of a field with these ``quanta``.

    Where it is known that nobody has added kinematic momentum, the record is not ``driven``: that is not read in fixed
    point, nor cleared. (A CPU would lose more by the question than by the answer.)
    """
    s = vec8()
    if accumulators.is_fixed == 0:
        s = read_record(accumulators.value, e, r)
        write_record(accumulators.value, e, r, vec8())
    else:
        a = quanta_to_float(loaded)
        if a[0] > 0.0:  # who adds no mass adds nothing
            if driven:
                s = decode_record(accumulators, e, quanta, r, loaded)
            else:
                s = decode_physical(quanta, a)
        clear_quanta(accumulators.fixed, e, half_of(r, 0), a[0] > 0.0)
        if driven:
            clear_quanta(accumulators.fixed, e, half_of(r, 1), a[0] > 0.0)
    return s


@wp.func
def offset_quantum(grid: Grid, accumulators: Accumulators, e: int, f: int):
    """Unit of a sum of offsets [kg m]; only their quotients with masses matter."""
    return grid.dx * accumulators.mass_quantum[row(e, accumulators.mass_quantum.shape[0]), f]


@wp.func
def offset_at(grid: Grid, accumulators: Accumulators, e: int, f: int, r: int):
    """Sum of ``w m (x_i - x_p)`` [kg m] and of the mass of seam particles [kg] at record ``r`` of field ``f``."""
    if accumulators.is_fixed == 0:
        return accumulators.offset[e, r]
    s = offset_quantum(grid, accumulators, e, f) * quanta_to_float(quanta_at(accumulators.offset_fixed, e, r))
    return wp.vec4(s[0], s[1], s[2], s[3] / grid.dx)


@wp.func
def move_offset(accumulators: Accumulators, e: int, r: int, into: int):
    """Add the offsets of record ``r`` to those of ``into``, of a field of the same units."""
    if accumulators.is_fixed == 0:
        accumulators.offset[e, into] = accumulators.offset[e, into] + accumulators.offset[e, r]
    else:
        accumulators.offset_fixed[e, into] = accumulators.offset_fixed[e, into] + accumulators.offset_fixed[e, r]


@wp.func
def clear_offset(accumulators: Accumulators, e: int, r: int):
    """Forget the offsets of a record."""
    if accumulators.is_fixed == 0:
        accumulators.offset[e, r] = wp.vec4(0.0)
    else:
        clear_quanta(accumulators.offset_fixed, e, r, True)
