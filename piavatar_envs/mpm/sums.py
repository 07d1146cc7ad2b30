"""What particles add up on the nodes, in floating or in fixed point.

Floating-point sums depend on the order of their summands, which on a GPU is another one every time. In fixed point they
do not, and a run can be repeated bit for bit. 32 bits are too few: they leave an affine velocity right to 1e-4 only.
64-bit additions are slow where many threads add to neighbouring numbers. So a number is kept in two integers,
``high 2^20 + low``, to which the two parts of a summand are added one by one; ``low`` has room for the carries of two
thousand summands. Together they count units of 2^-36 of what a full cell of matter has, at rest or at a grid spacing a
time step, and reach 10^4 such cells. Summands are rounded to the nearest unit, which is unbiased: rounding masses up
would slow all motion down.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.mpm.types import Grid, Step, Sums, row, vec8, vec8i, vec16i

wp.set_module_options({"enable_backward": False})

#: Units in a full cell.
UNITS = 2.0**36
#: Units in one of the high part.
HIGH = wp.constant(float(2**20))


def units(density: np.ndarray, grid: Grid, step: Step) -> tuple[np.ndarray, np.ndarray]:
    """Units of mass [kg] and of momentum [kg m/s] of fields with reference ``density`` [kg/m^3], in its shape.

    They are powers of two, into and out of which numbers go without rounding: a factor that is off by 3e-8 each time
    has taken 1e-5 of a body's momentum after twenty steps.
    """
    mass = np.asarray(density, float) * grid.dx**3 / UNITS
    return np.exp2(np.round(np.log2(mass))), np.exp2(np.round(np.log2(mass * grid.dx / step.dt)))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
const float4* at = reinterpret_cast<const float4*>(&wp::index(records, e, r));
const float4 a = at[0], b = at[1];
wp::vec_t<8, wp::float32> value;
value[0] = a.x; value[1] = a.y; value[2] = a.z; value[3] = a.w;
value[4] = b.x; value[5] = b.y; value[6] = b.z; value[7] = b.w;
return value;
#else
return wp::index(records, e, r);
#endif
""")
def read_record(records: wp.array2d(dtype=vec8), e: int, r: int) -> vec8:
    """``records[e, r]``, on a GPU in two loads of 16 bytes instead of eight of 4."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
float4* at = reinterpret_cast<float4*>(&wp::index(records, e, r));
at[0] = make_float4(value[0], value[1], value[2], value[3]);
at[1] = make_float4(value[4], value[5], value[6], value[7]);
#else
wp::index(records, e, r) = value;
#endif
""")
def write_record(records: wp.array2d(dtype=vec8), e: int, r: int, value: vec8):
    """``records[e, r] = value`` in two stores of 16 bytes."""
    ...


@wp.func
def take_sum(sums: Sums, e: int, f: int, r: int):
    """Mass, physical and kinematic momentum of record ``r`` of field ``f``, which is cleared."""
    s = vec8()
    if sums.is_fixed == 0:
        s = read_record(sums.value, e, r)
        write_record(sums.value, e, r, vec8())
    else:
        n = sums.fixed[e, r]
        m = HIGH * float(n[0]) + float(n[8])
        if m > 0.0:  # who adds no mass adds nothing
            units = sums.momentum_unit[row(e, sums.momentum_unit.shape[0]), f]
            for c in range(1, 7):
                s[c] = units * (HIGH * float(n[c]) + float(n[8 + c]))
            s[0] = sums.mass_unit[row(e, sums.mass_unit.shape[0]), f] * m
            sums.fixed[e, r] = vec16i()
    return s


@wp.func
def offset_unit(grid: Grid, sums: Sums, e: int, f: int):
    """Unit of a sum of offsets [kg m]; only their quotients with masses matter."""
    return grid.dx * sums.mass_unit[row(e, sums.mass_unit.shape[0]), f]


@wp.func
def offset_at(grid: Grid, sums: Sums, e: int, f: int, r: int):
    """Sum of ``w m (x_i - x_p)`` [kg m] and of the mass of seam particles [kg] at record ``r`` of field ``f``."""
    if sums.is_fixed == 0:
        return sums.offset[e, r]
    n = sums.offset_fixed[e, r]
    unit = offset_unit(grid, sums, e, f)
    s = wp.vec4()
    for c in range(4):
        s[c] = unit * (HIGH * float(n[c]) + float(n[4 + c]))
    s[3] = s[3] / grid.dx
    return s


@wp.func
def move_offset(sums: Sums, e: int, r: int, into: int):
    """Add the offsets of record ``r`` to those of ``into``, of a field of the same units."""
    if sums.is_fixed == 0:
        sums.offset[e, into] = sums.offset[e, into] + sums.offset[e, r]
    else:
        sums.offset_fixed[e, into] = sums.offset_fixed[e, into] + sums.offset_fixed[e, r]


@wp.func
def clear_offset(sums: Sums, e: int, r: int):
    """Forget the offsets of a record."""
    if sums.is_fixed == 0:
        sums.offset[e, r] = wp.vec4(0.0)
    else:
        sums.offset_fixed[e, r] = vec8i()
