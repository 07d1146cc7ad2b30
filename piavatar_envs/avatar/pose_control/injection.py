"""The paper's injection: the kinematic velocity is added to the one velocity state, once a control step.

Only for reproducing the paper's rows (``decoupling="paper"`` and ``"none"``): ``v += vk_new - vk_old`` with
``vk_new = (LBS(T_next) - LBS(T)) / control_dt``.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.pose_control.bones import carried_bone
from piavatar_envs.avatar.pose_control.kernels import rates_of_shape
from piavatar_envs.avatar.rotation import rigid_matrix
from piavatar_envs.avatar.skinning import skinned_place
from piavatar_envs.avatar.types import Body, Carry, Pose, PoseControl
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def bone_matrices(
    body: Body,
    dt: float,
    pose: Pose,
    next_pose: Pose,
    carry: Carry,
    # out
    bone_from: wp.array2d(dtype=wp.mat44),
    bone_step: wp.array2d(dtype=wp.mat44),
):
    """Write the skinning matrices of a bone, and their change in a control step over its time."""
    e, b = wp.tid()
    q, at = carried_bone(pose, carry, e, b)
    q_next, at_next = carried_bone(next_pose, carry, e, b)
    rest = body.rest_joint[row(e, body.rest_joint.shape[0]), b]
    A = rigid_matrix(q, rest, at)
    bone_from[e, b] = A
    bone_step[e, b] = (rigid_matrix(q_next, rest, at_next) - A) / dt


@wp.kernel
def inject_velocity(
    body: Body,
    control: PoseControl,
    shape_rates: wp.array(dtype=wp.vec2),
    x: wp.array2d(dtype=wp.vec3),
    bone_from: wp.array2d(dtype=wp.mat44),
    bone_step: wp.array2d(dtype=wp.mat44),
    failure: wp.array(dtype=int),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
    vk: wp.array2d(dtype=wp.vec3),
):
    """Add the change of the kinematic velocity to the velocity of every particle."""
    e, p = wp.tid()
    if failure[e] != 0:
        return
    displacement = x[e, body.first + p] - skinned_place(body, bone_from, 0.0, e, p)
    k = skinned_place(body, bone_step, 0.0, e, p) - rates_of_shape(control, shape_rates, p)[1] * displacement
    share = 1.0 - body.velocity_lag[row(e, body.velocity_lag.shape[0]), p]
    u[e, body.first + p] = u[e, body.first + p] + share * (k - vk[e, body.first + p])
    vk[e, body.first + p] = k
