"""What a node has, in records of two halves: mass and a physical vector; a kinematic one and nothing.

Both are asked for by few: the kinematic half only where contact is at hand. So the first halves of a slot's 64 nodes
lie together, and then the second ones: a row of nodes is a row in memory, and who wants one half of them fetches no
other. Record ``r`` is node ``r % 64`` of slot ``r // 64``.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.types import vec8

wp.set_module_options({"enable_backward": False})

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


@wp.func_native(_WRITE % (1, 2))
def write_kinematic(halves: wp.array2d(dtype=wp.vec4), e: int, r: int, value: vec8):
    """The second half of :func:`write_record`."""
    ...


@wp.func_native(_WRITE % (0, 2))
def write_record(halves: wp.array2d(dtype=wp.vec4), e: int, r: int, value: vec8):
    """Write what :func:`read_record` reads."""
    ...
