"""Sums over bones in the pass over particles that finds what is to be summed.

A body's particles are in parts that follow each other in memory. On a GPU a CUDA block has a part: what its threads
find of the particles meets in shared memory, from where its warps sum the chunks of bones that are in the part. On a
CPU a body is one part, and its particles meet in an array that all bodies use after each other.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.device import BodyPoints, bone_lists, set_lists
from piavatar_envs.avatar.segment_sums import moments_of, share_chunks, store_both
from piavatar_envs.avatar.types import Body
from piavatar_envs.core.arrays import vec12, vec16

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Threads of a CUDA block that has a part.
PART_BLOCK = 256
#: Particles of a part on a GPU. More have fewer chunks, whose sums cost as much as those of many particles; their CUDA
#: blocks need more shared memory, so fewer of them fit. It is the same for any number of environments, as sums are.
PART = 3 * PART_BLOCK
#: Words of a particle's record: three times four, so that lanes whose particles follow each other read from different
#: banks. Behind all records a part has its masses.
WORDS = wp.constant(12)
#: Words of a particle in all.
ALL_WORDS = int(WORDS) + 1


@wp.struct
class Parts:
    """The particles of a body in parts: part ``i`` has those from ``i * size`` on."""

    size: int
    start: wp.array(dtype=int)  # (parts + 1,) chunks of part i are those of quarters[start[i] : start[i + 1]]
    quarters: wp.array(dtype=wp.vec4i)  # of warps, see piavatar_envs.avatar.segment_sums
    entry: wp.array(dtype=wp.vec2i)  # as the body's: which particle of its part, bits of the weight


def part_size(device: str, count: int) -> int:
    """Particles of a part of a body of ``count``; on a CPU all."""
    return PART if wp.get_device(device).is_cuda else count


def divide(points: BodyPoints, body: Body, device: str) -> tuple[Body, Parts]:
    """The body with chunks that are each in one part, and these parts."""
    size = part_size(device, points.num_points)
    divided, parts = Body(), Parts()
    for name in Body.vars:
        setattr(divided, name, getattr(body, name))
    lists = bone_lists(points, size)
    set_lists(divided, lists, device)
    begin, end, bone = lists["entry_start"][:-1], lists["entry_start"][1:], lists["chunk_bone"]
    part = lists["entry"][begin] // size
    found = [np.flatnonzero(part == i) for i in range(-(-points.num_points // size))]
    quarters = [share_chunks(own, begin[own], end[own], bone[own], device) for own in found]
    parts.size = size
    parts.start = wp.array(np.cumsum([0, *map(len, quarters)]).astype(np.int32), dtype=int, device=device)
    parts.quarters = wp.array(np.concatenate(quarters), dtype=wp.vec4i, device=device)
    entry = np.stack([lists["entry"] % size, lists["entry_weight"].view(np.int32)], axis=1)
    parts.entry = wp.array(entry.astype(np.int32), dtype=wp.vec2i, device=device)
    return divided, parts


@wp.func_native("""
#if defined(__CUDA_ARCH__)
const unsigned parts = gridDim.x / (unsigned)num_envs, row = blockIdx.x / parts;
return wp::vec_t<3, wp::int32>((int)row, (int)(blockIdx.x - row * parts), (int)threadIdx.x);
#else
return wp::vec_t<3, wp::int32>(e, part, thread);
#endif
""")
def place_in_parts(e: int, part: int, thread: int, num_envs: int) -> wp.vec3i:
    """Environment, part and thread in a launch over ``(num_envs, parts, PART_BLOCK)``, as Warp says, too.

    The parts of a body follow each other: they read the same bones. Blocks in the order of parts were slower.
    """
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
__shared__ float __align__(16) particles[{ALL_WORDS * PART}];
return reinterpret_cast<wp::uint64>(particles);
#else
return reinterpret_cast<wp::uint64>(scratch.data);
#endif
""")
def room_of_particles(scratch: wp.array(dtype=float)) -> wp.uint64:
    """Where the particles of a part meet: in a CUDA block's shared memory, on a CPU in ``scratch``."""
    ...


@wp.func_native(f"""
float* const to = reinterpret_cast<float*>(room) + {int(WORDS)} * n;
reinterpret_cast<float*>(room)[{int(WORDS)} * size + n] = m;
#if defined(__CUDA_ARCH__)
reinterpret_cast<float4*>(to)[0] = make_float4(x[0], x[1], x[2], way[0]);
reinterpret_cast<float4*>(to)[1] = make_float4(first[0], first[1], first[2], way[1]);
reinterpret_cast<float4*>(to)[2] = make_float4(second[0], second[1], second[2], way[2]);
#else
for (int c = 0; c < 3; ++c) to[c] = x[c], to[4 + c] = first[c], to[8 + c] = second[c], to[3 + 4 * c] = way[c];
#endif
""")
def bring_particle(
    room: wp.uint64, size: int, n: int, m: float, x: wp.vec3, first: wp.vec3, second: wp.vec3, way: wp.vec3
):
    """Mass, place and three vectors of particle ``n`` of a part that has room for ``size``."""
    ...


@wp.func_native(f"""
const float* const from = reinterpret_cast<const float*>(room) + {int(WORDS)} * n;
wp::vec_t<12, wp::float32> value;
#if defined(__CUDA_ARCH__)
#pragma unroll
for (int c = 0; c < 3; ++c) {{
    const float4 four = reinterpret_cast<const float4*>(from)[c];
    value[4 * c] = four.x, value[4 * c + 1] = four.y, value[4 * c + 2] = four.z, value[4 * c + 3] = four.w;
}}
#else
for (int c = 0; c < 12; ++c) value[c] = from[c];
#endif
return value;
""")
def particle_brought(room: wp.uint64, n: int) -> vec12:
    """What :func:`bring_particle` has brought: place, first and second vector, each with a component of the way."""
    ...


@wp.func_native(f"return reinterpret_cast<const float*>(room)[{int(WORDS)} * size + n];")
def mass_brought(room: wp.uint64, size: int, n: int) -> float:
    """The mass that :func:`bring_particle` has brought."""
    ...


@wp.func_native(f"""
const float* const from = reinterpret_cast<const float*>(room) + 8;
float* const to = reinterpret_cast<float*>(&wp::index(into, e, first));
for (int n = thread; n < 3 * count; n += threads) to[n] = from[{int(WORDS)} * (n / 3) + n % 3];
""")
def store_second(
    room: wp.uint64, count: int, thread: int, threads: int, e: int, first: int, into: wp.array2d(dtype=wp.vec3)
):
    """The second vectors of the ``count`` particles of a part to ``into[e, first:]``, as they lie in memory."""
    ...


@wp.func_native("return entries.data[n];")
def entry_at(entries: wp.array(dtype=wp.vec2i), n: int) -> wp.vec2i:
    """``entries[n]``."""
    ...


@wp.func_native("float weight;\nmemcpy(&weight, &entry[1], sizeof(weight));\nreturn weight;")
def weight_of(entry: wp.vec2i) -> float:
    """The weight of an entry of a part."""
    ...


@wp.func
def sum_chunk(
    parts: Parts,
    room: wp.uint64,
    share: wp.vec4i,
    origin: wp.vec3,
    e: int,
    # out
    moments: wp.array2d(dtype=vec16),
    other_moments: wp.array2d(dtype=vec12),
):
    """Moments about ``origin`` of the chunk of a ``share``, of the part in the room, with the first vector as velocity.

    Of the second one, and of the way, momentum and angular momentum. A loop of its own for the way, which not every
    substep asks for, would read all particles again.
    """
    total = vec16()
    P = wp.vec3()
    L = wp.vec3()
    way_P = wp.vec3()
    way_L = wp.vec3()
    n = share[2]
    while n < share[3]:
        entry = entry_at(parts.entry, n)
        s = particle_brought(room, entry[0])
        w = weight_of(entry) * mass_brought(room, parts.size, entry[0])
        d = wp.vec3(s[0], s[1], s[2]) - origin
        total += moments_of(w, d, wp.vec3(s[4], s[5], s[6]))
        momentum = w * wp.vec3(s[8], s[9], s[10])
        P += momentum
        L += wp.cross(d, momentum)
        momentum = w * wp.vec3(s[3], s[7], s[11])
        way_P += momentum
        way_L += wp.cross(d, momentum)
        n += share[1] >> 8
    # fmt: off
    other = vec12(
        P[0], P[1], P[2], L[0], L[1], L[2],
        way_P[0], way_P[1], way_P[2], way_L[0], way_L[1], way_L[2],
    )
    # fmt: on
    store_both(moments, other_moments, e, share, total, other)
