"""Node records, and the accumulators in which P2G sums them.

A record has two halves of four numbers: mass and physical momentum (or velocity); kinematic momentum (or velocity) and
padding. The kinematic half is needed only near contact, so the first halves of the 64 nodes of an active block are
stored together, then the second ones. Record ``r`` is node ``r % 64`` of active block ``r // 64``.

Floating-point sums depend on the order of their summands, which on a GPU differs in every run. Fixed-point sums do not,
so runs repeat bit for bit. 32 bits would resolve an affine velocity to 1e-4 only. The 64-bit accumulators count
quanta of 2^-36 of what a full cell of matter has, at rest or at one grid spacing a time step; a summand may have 2^12
such cells, and thousands of summands fit. Summands are rounded to the nearest quantum, which is unbiased.

A half in fixed point is 32 bytes, the sector that a GPU's memory transfers, so four threads add to one sector at once.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.core.arrays import vec4l, vec8
from piavatar_envs.mpm.types import Accumulators, Grid, Step, row

wp.set_module_options({"enable_backward": False})

#: Nodes lighter than this [kg] hold round-off only.
MASS_MIN = wp.constant(1.0e-15)
#: Distance from the first half of a record to its second: the nodes of a block.
TO_KINEMATIC = wp.constant(64)
#: Quanta of a full cell.
QUANTA_PER_CELL = 2.0**36


@wp.func_native(f"return r + (r & ~{int(TO_KINEMATIC) - 1}) + half * {int(TO_KINEMATIC)};")
def half_of(r: int, half: int) -> int:
    """Return the index of the first (``half`` 0) or second (``half`` 1) half of record ``r``."""
    ...


@wp.func_native("return (wp::uint64)&wp::index(halves, e, 0);")
def first_of_halves(halves: wp.array2d(dtype=wp.vec4), e: int) -> wp.uint64:
    """Return the address of ``halves[e, 0]``, for :func:`read_half_from`."""
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
    """Return half ``at + next`` from an address, on a GPU with one load; a constant ``next`` costs no arithmetic."""
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
    """Return the mass in record ``r``."""
    ...


@wp.func_native(_READ)
def read_record(halves: wp.array2d(dtype=wp.vec4), e: int, r: int) -> vec8:
    """Return mass, physical and kinematic vector of record ``r``."""
    ...


@wp.func_native(_WRITE % (0, 1))
def write_physical(halves: wp.array2d(dtype=wp.vec4), e: int, r: int, value: vec8):
    """Write the first half of record ``r``."""
    ...


@wp.func_native(_WRITE % (0, 2))
def write_record(halves: wp.array2d(dtype=wp.vec4), e: int, r: int, value: vec8):
    """Write both halves of record ``r``."""
    ...


def choose_quanta(density: np.ndarray, grid: Grid, step: Step) -> tuple[np.ndarray, np.ndarray]:
    """Return the quanta of mass [kg] and momentum [kg m/s] of fields, in the shape of ``density`` [kg/m^3].

    Quanta are powers of two, so that conversion to and from floating point is exact: a relative error of 3e-8 in each
    conversion would remove 1e-5 of a body's momentum within twenty steps.
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
    """Return ``numbers[e, at]``, on a GPU with two loads."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
int4* const own = reinterpret_cast<int4*>(&wp::index(numbers, e, at));
const int4 zero = make_int4(0, 0, 0, 0);
constexpr unsigned ALL = 0xffffffffu;
if (__activemask() == ALL) {
    const int lane = threadIdx.x & 31;
    int4* const first = (int4*)__shfl_sync(ALL, (unsigned long long)own, 0);
    if (__all_sync(ALL, own == first + 2 * lane)) {  // the warp's numbers are contiguous: clear them line by line
        const unsigned cleared = __ballot_sync(ALL, clears);
        __syncwarp();  // all threads have read their numbers
#pragma unroll
        for (int half = lane; half < 64; half += 32)
            if (cleared >> (half >> 1) & 1u) first[half] = zero;
        __syncwarp();
        return;
    }
}
if (clears) own[0] = zero, own[1] = zero;
#else
if (clears) wp::index(numbers, e, at) = wp::vec_t<4, wp::int64>(0, 0, 0, 0);
#endif
""")
def clear_quanta(numbers: wp.array2d(dtype=vec4l), e: int, at: int, clears: bool):
    """Zero ``numbers[e, at]`` if ``clears``, in whole cache lines if all threads of the warp call this together."""
    ...


@wp.func
def quanta_to_float(n: vec4l):
    """Convert counts of quanta to floating point."""
    return wp.vec4(float(n[0]), float(n[1]), float(n[2]), float(n[3]))


@wp.func
def decode_physical(quanta: wp.vec2, a: wp.vec4):
    """Return mass and physical momentum from their counts of ``quanta``."""
    p = quanta[1]
    return vec8(quanta[0] * a[0], p * a[1], p * a[2], p * a[3], 0.0, 0.0, 0.0, 0.0)


@wp.func
def quanta_of(accumulators: Accumulators, e: int, f: int):
    """Return the quanta of mass [kg] and momentum [kg m/s] of field ``f``."""
    return wp.vec2(
        accumulators.mass_quantum[row(e, accumulators.mass_quantum.shape[0]), f],
        accumulators.momentum_quantum[row(e, accumulators.momentum_quantum.shape[0]), f],
    )


@wp.func
def load_accumulator(accumulators: Accumulators, e: int, r: int):
    """Load mass and physical momentum of record ``r`` in fixed point, early; zero with floating-point accumulators."""
    s = vec4l()
    if accumulators.is_fixed != 0:
        s = quanta_at(accumulators.fixed, e, half_of(r, 0))
    return s


@wp.func
def take_accumulator(accumulators: Accumulators, e: int, f: int, r: int):
    """Return mass, physical and kinematic momentum of record ``r`` of field ``f``, and clear it."""
    return finish_take(accumulators, e, quanta_of(accumulators, e, f), r, load_accumulator(accumulators, e, r), True)


@wp.func
def decode_record(accumulators: Accumulators, e: int, quanta: wp.vec2, r: int, loaded: vec4l):
    """Return mass, physical and kinematic momentum of record ``r`` in fixed point, whose first half is ``loaded``."""
    b = quanta_to_float(quanta_at(accumulators.fixed, e, half_of(r, 1)))
    p = quanta[1]
    return decode_physical(quanta, quanta_to_float(loaded)) + vec8(
        0.0, 0.0, 0.0, 0.0, p * b[0], p * b[1], p * b[2], 0.0
    )


@wp.func
def finish_take(accumulators: Accumulators, e: int, quanta: wp.vec2, r: int, loaded: vec4l, driven: bool):
    """Return mass, physical and kinematic momentum of record ``r``, whose first half is ``loaded``, and clear it.

    If ``driven`` is false no contact candidate has added to the record, and fixed-point kinematic momentum is neither
    read nor cleared. (On a CPU the branch would cost more than the reads.)
    """
    s = vec8()
    if accumulators.is_fixed == 0:
        s = read_record(accumulators.value, e, r)
        write_record(accumulators.value, e, r, vec8())
    else:
        a = quanta_to_float(loaded)
        if a[0] > 0.0:  # without mass, the rest is rounding
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
    """Return the quantum of a sum of offsets [kg m]."""
    return grid.dx * accumulators.mass_quantum[row(e, accumulators.mass_quantum.shape[0]), f]


@wp.func
def offset_at(grid: Grid, accumulators: Accumulators, e: int, f: int, r: int):
    """Return the sums of ``w m (x_i - x_p)`` [kg m] and of seam particles' mass [kg] at record ``r`` of field ``f``."""
    if accumulators.is_fixed == 0:
        return accumulators.offset[e, r]
    s = offset_quantum(grid, accumulators, e, f) * quanta_to_float(quanta_at(accumulators.offset_fixed, e, r))
    return wp.vec4(s[0], s[1], s[2], s[3] / grid.dx)


@wp.func
def move_offset(accumulators: Accumulators, e: int, r: int, into: int):
    """Add the offsets of record ``r`` to those of record ``into``, of a field with the same quanta."""
    if accumulators.is_fixed == 0:
        accumulators.offset[e, into] = accumulators.offset[e, into] + accumulators.offset[e, r]
    else:
        accumulators.offset_fixed[e, into] = accumulators.offset_fixed[e, into] + accumulators.offset_fixed[e, r]


@wp.func
def clear_offset(accumulators: Accumulators, e: int, r: int):
    """Zero the offsets of record ``r``."""
    if accumulators.is_fixed == 0:
        accumulators.offset[e, r] = wp.vec4(0.0)
    else:
        clear_quanta(accumulators.offset_fixed, e, r, True)
