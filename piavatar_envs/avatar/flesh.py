"""Flesh on moving bones: kinematic velocity, shape preservation and tone, per particle.

Two critically damped pulls act on the physical velocity, both implicit in time and both without net momentum:

- *shape preservation* (``alpha``): of a particle towards its skinned place on the carried bones. It acts only on the
  motion relative to the bones, and what it changes is given back bone by bone.
- *tone*: of the bones towards the commanded pose, relative to the body's own rigid motion. A body of tone 0 gives way
  and keeps its bent joints; a body of tone 1 recoils and returns.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.blending import (
    LEAN,
    PLACE,
    STEP,
    blend_records,
    blended_point,
    blended_turn,
    blended_velocity,
)
from piavatar_envs.avatar.pulls import implicit_velocity, pull_denominator, pull_gain
from piavatar_envs.avatar.rigid_fit import spin_of
from piavatar_envs.avatar.types import Body, BoneChange, Drive, RemovedMotion, RigidFit, RigidFits, vec12, vec52
from piavatar_envs.mpm.stores import store_vector
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False})


@wp.kernel
def drive_particles(
    body: Body,
    drive: Drive,
    x: wp.array2d(dtype=wp.vec3),
    record: wp.array2d(dtype=vec52),
    bones: RigidFits,
    let_go: wp.array(dtype=int),
    failure: wp.array(dtype=int),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
    motion: wp.array2d(dtype=wp.vec3),
    # out
    vk: wp.array2d(dtype=wp.vec3),
    pull: wp.array2d(dtype=wp.vec3),
    lean: wp.array2d(dtype=wp.vec3),
):
    """Kinematic velocity of a particle, its shape pull [m/s] and its way to the commanded pose [m].

    ``vk = (LBS(G T_{s+1}) - LBS(G T_s)) / dt + (dR - I)(x - LBS(G T_s)) / dt``: the second term turns the displacement
    that contact has caused along with the bone. Inert flesh misses its share of every change of that velocity.
    """
    e, p = wp.tid()
    if failure[e] != 0:
        return
    at = x[e, body.first + p]
    rest = body.rest[row(e, body.rest.shape[0]), p]
    s = blend_records(record, e, body.joint[p], body.weight[p])
    place = blended_point(s, PLACE, rest)
    step = blended_point(s, STEP, rest)
    turn = blended_turn(s)
    carried = blended_velocity(s, at - bones.center[e, 0])
    displacement = at - place
    k = step + (turn * displacement - displacement) / drive.dt
    # the paper's shape preservation is part of the prescribed velocity
    k -= drive.kinematic_shape_rate * displacement
    change = k - motion[e, p]
    before = u[e, body.first + p]
    relative = before - carried
    # a body that nothing supports could not take the reaction
    reacts = drive.free_motion == 0 and let_go[e] == 0
    missed = body.inert[row(e, body.inert.shape[0]), p] * change
    store_vector(u, e, body.first + p, before - missed, reacts)
    store_vector(vk, e, body.first + p, k, True)
    store_vector(motion, e, p, k, True)
    store_vector(pull, e, p, implicit_velocity(drive.shape_rate, drive.dt, -displacement, relative) - relative, True)
    store_vector(lean, e, p, blended_point(s, LEAN, rest), drive.tone_rate > 0.0)


@wp.func
def correction_momentum(body: Body, e: int, b: int, corrections: wp.array2d(dtype=vec12)):
    """Sum of the chunks of one bone."""
    s = vec12()
    for c in range(body.chunk_start[b], body.chunk_start[b + 1]):
        s += corrections[e, c]
    return s


@wp.kernel
def blend_corrections(
    body: Body,
    drive: Drive,
    corrections: wp.array2d(dtype=vec12),
    bones: RigidFits,
    whole: RigidFit,
    wrench_linear: wp.array(dtype=wp.vec3),
    wrench_angular: wp.array(dtype=wp.vec3),
    # out
    change_velocity: wp.array2d(dtype=wp.vec3),
    change_spin: wp.array2d(dtype=wp.vec3),
):
    """All that happens to bones as a whole, one field a bone.

    The shape pull given back, the tone, the damping of motion between bones, and the root wrench.
    """
    e = wp.tid()
    r = row(e, body.bone_mass.shape[0])
    dt = drive.dt
    gain = pull_gain(drive.tone_rate, dt)
    keep = 1.0 / pull_denominator(drive.tone_rate, dt) - 1.0 + (wp.exp(-drive.damping * dt) - 1.0)
    m = float(0.0)
    P = wp.vec3()
    L = wp.vec3()
    for b in range(body.parent.shape[0]):
        s = correction_momentum(body, e, b, corrections)
        p1 = wp.vec3(s[0], s[1], s[2])
        l1 = wp.vec3(s[3], s[4], s[5])
        arm = bones.center[e, b] - whole.center[e]
        mass = wp.max(body.bone_mass[r, b], 1.0e-12)
        dv = -p1 / mass + keep * (bones.velocity[e, b] - whole.velocity[e] - wp.cross(whole.spin[e], arm))
        dw = -spin_of(bones.inertia[e, b], l1) + keep * (bones.spin[e, b] - whole.spin[e])
        change_velocity[e, b] = dv
        change_spin[e, b] = dw
        p = mass * dv + p1 + gain * wp.vec3(s[6], s[7], s[8])
        m += mass
        P += p
        L += bones.inertia[e, b] * dw + l1 + gain * wp.vec3(s[9], s[10], s[11]) + wp.cross(arm, p)
    # All of this is internal: its rigid part comes off, and with it what round-off left (a drag of 1e-6 a second else).
    # To command a turn of the whole body is the root's business.
    V = dt * wrench_linear[e] - P / m
    W = dt * wrench_angular[e] - spin_of(whole.inertia[e], L)
    for b in range(body.parent.shape[0]):
        change_velocity[e, b] = change_velocity[e, b] + V + wp.cross(W, bones.center[e, b] - whole.center[e])
        change_spin[e, b] = change_spin[e, b] + W


@wp.func
def finite_turn(w: wp.vec3, dt: float):
    """``(R - I) / dt`` of the rotation ``R = exp(dt w)``, without cancellation [1/s]."""
    half = 0.5 * dt * wp.length(w)
    s = 1.0 - half * half / 6.0
    if half > 1.0e-2:
        s = wp.sin(half) / half
    c = wp.cos(half)
    X = wp.skew(w)
    return (s * c) * X + (0.5 * dt * s * s) * (X * X)


@wp.func
def axial(K: wp.mat33):
    """``sum a x b`` from ``K = sum a b^T``."""
    return wp.vec3(K[1, 2] - K[2, 1], K[2, 0] - K[0, 2], K[0, 1] - K[1, 0])


@wp.kernel
def free_motion(
    body: Body,
    drive: Drive,
    corrections: wp.array2d(dtype=vec12),
    bones: RigidFits,
    whole: RigidFit,
    let_go: wp.array(dtype=int),
    # out
    removed_velocity: wp.array(dtype=wp.vec3),
    removed_turn: wp.array(dtype=wp.mat33),
    removed_center: wp.array(dtype=wp.vec3),
    # in and out
    wrench_angular: wp.array(dtype=wp.vec3),
):
    """What a body without support takes out of commanded motion: a body cannot push itself off nothing.

    The kinematic step, as a whole, is moved back by the rigid motion that leaves it without momentum and angular
    momentum: ``vk' = y + A (r + dt y)`` with ``y = vk - V`` and ``sum m r x vk' = 0``. And as the inertia changes, a
    spinning body keeps its angular momentum, not its spin (a skater who draws in the arms).
    """
    e = wp.tid()
    removed_velocity[e] = wp.vec3(0.0)
    removed_turn[e] = wp.mat33()
    removed_center[e] = wp.vec3(0.0)  # one left over from before would enter the carry by its round-off
    if drive.free_motion == 0 and let_go[e] == 0:
        return
    r = row(e, body.bone_mass.shape[0])
    m = float(0.0)
    P = wp.vec3()
    K = wp.mat33()
    for b in range(body.parent.shape[0]):
        s = correction_momentum(body, e, b, corrections)
        p = wp.vec3(s[0], s[1], s[2])
        m += body.bone_mass[r, b]
        P += p
        K += wp.mat33(s[3], s[4], s[5], s[6], s[7], s[8], s[9], s[10], s[11])
        K += wp.outer(bones.center[e, b] - whole.center[e], p)
    I = whole.inertia[e]
    second = wp.diag(wp.vec3(0.5 * wp.trace(I))) - I
    A = wp.mat33()
    w = wp.vec3()
    moment = K
    for _ in range(5):  # each turn of the loop gains a factor of dt |w|
        w -= spin_of(I, axial(moment))
        A = finite_turn(w, drive.dt)
        moment = K + (drive.dt * K + second) * wp.transpose(A)
    removed_velocity[e] = P / m
    removed_turn[e] = A
    removed_center[e] = whole.center[e]
    W = whole.spin[e]
    wrench_angular[e] = wrench_angular[e] - spin_of(I, wp.trace(moment) * W - moment * W)


@wp.kernel
def apply_corrections(
    body: Body,
    drive: Drive,
    x: wp.array2d(dtype=wp.vec3),
    pull: wp.array2d(dtype=wp.vec3),
    lean: wp.array2d(dtype=wp.vec3),
    bones: RigidFits,
    change: BoneChange,
    removed: RemovedMotion,
    failure: wp.array(dtype=int),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
    vk: wp.array2d(dtype=wp.vec3),
):
    """Change the physical velocity by the pulls and the bones' blended field; free the motion of its rigid part."""
    e, p = wp.tid()
    if failure[e] != 0:
        return
    at = x[e, body.first + p]
    du = pull[e, p] + pull_gain(drive.tone_rate, drive.dt) * lean[e, p]
    joint = body.joint[p]
    weight = body.weight[p]
    for n in range(4):
        w = weight[n]
        if w > 0.0:
            b = joint[n]
            du += w * (change.velocity[e, b] + wp.cross(change.spin[e, b], at - bones.center[e, b]))
    store_vector(u, e, body.first + p, u[e, body.first + p] + du, True)
    V = removed.velocity[e]
    A = removed.turn[e]
    if wp.length_sq(V) + wp.ddot(A, A) > 0.0:
        free = vk[e, body.first + p] - V
        vk[e, body.first + p] = free + A * (at - removed.center[e] + drive.dt * free)
