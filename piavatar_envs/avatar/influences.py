"""Which bones move a particle, and by which weights: its skinning in sixteen bytes.

Weights add up to one, so that of the first nothing is stored. What a body's particles are skinned to is the same in all
environments, but every pass of every body reads it.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.skeleton import NUM_JOINTS

wp.set_module_options({"enable_backward": False})

#: Snippet that reads what particle ``p`` is skinned to: the ``weights`` of four bones, zeros last, and ``joint(n)``.
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
    """Bones and weights, both ``(N, 4)``, that sum to one in single precision; by bones, those without weight last.

    Threads that work together mostly blend the same bones, and so they do it in the same round. Fields blended over
    bones keep momentum if the sums over these have the same weights.
    """
    order = np.argsort(np.where(weights > 0.0, joints, NUM_JOINTS), axis=1, kind="stable")
    joints, weights = (np.take_along_axis(values, order, axis=1) for values in (joints, weights))
    weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
    weights[:, 0] = 1.0 - weights[:, 1] - weights[:, 2] - weights[:, 3]
    return joints, weights


def pack(joints: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """What :func:`in_order` returns in records of four numbers, ``(N, 4)`` float32: three weights, a byte a bone."""
    bones = (joints.astype(np.uint32) << (8 * np.arange(4, dtype=np.uint32))).sum(axis=1, dtype=np.uint32)
    return np.column_stack([weights[:, 1:], bones.view(np.float32)])


@wp.func_native(READ + "return wp::vec_t<4, wp::int32>(joint(0), joint(1), joint(2), joint(3));")
def bones_of(skin: wp.array(dtype=wp.vec4), p: int) -> wp.vec4i:
    """The bones that move particle ``p``."""
    ...


@wp.func_native(READ + "return wp::vec_t<4, wp::float32>(weights[0], weights[1], weights[2], weights[3]);")
def weights_of(skin: wp.array(dtype=wp.vec4), p: int) -> wp.vec4:
    """Their weights."""
    ...
