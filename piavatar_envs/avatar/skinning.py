"""Linear blend skinning on the device: packed weights, and blends of per-bone records at the particles.

A particle is moved by up to four bones, and its skinning is packed into 16 bytes, because every pass over particles
reads it: weights add up to one, so the first is not stored. It is the same in all environments.

For the pose controller a bone has one record of everything that particles blend in a substep. On a GPU a record is read
in eleven loads of 16 bytes, which dominate the cost of the pass. Therefore the step of a bone is stored as the rate of
its turn, which the record has anyway, and a translation, not as a matrix of its own.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.correctives import corrected_rest
from piavatar_envs.avatar.types import Body, vec24, vec44
from piavatar_envs.core.arrays import vec8, vec12

wp.set_module_options({"enable_backward": False})


#: Snippet that reads the skinning of particle ``p``: the ``weights`` of four bones, zeros last, and ``joint(n)``.
READ = """
#if defined(__CUDA_ARCH__)
const float4 packed = *reinterpret_cast<const float4*>(&skin.data[p]);
const wp::float32 other[4] = {packed.x, packed.y, packed.z, packed.w};
#else
const wp::float32* const other = &skin.data[p][0];
#endif
const wp::float32 weights[4] = {1.0f - other[0] - other[1] - other[2], other[0], other[1], other[2]};
unsigned bones;
memcpy(&bones, &other[3], sizeof(bones));
const auto joint = [&](int n) { return (int)(bones >> 8 * n & 255u); };
"""


def in_order(joints: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return bones and weights, both ``(N, 4)``, sorted by bone, those without weight last.

    Weights sum to one in single precision. The order lets the threads of a warp, which mostly blend the same bones,
    process a bone in the same iteration. Blended fields conserve momentum if the sums over bones use the same weights.
    """
    order = np.argsort(np.where(weights > 0.0, joints, NUM_JOINTS), axis=1, kind="stable")
    joints, weights = (np.take_along_axis(values, order, axis=1) for values in (joints, weights))
    weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
    weights[:, 0] = 1.0 - weights[:, 1] - weights[:, 2] - weights[:, 3]
    return joints, weights


def pack(joints: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Pack bones and weights of :func:`in_order` into ``(N, 4)`` float32: three weights, then a byte per bone."""
    bones = (joints.astype(np.uint32) << (8 * np.arange(4, dtype=np.uint32))).sum(axis=1, dtype=np.uint32)
    return np.column_stack([weights[:, 1:], bones.view(np.float32)])


def unpack(skin: wp.array) -> tuple[np.ndarray, np.ndarray]:
    """Return bones and weights, both ``(N, 4)``, as :func:`in_order` has them, from packed skinning on the device."""
    packed = skin.numpy()
    bones = np.ascontiguousarray(packed[:, 3]).view(np.uint32)[:, None] >> (8 * np.arange(4, dtype=np.uint32)) & 255
    first = 1.0 - packed[:, 0] - packed[:, 1] - packed[:, 2]
    return bones.astype(np.int32), np.column_stack([first, packed[:, :3]])


@wp.func_native(READ + "return wp::vec_t<4, wp::int32>(joint(0), joint(1), joint(2), joint(3));")
def bones_of(skin: wp.array(dtype=wp.vec4), p: int) -> wp.vec4i:
    """Return the bones that move particle ``p``."""
    ...


@wp.func_native(READ + "return wp::vec_t<4, wp::float32>(weights[0], weights[1], weights[2], weights[3]);")
def weights_of(skin: wp.array(dtype=wp.vec4), p: int) -> wp.vec4:
    """Return the weights of the bones that move particle ``p``."""
    ...


#: First indices of the parts of a record: rows of two matrices 3 x 4 (place, lean); rows of the turn's rate, 3 x 3; the
#: translation that turns this rate, applied to a place, into its velocity; then the rigid motion of the bone, velocity
#: at the pelvis' centre and spin.
PLACE, LEAN, TURN = wp.constant(0), wp.constant(12), wp.constant(24)
STEP, VELOCITY, SPIN = wp.constant(33), wp.constant(36), wp.constant(39)
#: First indices of the parts of a blended record.
AT_PLACE, AT_LEAN, AT_STEP = wp.constant(0), wp.constant(3), wp.constant(6)
AT_VELOCITY, AT_SPIN = wp.constant(18), wp.constant(21)


@wp.func_native(
    READ
    + """
wp::vec_t<24, wp::float32> sum;
const auto add = [&](const wp::float32* bone, wp::float32 w) {
    wp::float32 end[3], rates[3];  // where the bone would be without its turn, and velocity in the bone
#pragma unroll
    for (int i = 0; i < 6; ++i) {  // place and lean
        const wp::float32* const row = bone + 4 * i;
        const wp::float32 value = row[0] * rest[0] + row[1] * rest[1] + row[2] * rest[2] + row[3];
        if (i < 3) {
            rates[i] = row[0] * rate[0] + row[1] * rate[1] + row[2] * rate[2];
            end[i] = value + dt * rates[i];
        }
        sum[i] += w * value;
    }
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        const wp::float32* const turn = bone + 24 + 3 * i;
        sum[6 + i] += w * (turn[0] * end[0] + turn[1] * end[1] + turn[2] * end[2] + bone[33 + i] + rates[i]);
    }
#pragma unroll
    for (int i = 0; i < 9; ++i) sum[9 + i] += w * bone[24 + i];
#pragma unroll
    for (int i = 0; i < 6; ++i) sum[18 + i] += w * bone[36 + i];
};
#if defined(__CUDA_ARCH__)
const auto* const own = &wp::index(record, e, 0);
float4 w4 = make_float4(weights[0], weights[1], weights[2], weights[3]);
// one bone at a time: a thread that read all of them at once would need so many registers that few threads fit
#pragma unroll 1
for (int n = 0; n < 4; ++n) {
    if (w4.x > 0.0f) {
        const float4* const from = reinterpret_cast<const float4*>(own + (bones & 255u));
        float4 bone[11];
#pragma unroll
        for (int q = 0; q < 11; ++q) bone[q] = from[q];
        add(reinterpret_cast<const wp::float32*>(bone), w4.x);
    }
    bones >>= 8;
    w4 = make_float4(w4.y, w4.z, w4.w, 0.0f);
}
#else
for (int n = 0; n < 4 && weights[n] > 0.0f; ++n) add(&wp::index(record, e, joint(n))[0], weights[n]);
#endif
return sum;
"""
)
def blend_records(
    record: wp.array2d(dtype=vec44),
    e: int,
    skin: wp.array(dtype=wp.vec4),
    p: int,
    rest: wp.vec3,
    rate: wp.vec3,
    dt: float,
) -> vec24:
    """Return the blend of the records of particle ``p``'s bones, with places and velocities evaluated at ``rest``.

    ``rest`` changes at ``rate`` [m/s]; the velocity is the chord between the places at both ends of the substep ``dt``.
    """
    ...


@wp.func
def blended_vector(s: vec24, first: int):
    """Return the vector at ``first`` of a blended record."""
    return wp.vec3(s[first], s[first + 1], s[first + 2])


@wp.func
def blended_turn(s: vec24):
    """Return the blended rate ``(dR - I) / dt`` of a substep's rotation [1/s]."""
    return wp.mat33(s[9], s[10], s[11], s[12], s[13], s[14], s[15], s[16], s[17])


@wp.func
def blended_velocity(s: vec24, arm: wp.vec3):
    """Return the velocity of the bones' blended rigid motion, ``arm`` from the pelvis' centre [m/s]."""
    return blended_vector(s, AT_VELOCITY) + wp.cross(blended_vector(s, AT_SPIN), arm)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
float4* const to = reinterpret_cast<float4*>(&wp::index(record, e, b));
#pragma unroll
for (int q = 0; q < 11; ++q) to[q] = make_float4(value[4 * q], value[4 * q + 1], value[4 * q + 2], value[4 * q + 3]);
#else
wp::index(record, e, b) = value;
#endif
""")
def store_record(record: wp.array2d(dtype=vec44), e: int, b: int, value: vec44):
    """Store ``record[e, b] = value``, 16 bytes at a time."""
    ...


def _blend(length: int, numbers: int) -> str:
    """Return a snippet that blends the first ``numbers`` of records of ``length``, on a GPU four at a time."""
    return f"""{READ}
wp::vec_t<{length}, wp::float32> sum;
#pragma unroll
for (int n = 0; n < 4; ++n) {{
    const wp::float32 w = weights[n];
    if (w <= 0.0f) continue;
    const auto& bone = record.data[record.shape[1] * e + joint(n)];
#if defined(__CUDA_ARCH__)
#pragma unroll
    for (int c = 0; c < {numbers}; c += 4) {{
        const float4 four = reinterpret_cast<const float4*>(&bone)[c / 4];
        const float part[4] = {{four.x, four.y, four.z, four.w}};
#pragma unroll
        for (int k = 0; k < 4; ++k)
            if (c + k < {numbers}) sum[c + k] += w * part[k];
    }}
#else
    for (int c = 0; c < {numbers}; ++c) sum[c] += w * bone[c];
#endif
}}
return sum;
"""


@wp.func_native(_blend(8, 6))
def blend_changes(record: wp.array2d(dtype=vec8), e: int, skin: wp.array(dtype=wp.vec4), p: int) -> vec8:
    """Return ``sum_n weight_n record[e, joint_n]`` of particle ``p``: a rigid motion of each bone."""
    ...


@wp.func_native(_blend(12, 9))
def blend_steps(record: wp.array2d(dtype=vec12), e: int, skin: wp.array(dtype=wp.vec4), p: int) -> vec12:
    """Run :func:`blend_changes` for nine numbers: a rigid motion of each bone, and a spin."""
    ...


def _blend_rows(add: str) -> str:
    """Return a snippet that adds row ``i`` of a bone's place to a vector, weighted by ``w``."""
    return f"""{READ}
wp::vec3 sum;
#pragma unroll
for (int n = 0; n < 4; ++n) {{
    const wp::float32 w = weights[n];
    if (w <= 0.0f) continue;
    const auto& bone = place.data[place.shape[1] * e + joint(n)];
#pragma unroll
    for (int i = 0; i < 3; ++i) {{
#if defined(__CUDA_ARCH__)
        const float4 four = reinterpret_cast<const float4*>(&bone)[i];
        const wp::float32 row[4] = {{four.x, four.y, four.z, four.w}};
#else
        const auto& row = bone.data[i];
#endif
        {add}
    }}
}}
return sum;
"""


@wp.func_native(_blend_rows("sum[i] += w * (row[0] * rest[0] + row[1] * rest[1] + row[2] * rest[2] + row[3]);"))
def blend_places(
    place: wp.array2d(dtype=wp.mat44),
    e: int,
    skin: wp.array(dtype=wp.vec4),
    p: int,
    rest: wp.vec3,
) -> wp.vec3:
    """Return ``sum_n weight_n place[e, joint_n] (rest, 1)`` of particle ``p``: linear blend skinning."""
    ...


@wp.func_native(_blend_rows("for (int c = 0; c < 3; ++c) sum[c] += w * row[c] * way[i];"))
def blend_back(
    place: wp.array2d(dtype=wp.mat44),
    e: int,
    skin: wp.array(dtype=wp.vec4),
    p: int,
    way: wp.vec3,
) -> wp.vec3:
    """Return ``sum_n weight_n R_n^T way``, ``R_n`` the turns of ``place[e, joint_n]``: a way in the rest frame."""
    ...


@wp.func_native(
    READ
    + """
wp::vec_t<12, wp::float32> sum;
#pragma unroll
for (int n = 0; n < 4; ++n) {
    const wp::float32 w = weights[n];
    if (w <= 0.0f) continue;
    const auto& bone = place.data[place.shape[1] * e + joint(n)];
    const auto& own = motion.data[motion.shape[1] * e + joint(n)];
    wp::float32 image[3], inside[3];
#if defined(__CUDA_ARCH__)
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        const float4 row = reinterpret_cast<const float4*>(&bone)[i];
        image[i] = row.x * rest[0] + row.y * rest[1] + row.z * rest[2] + row.w;
        inside[i] = row.x * rate[0] + row.y * rate[1] + row.z * rate[2];
    }
    const float4* const from = reinterpret_cast<const float4*>(&own);
    const float4 a = from[0], b = from[1];
    const wp::float32 v[3] = {a.x, a.y, a.z}, s[3] = {a.w, b.x, b.y};
#else
    for (int i = 0; i < 3; ++i) {
        const auto& row = bone.data[i];
        image[i] = row[0] * rest[0] + row[1] * rest[1] + row[2] * rest[2] + row[3];
        inside[i] = row[0] * rate[0] + row[1] * rate[1] + row[2] * rate[2];
    }
    const wp::float32 v[3] = {own[0], own[1], own[2]}, s[3] = {own[3], own[4], own[5]};
#endif
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        sum[i] += w * v[i];
        sum[3 + i] += w * s[i];
        sum[6 + i] += w * image[i];
        sum[9 + i] += w * (s[j] * image[k] - s[k] * image[j] + inside[i]);
    }
}
return sum;
"""
)
def blend_images(
    place: wp.array2d(dtype=wp.mat44),
    motion: wp.array2d(dtype=vec8),
    e: int,
    skin: wp.array(dtype=wp.vec4),
    p: int,
    rest: wp.vec3,
    rate: wp.vec3,
) -> vec12:
    """Return the blend of the bones' motions, their images of the particle, and the velocity of these.

    Each bone's spin turns its own image of the particle about the origin of the places, and ``rate`` is the velocity of
    ``rest`` [m/s].
    """
    ...


@wp.func
def skinned_place(body: Body, place: wp.array2d(dtype=wp.mat44), elapsed: float, e: int, p: int):
    """Return the skinned position of a particle when a share ``elapsed`` of the control step is over [m].

    ``place`` takes bones from rest to the world.
    """
    return blend_places(place, e, body.skin, p, corrected_rest(body, elapsed, e, p))


@wp.func
def motion_at(change: vec8, arm: wp.vec3):
    """Return the velocity of a rigid motion at ``arm`` from its reference point [m/s]."""
    return wp.vec3(change[0], change[1], change[2]) + wp.cross(wp.vec3(change[3], change[4], change[5]), arm)
