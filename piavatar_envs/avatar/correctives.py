"""Correctives of the rest pose on the device: displacements by which the skinning of bent joints keeps volume.

Their coefficients are those of :mod:`piavatar_envs.avatar.body.pose_correctives`. The displacement of a particle is
evaluated once a control step, for the pose at its end, and changes linearly in time in between, so that a substep only
reads it and its rate. Under pose control that pose is the commanded one; under torques the joints' velocities predict
it. The joints' Jacobian leaves the rate out: it is motion apart, as that of
:func:`~piavatar_envs.avatar.torque_control.joint_motion.motion_apart`, which moves flesh relative to its bones.
Momentum is conserved because the total velocity of a particle is, whatever part of it is prescribed.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.pose_correctives import PoseCorrectives
from piavatar_envs.avatar.rotation import quat_exp
from piavatar_envs.avatar.types import Body, Correctives, Pose
from piavatar_envs.core.arrays import vector_at
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


def upload_correctives(correctives: PoseCorrectives | None, alone: int, num_envs: int, device: str) -> Correctives:
    """Upload the coefficients of the particles from ``alone`` on, and allocate the displacements of ``num_envs``."""
    uploaded = Correctives()
    none = (
        np.zeros(1, np.int32),
        np.zeros(0, np.int32),
        np.zeros((0, 3, 3), np.float32),
        np.zeros((0, 3, 3), np.float32),
    )
    start, joint, linear, quadratic = none
    if correctives is not None:
        start, joint = correctives.start[alone:], correctives.joint
        linear, quadratic = correctives.linear, correctives.quadratic
    uploaded.start = wp.array(np.ascontiguousarray(start), dtype=int, device=device)
    uploaded.joint = wp.array(np.ascontiguousarray(joint), dtype=int, device=device)
    uploaded.linear = wp.array(np.ascontiguousarray(linear), dtype=wp.mat33, device=device)
    uploaded.quadratic = wp.array(np.ascontiguousarray(quadratic), dtype=wp.mat33, device=device)
    shape = (num_envs, len(start) - 1)
    uploaded.displacement = wp.zeros(shape, dtype=wp.vec3, device=device)
    uploaded.change = wp.zeros(shape, dtype=wp.vec3, device=device)
    return uploaded


@wp.func
def corrected_rest(body: Body, elapsed: float, e: int, p: int):
    """Return the position that a particle is skinned from when a share ``elapsed`` of the control step is over [m]."""
    rest = vector_at(body.rest, row(e, body.rest.shape[0]), p)
    own = p - body.alone
    if own >= 0 and body.correctives.displacement.shape[1] > 0:
        rest += vector_at(body.correctives.displacement, e, own) + elapsed * vector_at(body.correctives.change, e, own)
    return rest


@wp.func
def correction_rate(body: Body, per_time: float, e: int, p: int):
    """Return the rate of change of the rest position of a particle [m/s]; ``per_time`` is one over a control step."""
    rate = wp.vec3()
    own = p - body.alone
    if own >= 0 and body.correctives.change.shape[1] > 0:
        rate = per_time * vector_at(body.correctives.change, e, own)
    return rate


@wp.func
def with_joint(displacement: wp.vec3, linear: wp.mat33, quadratic: wp.mat33, q: wp.quat):
    """Return a ``displacement`` [m] with that by a joint turned by ``q``, by its coefficients for the particle."""
    v = wp.vec3(q[0], q[1], q[2])
    return displacement + (2.0 * q[3]) * (linear * v) + 2.0 * (quadratic * wp.cw_mul(v, v))


@wp.func
def displacement_of(body: Body, rotation: wp.array2d(dtype=wp.quat), e: int, p: int):
    """Return the displacement of a particle for joints with these local rotations [m]."""
    total = wp.vec3()
    own = p - body.alone
    c = body.correctives
    if own >= 0 and own + 1 < c.start.shape[0]:
        for i in range(c.start[own], c.start[own + 1]):
            total = with_joint(total, c.linear[i], c.quadratic[i], rotation[e, c.joint[i]])
    return total


@wp.kernel
def place_corrections(mask: wp.array(dtype=wp.bool), rotation: wp.array2d(dtype=wp.quat), body: Body):
    """Set the displacements of the masked environments to those of a pose, over ``(num_envs, particles)``."""
    e, p = wp.tid()
    if mask[e]:
        body.correctives.displacement[e, p] = displacement_of(body, rotation, e, body.alone + p)
        body.correctives.change[e, p] = wp.vec3()


@wp.kernel
def begin_corrections(
    before: wp.array2d(dtype=wp.quat),
    after: wp.array2d(dtype=wp.quat),
    body: Body,
):
    """Set displacements for local rotations ``before``, and their change until those ``after``; as many threads."""
    e, p = wp.tid()
    c = body.correctives
    begin = wp.vec3()
    end = wp.vec3()
    for i in range(c.start[p], c.start[p + 1]):  # both in one pass, because the coefficients are what takes time
        linear = c.linear[i]
        quadratic = c.quadratic[i]
        joint = c.joint[i]
        begin = with_joint(begin, linear, quadratic, before[e, joint])
        end = with_joint(end, linear, quadratic, after[e, joint])
    c.displacement[e, p] = begin
    c.change[e, p] = end - begin


@wp.kernel
def turn_joints(
    start: wp.array2d(dtype=wp.quat),
    increment: wp.array2d(dtype=wp.vec3),
    # in and out
    corrected: wp.array2d(dtype=wp.quat),
    # out
    before: wp.array2d(dtype=wp.quat),
):
    """Move ``corrected`` on to ``start`` turned by the rotation vectors ``increment``; over ``(num_envs, bones)``."""
    e, b = wp.tid()
    before[e, b] = corrected[e, b]
    corrected[e, b] = wp.normalize(start[e, b] * quat_exp(increment[e, b]))


@wp.kernel
def predict_joints(
    body: Body,
    time: float,
    pose: Pose,
    velocity: wp.array2d(dtype=float),
    # in and out
    corrected: wp.array2d(dtype=wp.quat),
    # out
    before: wp.array2d(dtype=wp.quat),
):
    """Move ``corrected`` on to the local rotations a ``time`` [s] later, at these velocities of the joints.

    ``velocity`` is a generalised one, see :mod:`piavatar_envs.avatar.torque_control.mass_matrix`. Over
    ``(num_envs, bones)``.
    """
    e, b = wp.tid()
    before[e, b] = corrected[e, b]
    k = 3 + 3 * b
    spin = wp.vec3(velocity[e, k], velocity[e, k + 1], velocity[e, k + 2])
    local = quat_exp(time * spin) * pose.rotation[e, b]
    if b > 0:
        local = wp.quat_inverse(pose.rotation[e, body.parent[b]]) * local
    corrected[e, b] = wp.normalize(local)
