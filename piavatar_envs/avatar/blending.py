"""Everything that particles blend over their bones in a substep, in one record a bone, and sums over a warp.

A particle is moved by up to four bones, of each of which it needs 51 numbers. Their records are blended first and
applied once; on a GPU a record is read in thirteen loads of 16 bytes.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.types import BoneMatrices, RigidFits, vec12, vec16, vec52

wp.set_module_options({"enable_backward": False})

#: Where in a record the parts begin: rows of three matrices 3 x 4 (place, step, lean), of the turn, 3 x 3, then the
#: rigid motion of the bone: velocity where the pelvis' centre is, and spin.
PLACE, STEP, LEAN, TURN = wp.constant(0), wp.constant(12), wp.constant(24), wp.constant(36)
VELOCITY, SPIN = wp.constant(45), wp.constant(48)


@wp.kernel
def pack_bones(
    matrices: BoneMatrices,
    bones: RigidFits,
    # out
    record: wp.array2d(dtype=vec52),
):
    """Write the record of every bone."""
    e, b = wp.tid()
    s = vec52()
    place = matrices.start[e, b]
    step = matrices.step[e, b]
    lean = matrices.lean[e, b]
    turn = matrices.turn[e, b]
    for i in range(3):
        for j in range(4):
            s[PLACE + 4 * i + j] = place[i, j]
            s[STEP + 4 * i + j] = step[i, j]
            s[LEAN + 4 * i + j] = lean[i, j]
        for j in range(3):
            s[TURN + 3 * i + j] = turn[i, j]
    spin = bones.spin[e, b]
    velocity = bones.velocity[e, b] - wp.cross(spin, bones.center[e, b] - bones.center[e, 0])
    for i in range(3):
        s[VELOCITY + i] = velocity[i]
        s[SPIN + i] = spin[i]
    record[e, b] = s


@wp.func_native("""
wp::vec_t<52, wp::float32> sum;
#pragma unroll
for (int n = 0; n < 4; ++n) {
    const wp::float32 w = weight[n];
    if (w <= 0.0f) continue;
    const auto& bone = wp::index(record, e, joint[n]);
#if defined(__CUDA_ARCH__)
    const float4* const from = reinterpret_cast<const float4*>(&bone);
#pragma unroll
    for (int q = 0; q < 13; ++q) {
        const float4 v = from[q];
        sum[4 * q] += w * v.x;
        sum[4 * q + 1] += w * v.y;
        sum[4 * q + 2] += w * v.z;
        sum[4 * q + 3] += w * v.w;
    }
#else
    for (int c = 0; c < 52; ++c) sum[c] += w * bone[c];
#endif
}
return sum;
""")
def blend_records(record: wp.array2d(dtype=vec52), e: int, joint: wp.vec4i, weight: wp.vec4) -> vec52:
    """``sum_n weight_n record[e, joint_n]``."""
    ...


@wp.func
def blended_point(s: vec52, first: int, x: wp.vec3):
    """The matrix 3 x 4 that begins at ``first`` of a record, applied to a point."""
    # fmt: off
    return wp.vec3(
        s[first] * x[0] + s[first + 1] * x[1] + s[first + 2] * x[2] + s[first + 3],
        s[first + 4] * x[0] + s[first + 5] * x[1] + s[first + 6] * x[2] + s[first + 7],
        s[first + 8] * x[0] + s[first + 9] * x[1] + s[first + 10] * x[2] + s[first + 11],
    )
    # fmt: on


@wp.func
def blended_turn(s: vec52):
    """The blended rotation matrix."""
    return wp.mat33(s[36], s[37], s[38], s[39], s[40], s[41], s[42], s[43], s[44])


@wp.func
def blended_velocity(s: vec52, arm: wp.vec3):
    """Velocity of the bones' blended rigid motion, ``arm`` from the pelvis' centre [m/s]."""
    return wp.vec3(s[45], s[46], s[47]) + wp.cross(wp.vec3(s[48], s[49], s[50]), arm)


def threads_per_chunk(device: str) -> int:
    """Threads that sum a chunk of a bone's particles: a warp on a GPU."""
    return 32 if wp.get_device(device).is_cuda else 1


_SUM_THREADS = """
#if defined(__CUDA_ARCH__)
if (threads == 32)
#pragma unroll
    for (int c = 0; c < %d; ++c)
        for (int distance = 16; distance > 0; distance >>= 1)
            value[c] += __shfl_xor_sync(0xffffffffu, value[c], distance);
#endif
return value;
"""


@wp.func_native(_SUM_THREADS % 16)
def sum_threads16(value: vec16, threads: int) -> vec16:
    """Sum over the threads of a warp, in an order that never changes; ``value`` where a thread is alone."""
    ...


@wp.func_native(_SUM_THREADS % 12)
def sum_threads12(value: vec12, threads: int) -> vec12:
    """:func:`sum_threads16` of twelve numbers."""
    ...
