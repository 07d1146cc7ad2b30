"""Motion of bones and particles by the joints: the skinning Jacobian ``J``, and the integration of the pose.

The symbols are those of :mod:`piavatar_envs.avatar.torque_control.articulated_body`; a generalised velocity is as
:mod:`piavatar_envs.avatar.torque_control.mass_matrix` defines it. ``J`` is applied and never stored: a generalised
velocity gives each bone a rigid motion, and a particle the blend of its bones' motions. The blend is evaluated at the
particle, not at its skinned place; otherwise angular momentum would not be conserved.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.rotation import quat_exp
from piavatar_envs.avatar.torque_control.mass_matrix import BONES
from piavatar_envs.avatar.types import Body
from piavatar_envs.core.arrays import vec8, vec12
from piavatar_envs.core.cuda_intrinsics import (
    over_ancestors,
    sync_threads,
)
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def triple_of(q: wp.array2d(dtype=float), e: int, first: int):
    """Return three components of a generalised vector, from index ``first`` on."""
    return wp.vec3(q[e, first], q[e, first + 1], q[e, first + 2])


@wp.func
def set_triple(q: wp.array2d(dtype=float), e: int, first: int, v: wp.vec3):
    """Write three components of a generalised vector, from index ``first`` on."""
    for i in range(3):
        q[e, first + i] = v[i]


@wp.func
def joint_alone(position: wp.array2d(dtype=wp.vec3), q: wp.array2d(dtype=float), row: int, e: int, b: int):
    """Return the rigid motion that joint ``b`` alone adds to all bones beyond it; joint 0 also moves the pelvis."""
    w = triple_of(q, row, 3 + 3 * b)
    v = wp.vec3()
    if b == 0:
        v = triple_of(q, row, 0)
    else:
        v = wp.cross(w, position[e, 0] - position[e, b])
    return vec8(v[0], v[1], v[2], w[0], w[1], w[2], 0.0, 0.0)


_ADD = "value[k] += up < 0 ? 0.0f : more;"


@wp.func_native(over_ancestors(6, _ADD))
def add_ancestors6(value: vec8, parent: int, levels: int) -> vec8:
    """Sum a per-bone value from the root to each lane's bone: six numbers, one bone a lane."""
    ...


@wp.func_native(over_ancestors(3, _ADD))
def add_ancestors3(value: wp.vec3, parent: int, levels: int) -> wp.vec3:
    """Run :func:`add_ancestors6` for a vector of three numbers."""
    ...


@wp.func
def spread_motion(
    body: Body,
    position: wp.array2d(dtype=wp.vec3),
    q: wp.array2d(dtype=float),
    row: int,
    e: int,
    thread: int,
    threads: int,
    # out
    field: wp.array2d(dtype=vec8),
):
    """Compute the rigid motion of every bone under generalised velocity ``q[row]``.

    ``field`` gets velocity at the pelvis joint [m/s] and spin [rad/s]. A single thread processes the bones in their
    order, parents first; in a warp each lane has a bone.
    """
    sync_threads(threads)
    if threads == 1:
        for b in range(BONES):
            motion = joint_alone(position, q, row, e, b)
            if b > 0:
                motion = field[e, body.parent[b]] + motion
            field[e, b] = motion
    else:
        own = wp.min(thread, BONES - 1)
        whole = add_ancestors6(joint_alone(position, q, row, e, own), body.parent[own], body.levels)
        if thread < BONES:
            field[e, own] = whole
    sync_threads(threads)


@wp.func
def motion_apart(b: vec12):
    """Return the velocity from bones that place the particle differently, missing in the blended motion [m/s].

    ``b`` is a record of :func:`piavatar_envs.avatar.skinning.blend_images`. Linear blend skinning places a particle at
    the mean of its bones' images. In a bent joint these lie apart, and each bone turns its own image, so that the mean
    of their velocities differs from the mean motion at the mean place. Without this term particles would drift from
    their skinned places with every turn. It is zero for a rigid motion.
    """
    return wp.vec3(b[9], b[10], b[11]) - wp.cross(wp.vec3(b[3], b[4], b[5]), wp.vec3(b[6], b[7], b[8]))


@wp.func
def blended_motion(b: vec12, arm: wp.vec3):
    """Return the velocity of the bones' blended motion at ``arm`` from their reference point [m/s].

    ``b`` is a record of :func:`piavatar_envs.avatar.skinning.blend_images` or
    :func:`piavatar_envs.avatar.skinning.blend_steps`.
    """
    return wp.vec3(b[0], b[1], b[2]) + wp.cross(wp.vec3(b[3], b[4], b[5]), arm)


@wp.func
def next_position(
    body: Body,
    dt: float,
    field: wp.array2d(dtype=vec8),
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    r: int,
    e: int,
    b: int,
):
    """Return a joint's new offset from its parent, which must have turned already [m]; the pelvis' new position."""
    if b == 0:
        s = field[e, 0]
        return position[e, 0] + dt * wp.vec3(s[0], s[1], s[2])
    a = body.parent[b]
    return wp.quat_rotate(rotation[e, a], body.rest_joint[r, b] - body.rest_joint[r, a])


@wp.func
def move_joints(
    body: Body,
    dt: float,
    field: wp.array2d(dtype=vec8),
    e: int,
    thread: int,
    threads: int,
    # in and out
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
):
    """Integrate bone rotations and the pelvis position over ``dt``; the other joints follow at fixed offsets.

    Threads share the bones as in :func:`spread_motion`.
    """
    sync_threads(threads)
    r = row(e, body.rest_joint.shape[0])
    for b in range(thread, BONES, threads):
        s = field[e, b]
        rotation[e, b] = wp.normalize(quat_exp(dt * wp.vec3(s[3], s[4], s[5])) * rotation[e, b])
    sync_threads(threads)
    if threads == 1:
        for b in range(BONES):
            position[e, b] = next_position(body, dt, field, rotation, position, r, e, b)
            if b > 0:
                position[e, b] = position[e, body.parent[b]] + position[e, b]
    else:
        own = wp.min(thread, BONES - 1)
        step = next_position(body, dt, field, rotation, position, r, e, own)
        place = add_ancestors3(step, body.parent[own], body.levels)
        if thread < BONES:
            position[e, own] = place
    sync_threads(threads)
