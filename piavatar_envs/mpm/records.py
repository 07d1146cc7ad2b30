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


@wp.func
def half_of(r: int):
    """Place of the first half of record ``r`` in its environment's row."""
    return r + (r & ~(TO_KINEMATIC - 1))


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


@wp.func_native("""
#if defined(__CUDA_ARCH__)
reinterpret_cast<float4&>(wp::index(halves, e, at)) = make_float4(value[0], value[1], value[2], value[3]);
#else
wp::index(halves, e, at) = value;
#endif
""")
def write_half(halves: wp.array2d(dtype=wp.vec4), e: int, at: int, value: wp.vec4):
    """``halves[e, at] = value``, on a GPU in one store."""
    ...


@wp.func
def mass_of(halves: wp.array2d(dtype=wp.vec4), e: int, r: int):
    """Mass in record ``r``."""
    return halves[e, half_of(r)][0]


@wp.func
def read_physical(halves: wp.array2d(dtype=wp.vec4), e: int, r: int):
    """The first half of :func:`read_record`, and nothing in the second."""
    a = read_half_from(first_of_halves(halves, e), half_of(r), 0)
    return vec8(a[0], a[1], a[2], a[3], 0.0, 0.0, 0.0, 0.0)


@wp.func
def read_record(halves: wp.array2d(dtype=wp.vec4), e: int, r: int):
    """Mass, physical and kinematic vector of record ``r``."""
    b = read_half_from(first_of_halves(halves, e), half_of(r), TO_KINEMATIC)
    return read_physical(halves, e, r) + vec8(0.0, 0.0, 0.0, 0.0, b[0], b[1], b[2], b[3])


@wp.func
def write_physical(halves: wp.array2d(dtype=wp.vec4), e: int, r: int, value: vec8):
    """The first half of :func:`write_record`."""
    write_half(halves, e, half_of(r), wp.vec4(value[0], value[1], value[2], value[3]))


@wp.func
def write_kinematic(halves: wp.array2d(dtype=wp.vec4), e: int, r: int, value: vec8):
    """The second half of :func:`write_record`."""
    write_half(halves, e, half_of(r) + TO_KINEMATIC, wp.vec4(value[4], value[5], value[6], value[7]))


@wp.func
def write_record(halves: wp.array2d(dtype=wp.vec4), e: int, r: int, value: vec8):
    """Write what :func:`read_record` reads."""
    write_physical(halves, e, r, value)
    write_kinematic(halves, e, r, value)
