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
    AT_LEAN,
    AT_PLACE,
    AT_STEP,
    blend_changes,
    blend_records,
    blended_turn,
    blended_vector,
    blended_velocity,
    motion_at,
)
from piavatar_envs.avatar.free_motion import axial, is_free
from piavatar_envs.avatar.lanes import BLOCK, first_particle, sum_threads12, threads_of_environment
from piavatar_envs.avatar.loads import number_at, vector_at
from piavatar_envs.avatar.pulls import implicit_velocity, pull_denominator, pull_gain
from piavatar_envs.avatar.rigid_fit import spin_of
from piavatar_envs.avatar.types import (
    Body,
    Drive,
    RemovedMotion,
    RigidFit,
    RigidFits,
    Wrench,
    vec8,
    vec12,
    vec44,
)
from piavatar_envs.mpm.stores import store_pair, store_vector
from piavatar_envs.mpm.types import Kinematic, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def drive_particle(
    body: Body,
    drive: Drive,
    at: wp.vec3,
    before: wp.vec3,
    record: wp.array2d(dtype=vec44),
    center: wp.vec3,
    let_go: bool,
    e: int,
    p: int,
    # in and out
    u: wp.array2d(dtype=wp.vec3),
    motion: wp.array2d(dtype=wp.vec3),
    # out
    driven: Kinematic,
    pull: wp.array2d(dtype=wp.vec3),
    lean: wp.array2d(dtype=wp.vec3),
):
    """Kinematic velocity of a particle, its pull [m/s] and its way to the commanded pose [m].

    ``vk = (LBS(G T_{s+1}) - LBS(G T_s)) / dt + (dR - I)(x - LBS(G T_s)) / dt``: the second term turns the displacement
    that contact has caused along with the bone. Inert flesh misses its share of every change of that velocity.
    ``at`` is where it is and ``before`` its velocity; ``center`` is the pelvis', where the bones' blended velocity is.
    """
    inert = number_at(body.inert, row(e, body.inert.shape[0]), p)
    rest = vector_at(body.rest, row(e, body.rest.shape[0]), p)
    s = blend_records(record, e, body.skin, p, rest)
    displacement = at - blended_vector(s, AT_PLACE)
    turn = blended_turn(s)
    k = blended_vector(s, AT_STEP) + turn * displacement
    # the paper's shape preservation is part of the prescribed velocity
    k -= drive.kinematic_shape_rate * displacement
    relative = before - blended_velocity(s, at - center)
    pulled = implicit_velocity(drive.shape_rate, drive.dt, -displacement, relative) - relative
    way = blended_vector(s, AT_LEAN)
    if inert > 0.0:
        # a body that nothing supports could not take the reaction
        if drive.free_motion == 0 and not let_go:
            u[e, body.first + p] = before - inert * (k - motion[e, p])
        motion[e, p] = k
    pulled += pull_gain(drive.tone_rate, drive.dt) * way
    store_pair(driven.vk, driven.spin, e, body.first + p, k, -0.5 * axial(turn), True, True)
    store_pair(pull, lean, e, p, pulled, way, drive.tone_rate > 0.0, True)


@wp.kernel(launch_bounds=(BLOCK, 6))
def drive_particles(
    body: Body,
    drive: Drive,
    x: wp.array2d(dtype=wp.vec3),
    record: wp.array2d(dtype=vec44),
    bones: RigidFits,
    let_go: wp.array(dtype=int),
    failure: wp.array(dtype=int),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
    motion: wp.array2d(dtype=wp.vec3),
    # out
    driven: Kinematic,
    pull: wp.array2d(dtype=wp.vec3),
    lean: wp.array2d(dtype=wp.vec3),
):
    """:func:`drive_particle` of every particle, over ``(num_envs, particle_threads)``."""
    i, _ = wp.tid()
    threads = threads_of_environment(x.shape[0])
    own = first_particle(i, threads)
    e = own[0]
    if failure[e] != 0:
        return
    p = own[1]
    last = body.count - 1
    center = bones.center[e, 0]
    gone = let_go[e] != 0
    n = wp.min(p, last)
    following = vector_at(x, e, body.first + n)
    following_u = vector_at(u, e, body.first + n)
    while p < body.count:
        at = following
        before = following_u
        n = wp.min(p + threads, last)
        following = vector_at(x, e, body.first + n)
        following_u = vector_at(u, e, body.first + n)
        drive_particle(body, drive, at, before, record, center, gone, e, p, u, motion, driven, pull, lean)
        p += threads


@wp.func
def bone_change(velocity: wp.vec3, spin: wp.vec3, arm: wp.vec3):
    """The record of a change of rigid motion; the pelvis' centre is ``arm`` from where ``velocity`` is."""
    v = velocity + wp.cross(spin, arm)
    return vec8(v[0], v[1], v[2], spin[0], spin[1], spin[2], 0.0, 0.0)


@wp.func
def blend_corrections(
    body: Body,
    drive: Drive,
    corrections: wp.array2d(dtype=vec12),
    bones: RigidFits,
    whole: RigidFit,
    wrench: Wrench,
    e: int,
    thread: int,
    threads: int,
    # out
    change: wp.array2d(dtype=vec8),
):
    """All that happens to bones as a whole, one field a bone.

    The shape pull given back, the tone, the damping of motion between bones, and the root wrench.
    """
    r = row(e, body.bone_mass.shape[0])
    dt = drive.dt
    gain = pull_gain(drive.tone_rate, dt)
    keep = 1.0 / pull_denominator(drive.tone_rate, dt) - 1.0 + (wp.exp(-drive.damping * dt) - 1.0)
    m = float(0.0)
    P = wp.vec3()
    L = wp.vec3()
    for b in range(thread, body.parent.shape[0], threads):
        s = corrections[e, b]
        p1 = wp.vec3(s[0], s[1], s[2])
        l1 = wp.vec3(s[3], s[4], s[5])
        arm = bones.center[e, b] - whole.center[e]
        mass = wp.max(body.bone_mass[r, b], 1.0e-12)
        # what the shape pull alone did is given back
        dv = -(p1 - gain * wp.vec3(s[6], s[7], s[8])) / mass
        dv += keep * (bones.velocity[e, b] - whole.velocity[e] - wp.cross(whole.spin[e], arm))
        dw = -spin_of(bones.inertia[e, b], l1 - gain * wp.vec3(s[9], s[10], s[11]))
        dw += keep * (bones.spin[e, b] - whole.spin[e])
        change[e, b] = bone_change(dv, dw, bones.center[e, 0] - bones.center[e, b])
        p = mass * dv + p1
        m += mass
        P += p
        L += bones.inertia[e, b] * dw + l1 + wp.cross(arm, p)
    total = sum_threads12(vec12(m, P[0], P[1], P[2], L[0], L[1], L[2], 0.0, 0.0, 0.0, 0.0, 0.0), threads)
    # All of this is internal: its rigid part comes off, and with it what round-off left (a drag of 1e-6 a second else).
    # To command a turn of the whole body is the root's business.
    V = dt * wrench.linear[e] - wp.vec3(total[1], total[2], total[3]) / total[0]
    W = dt * wrench.angular[e] - spin_of(whole.inertia[e], wp.vec3(total[4], total[5], total[6]))
    rigid = bone_change(V, W, bones.center[e, 0] - whole.center[e])
    for b in range(thread, body.parent.shape[0], threads):
        change[e, b] = change[e, b] + rigid


@wp.func
def apply_correction(
    body: Body,
    drive: Drive,
    at: wp.vec3,
    before: wp.vec3,
    center: wp.vec3,
    change: wp.array2d(dtype=vec8),
    removed: RemovedMotion,
    free: bool,
    e: int,
    p: int,
    # in and out
    u: wp.array2d(dtype=wp.vec3),
    driven: Kinematic,
):
    """Change the physical velocity by the pull and the bones' blended field.

    ``at`` is where the particle is, ``before`` its velocity with the pull. Where the body is ``free``, the rigid part
    of its commanded motion comes off.
    """
    field = motion_at(blend_changes(change, e, body.skin, p), at - center)
    store_vector(u, e, body.first + p, before + field, True)
    if free:
        v = vector_at(driven.vk, e, body.first + p) - removed.velocity[e]
        v += removed.turn[e] * (at - removed.center[e] + drive.dt * v)
        store_vector(driven.vk, e, body.first + p, v, True)
        # half the curl of that: one turn after the other, which is not their sum
        w = driven.spin[e, body.first + p]
        back = -0.5 * axial(removed.turn[e])
        driven.spin[e, body.first + p] = w + back + (0.5 * drive.dt) * wp.cross(back, w)


@wp.kernel(launch_bounds=(BLOCK, 10))
def apply_corrections(
    body: Body,
    drive: Drive,
    x: wp.array2d(dtype=wp.vec3),
    pull: wp.array2d(dtype=wp.vec3),
    bones: RigidFits,
    change: wp.array2d(dtype=vec8),
    removed: RemovedMotion,
    let_go: wp.array(dtype=int),
    failure: wp.array(dtype=int),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
    driven: Kinematic,
):
    """:func:`apply_correction` to every particle, over ``(num_envs, particle_threads)``."""
    i, _ = wp.tid()
    threads = threads_of_environment(x.shape[0])
    own = first_particle(i, threads)
    e = own[0]
    if failure[e] != 0:
        return
    free = is_free(drive, let_go[e])
    p = own[1]
    last = body.count - 1
    center = bones.center[e, 0]
    n = wp.min(p, last)
    following = vector_at(x, e, body.first + n)
    following_u = vector_at(u, e, body.first + n)
    following_pull = vector_at(pull, e, n)
    while p < body.count:
        at = following
        before = following_u + following_pull
        n = wp.min(p + threads, last)
        following = vector_at(x, e, body.first + n)
        following_u = vector_at(u, e, body.first + n)
        following_pull = vector_at(pull, e, n)
        apply_correction(body, drive, at, before, center, change, removed, free, e, p, u, driven)
        p += threads
