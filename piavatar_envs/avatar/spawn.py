"""Placing bodies: at reset every particle goes to its skinned place, unstrained, at rest or on its way."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.skinning import skinned_place
from piavatar_envs.avatar.types import Body
from piavatar_envs.core.arrays import store_matrix
from piavatar_envs.core.cuda_intrinsics import environment_of
from piavatar_envs.mpm.types import Kinematic

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def reset_drive(
    mask: wp.array(dtype=wp.bool),
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
    # out
    goal_rotation: wp.array2d(dtype=wp.quat),
    goal_root: wp.array(dtype=wp.vec3),
    let_go: wp.array(dtype=int),
    wrench_force: wp.array(dtype=wp.vec3),
    wrench_torque: wp.array(dtype=wp.vec3),
):
    """Nothing is commanded yet beyond the pose itself; the root is held."""
    e, b = wp.tid()
    if not mask[e]:
        return
    goal_rotation[e, b] = command_rotation[e, b]
    if b == 0:
        goal_root[e] = command_root[e]
        let_go[e] = 0
        wrench_force[e] = wp.vec3(0.0)
        wrench_torque[e] = wp.vec3(0.0)


@wp.kernel
def place_particles(
    mask: wp.array(dtype=wp.bool),
    body: Body,
    bone_from: wp.array2d(dtype=wp.mat44),
    # out
    x: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    C: wp.array3d(dtype=float),
    F: wp.array3d(dtype=float),
    driven: Kinematic,
    motion: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
):
    """Particles of the masked environments to their places in the pose ``bone_from``; the failure is forgiven."""
    at = environment_of(wp.tid(), body.count)
    e = at[0]
    p = at[1]
    if not mask[e]:
        return
    q = body.first + p
    x[e, q] = skinned_place(body, bone_from, e, p)
    u[e, q] = wp.vec3(0.0)
    driven.vk[e, q] = wp.vec3(0.0)
    driven.spin[e, q] = wp.vec3(0.0)
    motion[e, p] = wp.vec3(0.0)
    store_matrix(C, e, q, wp.mat33())
    store_matrix(F, e, q, wp.identity(n=3, dtype=float))
    failure[e] = 0


@wp.kernel
def set_in_motion(
    mask: wp.array(dtype=wp.bool),
    body: Body,
    time: float,
    bone_after: wp.array2d(dtype=wp.mat44),
    x: wp.array2d(dtype=wp.vec3),
    # out
    u: wp.array2d(dtype=wp.vec3),
):
    """Physical velocity of placed particles that are in the pose ``bone_after`` a ``time`` [s] later."""
    e, p = wp.tid()
    if not mask[e]:
        return
    q = body.first + p
    u[e, q] = (skinned_place(body, bone_after, e, p) - x[e, q]) / time
