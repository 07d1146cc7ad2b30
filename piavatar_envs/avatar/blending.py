"""Everything that particles blend over their bones in a substep, in one record a bone.

A particle is moved by up to four bones, of each of which it needs 51 numbers. On a GPU the record of a bone is read in
thirteen loads of 16 bytes, and applied row by row as it comes: a thread that kept the sum of the records would need so
many registers that few threads fit. On a CPU, which adds eight numbers at once, the sum is applied.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.types import vec8, vec24, vec52

wp.set_module_options({"enable_backward": False})

#: Where in a record the parts begin: rows of three matrices 3 x 4 (place, step, lean), of the turn, 3 x 3, then the
#: rigid motion of the bone: velocity where the pelvis' centre is, and spin.
PLACE, STEP, LEAN, TURN = wp.constant(0), wp.constant(12), wp.constant(24), wp.constant(36)
VELOCITY, SPIN = wp.constant(45), wp.constant(48)
#: Where in what a particle has blended the same parts begin.
AT_PLACE, AT_STEP, AT_LEAN = wp.constant(0), wp.constant(3), wp.constant(6)
AT_VELOCITY, AT_SPIN = wp.constant(18), wp.constant(21)

# What a particle is skinned to, in loads of 16 bytes.
_INFLUENCES = """
#if defined(__CUDA_ARCH__)
int4 j4 = *reinterpret_cast<const int4*>(&joint.data[p]);
float4 w4 = *reinterpret_cast<const float4*>(&weight.data[p]);
const int bones[4] = {j4.x, j4.y, j4.z, j4.w};
const float weights[4] = {w4.x, w4.y, w4.z, w4.w};
#else
const auto& bones = joint.data[p];
const auto& weights = weight.data[p];
#endif
"""


@wp.func_native(
    _INFLUENCES
    + """
wp::vec_t<24, wp::float32> sum;
const auto add = [&](const wp::float32* row, wp::float32 w) {
#pragma unroll
    for (int q = 0; q < 9; ++q, row += 4)
        sum[q] += w * (row[0] * rest[0] + row[1] * rest[1] + row[2] * rest[2] + row[3]);
#pragma unroll
    for (int q = 9; q < 24; ++q) sum[q] += w * row[q - 9];
};
#if defined(__CUDA_ARCH__)
#pragma unroll 1
for (int n = 0; n < 4; ++n) {
    if (w4.x > 0.0f) {
        const float4* const from = reinterpret_cast<const float4*>(&wp::index(record, e, j4.x));
        float4 bone[13];
#pragma unroll
        for (int q = 0; q < 13; ++q) bone[q] = from[q];
        add(reinterpret_cast<const wp::float32*>(bone), w4.x);
    }
    j4 = make_int4(j4.y, j4.z, j4.w, 0);
    w4 = make_float4(w4.y, w4.z, w4.w, 0.0f);
}
#else
wp::vec_t<52, wp::float32> bone;
for (int n = 0; n < 4; ++n) {
    if (weights[n] <= 0.0f) continue;
    const auto& from = wp::index(record, e, bones[n]);
    for (int c = 0; c < 52; ++c) bone[c] += weights[n] * from[c];
}
add(&bone[0], 1.0f);
#endif
return sum;
"""
)
def blend_records(
    record: wp.array2d(dtype=vec52),
    e: int,
    joint: wp.array(dtype=wp.vec4i),
    weight: wp.array(dtype=wp.vec4),
    p: int,
    rest: wp.vec3,
) -> vec24:
    """What particle ``p`` blends: the matrices of its bones' records applied to ``rest``, and the rest of them."""
    ...


@wp.func
def blended_vector(s: vec24, first: int):
    """The vector that begins at ``first`` of what a particle has blended."""
    return wp.vec3(s[first], s[first + 1], s[first + 2])


@wp.func
def blended_turn(s: vec24):
    """The blended rotation matrix."""
    return wp.mat33(s[9], s[10], s[11], s[12], s[13], s[14], s[15], s[16], s[17])


@wp.func
def blended_velocity(s: vec24, arm: wp.vec3):
    """Velocity of the bones' blended rigid motion, ``arm`` from the pelvis' centre [m/s]."""
    return blended_vector(s, AT_VELOCITY) + wp.cross(blended_vector(s, AT_SPIN), arm)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
float4* const to = reinterpret_cast<float4*>(&wp::index(record, e, b));
#pragma unroll
for (int q = 0; q < 13; ++q) to[q] = make_float4(value[4 * q], value[4 * q + 1], value[4 * q + 2], value[4 * q + 3]);
#else
wp::index(record, e, b) = value;
#endif
""")
def store_record(record: wp.array2d(dtype=vec52), e: int, b: int, value: vec52):
    """``record[e, b] = value``, 16 bytes at a time."""
    ...


@wp.func_native(
    _INFLUENCES
    + """
wp::vec_t<8, wp::float32> sum;
#pragma unroll
for (int n = 0; n < 4; ++n) {
    const wp::float32 w = weights[n];
    if (w <= 0.0f) continue;
    const auto& bone = wp::index(change, e, bones[n]);
#if defined(__CUDA_ARCH__)
    const float4* const from = reinterpret_cast<const float4*>(&bone);
    const float4 a = from[0], b = from[1];
    sum[0] += w * a.x;
    sum[1] += w * a.y;
    sum[2] += w * a.z;
    sum[3] += w * a.w;
    sum[4] += w * b.x;
    sum[5] += w * b.y;
#else
    for (int c = 0; c < 8; ++c) sum[c] += w * bone[c];
#endif
}
return sum;
"""
)
def blend_changes(
    change: wp.array2d(dtype=vec8), e: int, joint: wp.array(dtype=wp.vec4i), weight: wp.array(dtype=wp.vec4), p: int
) -> vec8:
    """``sum_n weight_n change[e, joint_n]`` of particle ``p``."""
    ...


@wp.func
def motion_at(change: vec8, arm: wp.vec3):
    """Velocity under a bone's change, or under a blend of them, ``arm`` from where the pelvis' velocity is [m/s]."""
    return wp.vec3(change[0], change[1], change[2]) + wp.cross(wp.vec3(change[3], change[4], change[5]), arm)
