"""Forward kinematics: the pose of all bones from local rotations, with fixed bone offsets.

Within a control step local rotations are turned by ``exp(fraction * increment)``, along arcs instead of chords.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.rotation import quat_exp, rigid_matrix
from piavatar_envs.avatar.types import Body
from piavatar_envs.core.cuda_intrinsics import over_ancestors, sync_threads
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def bone_offset(body: Body, e: int, b: int, root: wp.vec3):
    """Return the offset of a bone's joint from its parent's, in the parent's frame; the pelvis', in the world [m]."""
    parent = body.parent[b]
    r = row(e, body.rest_joint.shape[0])
    if parent < 0:
        return root
    return body.rest_joint[r, b] - body.rest_joint[r, parent]


@wp.func
def pose_bone(
    body: Body,
    e: int,
    b: int,
    root: wp.vec3,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
):
    """Pose one bone: replace its local ``rotation`` by that in the world. Its parent must have been posed."""
    parent = body.parent[b]
    offset = bone_offset(body, e, b, root)
    if parent < 0:
        position[e, b] = offset
    else:
        rotation[e, b] = wp.normalize(rotation[e, parent] * rotation[e, b])
        position[e, b] = position[e, parent] + wp.quat_rotate(rotation[e, parent], offset)


@wp.func_native(over_ancestors(7, "before[k] = more;", "if (up >= 0) value = wp::mul(before, value);"))
def after_ancestors(value: wp.transform, parent: int, levels: int) -> wp.transform:
    """Return the motion of a lane's bone in the world, composed with those of its ancestors."""
    ...


@wp.func
def pose_bones(
    body: Body,
    fraction: float,
    base_rotation: wp.array2d(dtype=wp.quat),
    base_root: wp.array(dtype=wp.vec3),
    increment: wp.array2d(dtype=wp.vec3),
    root_increment: wp.array(dtype=wp.vec3),
    e: int,
    thread: int,
    threads: int,
    # out
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
):
    """Pose the bones at ``fraction`` of the control step: local rotations turned along arcs, then kinematics.

    A single thread poses the bones in their order, parents first. In a warp each lane has a bone.
    """
    root = base_root[e] + fraction * root_increment[e]
    bones = body.parent.shape[0]
    if threads == 1:
        for b in range(bones):
            rotation[e, b] = base_rotation[e, b] * quat_exp(fraction * increment[e, b])
            pose_bone(body, e, b, root, rotation, position)
    else:
        own = wp.min(thread, bones - 1)
        local = base_rotation[e, own] * quat_exp(fraction * increment[e, own])
        placed = after_ancestors(wp.transform(bone_offset(body, e, own, root), local), body.parent[own], body.levels)
        if thread < bones:
            rotation[e, own] = wp.normalize(wp.transform_get_rotation(placed))
            position[e, own] = wp.transform_get_translation(placed)
        sync_threads(threads)


@wp.kernel
def pose_body(
    body: Body,
    fraction: float,
    base_rotation: wp.array2d(dtype=wp.quat),
    base_root: wp.array(dtype=wp.vec3),
    increment: wp.array2d(dtype=wp.vec3),
    root_increment: wp.array(dtype=wp.vec3),
    threads: int,
    # out
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
):
    """Run :func:`pose_bones` for every environment, over ``(num_envs, threads)``."""
    e, thread = wp.tid()
    pose_bones(
        body, fraction, base_rotation, base_root, increment, root_increment, e, thread, threads, rotation, position
    )  # fmt: skip


@wp.kernel
def rest_matrices(
    body: Body,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    # out
    bone_from: wp.array2d(dtype=wp.mat44),
):
    """Write the skinning matrices of a pose, from rest to the world, over ``(num_envs, bones)``."""
    e, b = wp.tid()
    rest = body.rest_joint[row(e, body.rest_joint.shape[0]), b]
    bone_from[e, b] = rigid_matrix(rotation[e, b], rest, position[e, b])
