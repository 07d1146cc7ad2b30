"""The paper's drive: the kinematic velocity is injected into the one velocity state, once a control step.

Only for reproducing the paper's rows (``decoupling="paper"`` and ``"none"``): ``v += vk_new - vk_old`` with
``vk_new = (LBS(T_next) - LBS(T)) / control_dt``.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.skinning import skinned_place
from piavatar_envs.avatar.types import Body
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False})


@wp.kernel
def inject_velocity(
    body: Body,
    kinematic_shape_rate: float,
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
    displacement = x[e, body.first + p] - skinned_place(body, bone_from, e, p)
    k = skinned_place(body, bone_step, e, p) - kinematic_shape_rate * displacement
    share = 1.0 - body.inert[row(e, body.inert.shape[0]), p]
    u[e, body.first + p] = u[e, body.first + p] + share * (k - vk[e, body.first + p])
    vk[e, body.first + p] = k
