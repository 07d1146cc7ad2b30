"""Implicit, critically damped pulls: one formula for shape, tone and root.

Commanded motion of bodies that nothing supports: it must carry neither momentum nor angular momentum.

From commands to bone matrices: the kinematic pose along arcs, and the motion by which contact carries it.

Within a control step the tracked local rotations are turned by ``exp(fraction * increment)`` (arcs, not chords) and
posed by forward kinematics with fixed bone offsets, so that no joint gap enters the velocity. Increments are composed
on the right of the tracked rotations: composing on the left, as Algorithm 1 of the paper prints it, is 0.11 m off from
the second frame.

Flesh on moving bones: kinematic velocity, shape preservation and tone, per particle.

Two critically damped pulls act on the physical velocity, both implicit in time and both without net momentum:

- *shape preservation* (``alpha``): of a particle towards its skinned place on the carried bones. It acts only on the
  motion relative to the bones, and what it changes is given back bone by bone.
- *tone*: of the bones towards the commanded pose, relative to the body's own rigid motion. A body of tone 0 gives way
  and keeps its bent joints; a body of tone 1 recoils and returns.

What there is to do for a body before an MPM substep, in stages, for one thread or for those of a CUDA block.

On a CPU one launch does all of it, a body after the other. On a GPU the passes over particles are launches of their
own, over all bodies; what there is to do for bones in between is one launch, a warp a body, or three where bodies are
few. (A block that did all of it for its body would be slower: in each pass and between them it waits for the last of
its threads.) Bones of large bodies have so many chunks that adding those up is a launch of its own.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.critical_damping import implicit_velocity, pull_denominator, pull_gain
from piavatar_envs.avatar.kinematics import pose_bones
from piavatar_envs.avatar.pose_control.root import hold_root, lay_command
from piavatar_envs.avatar.rotation import finite_turn, quat_exp, quat_log, rigid_matrix, turn_about_z
from piavatar_envs.avatar.segment_sums import add_chunks, chunk_corrections, chunk_moments, chunk_motion, share_of
from piavatar_envs.avatar.skinning import (
    AT_LEAN,
    AT_PLACE,
    AT_STEP,
    LEAN,
    PLACE,
    SPIN,
    STEP,
    TURN,
    VELOCITY,
    blend_changes,
    blend_records,
    blended_turn,
    blended_vector,
    blended_velocity,
    motion_at,
    store_record,
)
from piavatar_envs.avatar.tracking import fit_bone, fit_whole, spin_of
from piavatar_envs.avatar.types import (
    DRIVE_REFERENCE,
    DRIVE_TARGET,
    Anchor,
    Bench,
    Body,
    Carry,
    Drive,
    Held,
    Pose,
    RemovedMotion,
    RigidFit,
    RigidFits,
    Wrench,
    vec44,
)
from piavatar_envs.core.arrays import number_at, store_pair, store_vector, vec8, vec12, vec16, vector_at
from piavatar_envs.core.cuda_intrinsics import (
    BLOCK,
    first_particle,
    meet,
    meet_threads,
    place_in_block,
    sum_threads12,
    sum_threads16,
    threads_of_environment,
    warp_of_block,
)
from piavatar_envs.mpm.types import Kinematic, Particles, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def is_free(drive: Drive, let_go: int):
    """Whether nothing supports a body: commanded motion must then carry no momentum."""
    return drive.free_motion != 0 or let_go != 0


@wp.func
def axial(K: wp.mat33):
    """``sum a x b`` from ``K = sum a b^T``."""
    return wp.vec3(K[1, 2] - K[2, 1], K[2, 0] - K[0, 2], K[0, 1] - K[1, 0])


@wp.func
def free_motion(
    body: Body,
    drive: Drive,
    corrections: wp.array2d(dtype=vec12),
    bones: RigidFits,
    whole: RigidFit,
    e: int,
    thread: int,
    threads: int,
    # out
    removed: RemovedMotion,
    # in and out
    wrench: Wrench,
):
    """What a body without support takes out of commanded motion: a body cannot push itself off nothing.

    The kinematic step, as a whole, is moved back by the rigid motion that leaves it without momentum and angular
    momentum: ``vk' = y + A (r + dt y)`` with ``y = vk - V`` and ``sum m r x vk' = 0``. And as the inertia changes, a
    spinning body keeps its angular momentum, not its spin (a skater who draws in the arms).
    """
    r = row(e, body.bone_mass.shape[0])
    m = float(0.0)
    for b in range(thread, body.parent.shape[0], threads):
        m += body.bone_mass[r, b]
    P = wp.vec3()
    K = wp.mat33()
    for c in range(thread, body.chunk_bone.shape[0], threads):
        s = corrections[e, c]
        p = wp.vec3(s[0], s[1], s[2])
        P += p
        K += wp.mat33(s[3], s[4], s[5], s[6], s[7], s[8], s[9], s[10], s[11])
        K += wp.outer(bones.center[e, body.chunk_bone[c]] - whole.center[e], p)
    # fmt: off
    t = sum_threads16(
        vec16(
            m, P[0], P[1], P[2], K[0, 0], K[0, 1], K[0, 2], K[1, 0], K[1, 1], K[1, 2], K[2, 0], K[2, 1], K[2, 2],
            0.0, 0.0, 0.0,
        ),
        threads,
    )
    # fmt: on
    if thread > 0:
        return
    K = wp.mat33(t[4], t[5], t[6], t[7], t[8], t[9], t[10], t[11], t[12])
    I = whole.inertia[e]
    second = wp.diag(wp.vec3(0.5 * wp.trace(I))) - I
    A = wp.mat33()
    w = wp.vec3()
    moment = K
    for _ in range(5):  # each turn of the loop gains a factor of dt |w|
        w -= spin_of(I, axial(moment))
        A = finite_turn(w, drive.dt)
        moment = K + (drive.dt * K + second) * wp.transpose(A)
    removed.velocity[e] = wp.vec3(t[1], t[2], t[3]) / t[0]
    removed.turn[e] = A
    removed.center[e] = whole.center[e]
    W = whole.spin[e]
    wrench.angular[e] = wrench.angular[e] - spin_of(I, wp.trace(moment) * W - moment * W)


I3 = wp.constant(wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))


@wp.kernel
def begin_control(
    drive: Drive,
    tracked_local: wp.array2d(dtype=wp.quat),
    tracked_position: wp.array2d(dtype=wp.vec3),
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
    goal_rotation: wp.array2d(dtype=wp.quat),
    goal_root: wp.array(dtype=wp.vec3),
    # out
    increment: wp.array2d(dtype=wp.vec3),
    command_increment: wp.array2d(dtype=wp.vec3),
    root_increment: wp.array(dtype=wp.vec3),
    carry_rotation: wp.array2d(dtype=wp.quat),
    carry_translation: wp.array2d(dtype=wp.vec3),
):
    """What the drive adds to the tracked pose in this control step; contact has carried nothing yet."""
    e, b = wp.tid()
    step = quat_log(wp.quat_inverse(command_rotation[e, b]) * goal_rotation[e, b])
    command_increment[e, b] = step
    increment[e, b] = step
    if drive.mode == DRIVE_TARGET:
        increment[e, b] = quat_log(wp.quat_inverse(tracked_local[e, b]) * goal_rotation[e, b])
    if b == 0:
        if drive.mode == DRIVE_TARGET:
            root_increment[e] = goal_root[e] - tracked_position[e, 0]
        elif drive.mode == DRIVE_REFERENCE:
            root_increment[e] = goal_root[e] - command_root[e]
        else:
            # a commanded step forward is a step where the body faces
            turn = turn_about_z(tracked_local[e, 0] * wp.quat_inverse(command_rotation[e, 0]))
            root_increment[e] = wp.quat_rotate(turn, goal_root[e] - command_root[e])
    carry_rotation[e, b] = wp.quat(0.0, 0.0, 0.0, 1.0)
    carry_translation[e, b] = wp.vec3(0.0)


@wp.func
def carried(
    e: int, dt: float, removed: RemovedMotion, c: wp.vec3, velocity: wp.vec3, spin: wp.vec3, q: wp.quat, t: wp.vec3
):
    """The rigid motion ``(q, t)``, moved on by a body whose centre has reached ``c`` in a substep.

    What was taken out of the kinematic velocity is a motion that nothing made: it comes off first.
    """
    back = I3 + dt * removed.turn[e]
    q_back = wp.quat_from_matrix(back) * q
    t_back = back * (t - removed.center[e] - dt * removed.velocity[e]) + removed.center[e]
    turn = quat_exp(dt * spin)
    # c was reached by moving at the velocity: turn about where it came from
    before = c - dt * velocity
    return wp.normalize(turn * q_back), wp.quat_rotate(turn, t_back - before) + c


@wp.func
def carry_bone(
    dt: float,
    bones: RigidFits,
    removed: RemovedMotion,
    e: int,
    b: int,
    # in and out
    carry: Carry,
):
    """Advance ``G`` of a bone by the motion that the physical velocity gave it."""
    q, t = carried(
        e, dt, removed, bones.center[e, b], bones.velocity[e, b], bones.spin[e, b],
        carry.rotation[e, b], carry.translation[e, b],
    )  # fmt: skip
    carry.rotation[e, b] = q
    carry.translation[e, b] = t


@wp.func
def carry_anchor(
    dt: float,
    whole: RigidFit,
    removed: RemovedMotion,
    e: int,
    # in and out
    anchor: Anchor,
):
    """Advance the laid command by the body's own motion."""
    q, t = carried(
        e, dt, removed, whole.center[e], whole.velocity[e], whole.spin[e], anchor.rotation[e], anchor.translation[e]
    )
    anchor.rotation[e] = q
    anchor.translation[e] = t


@wp.kernel
def end_control(
    goal_rotation: wp.array2d(dtype=wp.quat),
    goal_root: wp.array(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # out
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
):
    """The goal has been commanded."""
    e, b = wp.tid()
    if failure[e] != 0:
        return
    command_rotation[e, b] = goal_rotation[e, b]
    if b == 0:
        command_root[e] = goal_root[e]


@wp.kernel
def rest_matrices(
    body: Body,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    # out
    bone_from: wp.array2d(dtype=wp.mat44),
):
    """Skinning matrices of a pose: rest world to world."""
    e, b = wp.tid()
    rest = body.rest_joint[row(e, body.rest_joint.shape[0]), b]
    bone_from[e, b] = rigid_matrix(rotation[e, b], rest, position[e, b])


@wp.func
def carried_bone(pose: Pose, carry: Carry, e: int, b: int):
    """Rotation of a bone in a pose and the place of its joint, where contact has carried them to."""
    G = carry.rotation[e, b]
    return G * pose.rotation[e, b], wp.quat_rotate(G, pose.position[e, b]) + carry.translation[e, b]


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
    """Skinning matrices of a step: where a bone is, and the velocity that takes it on."""
    e, b = wp.tid()
    q, at = carried_bone(pose, carry, e, b)
    q_next, at_next = carried_bone(next_pose, carry, e, b)
    rest = body.rest_joint[row(e, body.rest_joint.shape[0]), b]
    A = rigid_matrix(q, rest, at)
    bone_from[e, b] = A
    bone_step[e, b] = (rigid_matrix(q_next, rest, at_next) - A) / dt


@wp.func
def write_record(
    body: Body,
    drive: Drive,
    pose: Pose,
    next_pose: Pose,
    carry: Carry,
    bones: RigidFits,
    command: Pose,
    anchor: Anchor,
    gap: wp.array2d(dtype=wp.vec3),
    e: int,
    b: int,
    # out
    record: wp.array2d(dtype=vec44),
):
    """All that particles blend of a bone in a substep: where it is, the velocity that takes it on, how far it turns.

    Then from the carried to the commanded bone: the commanded pose is laid on the body by the anchor. A bone that
    contact has torn off its parent is carried where the parent would have it; its way back is added.
    """
    q, at = carried_bone(pose, carry, e, b)
    q_next, at_next = carried_bone(next_pose, carry, e, b)
    rest = body.rest_joint[row(e, body.rest_joint.shape[0]), b]
    A = rigid_matrix(q, rest, at)
    turn = finite_turn(quat_log(q_next * wp.quat_inverse(q)) / drive.dt, drive.dt)
    step = (at_next - at) / drive.dt - turn * at
    lean = wp.mat44()
    if drive.tone_rate > 0.0:
        goal = wp.quat_rotate(anchor.rotation[e], command.position[e, b]) + anchor.translation[e]
        back = wp.quat_rotate(carry.rotation[e, b], gap[e, b])
        lean = rigid_matrix(anchor.rotation[e] * command.rotation[e, b], rest, goal - back) - A
    spin = bones.spin[e, b]
    velocity = bones.velocity[e, b] - wp.cross(spin, bones.center[e, b] - bones.center[e, 0])
    s = vec44()
    for i in range(3):
        for j in range(4):
            s[PLACE + 4 * i + j] = A[i, j]
            s[LEAN + 4 * i + j] = lean[i, j]
        for j in range(3):
            s[TURN + 3 * i + j] = turn[i, j]
        s[STEP + i] = step[i]
        s[VELOCITY + i] = velocity[i]
        s[SPIN + i] = spin[i]
    store_record(record, e, b, s)


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


#: Threads of a warp, which does the bones of a body, and bodies of a multiprocessor: they wait for memory and for one
#: step after the other, so the more of them, the better.
WARP, BODIES_AT_ONCE = wp.constant(32), 32
#: Warps that prepare a body, where there are so few that a multiprocessor has as many at once.
PREPARING, BODIES_PREPARED = 3, 10


def warps_of_body(device: str, bodies: int) -> int:
    """Warps that prepare each of so many bodies."""
    gpu = wp.get_device(device)
    return PREPARING if gpu.is_cuda and bodies <= BODIES_PREPARED * gpu.sm_count else 1


@wp.func
def pose_end(body: Body, drive: Drive, step: int, w: Bench, e: int, thread: int, threads: int):
    """The kinematic pose at the end of substep ``step``."""
    fraction = float(step + 1) / float(drive.num_substeps)
    pose_bones(
        body, fraction, w.start_rotation, w.start_root, w.increment, w.root_increment, e, thread, threads,
        w.after.rotation, w.after.position,
    )  # fmt: skip


@wp.func
def pose_command(body: Body, drive: Drive, step: int, w: Bench, e: int, thread: int, threads: int):
    """The commanded pose at the start of substep ``step``, if somebody asks for it."""
    if drive.tone_rate > 0.0:
        fraction = float(step) / float(drive.num_substeps)
        pose_bones(
            body, fraction, w.command.rotation, w.command.root, w.command.increment, w.root_increment, e, thread,
            threads, w.command_pose.rotation, w.command_pose.position,
        )  # fmt: skip


@wp.func
def fit_motion(body: Body, drive: Drive, step: int, sharing: int, w: Bench, e: int, thread: int, threads: int):
    """The motion of bones and body from the chunks' moments, and how far the last substep has carried them.

    ``sharing`` threads share a bone's chunks; 0: the bones have been fitted, see :func:`fit_bones`. At the beginning of
    a control step contact has carried nothing yet.
    """
    if sharing > 0:
        for b in range(thread // sharing, body.parent.shape[0], threads // sharing):
            fit_bone(body, w.tracked, w.moments, e, b, thread % sharing, sharing, w.bones)
        meet_threads(threads)
    fit_whole(body, w.bones, e, thread, threads, w.whole)
    meet_threads(threads)
    if step > 0:
        for b in range(thread, body.parent.shape[0], threads):
            carry_bone(drive.dt, w.bones, w.removed, e, b, w.carry)
        if thread == 0:
            carry_anchor(drive.dt, w.whole, w.removed, e, w.anchor)


@wp.func
def write_records(body: Body, drive: Drive, step: int, w: Bench, e: int, thread: int, threads: int):
    """All that particles blend of the bones, from their motion and both poses.

    At the beginning of a control step the command is laid on the body.
    """
    if step == 0 and drive.tone_rate > 0.0:
        lay_command(body, w.command_pose, w.now, e, thread, threads, w.anchor)
        for b in range(thread, body.parent.shape[0], threads):
            # how far bones are from where fixed offsets would put them
            w.gap[e, b] = w.tracked[e, b] - w.now.position[e, b]
    meet_threads(threads)
    for b in range(thread, body.parent.shape[0], threads):
        write_record(body, drive, w.now, w.after, w.carry, w.bones, w.command_pose, w.anchor, w.gap, e, b, w.record)


@wp.func
def hold_body(drive: Drive, step: int, mass: float, w: Bench, held: Held, e: int):
    """The root wrench of a substep."""
    fraction = float(step) / float(drive.num_substeps)
    hold_root(drive, fraction, w.command, w.now, w.carry, w.whole, mass, e, held, w.wrench)


@wp.func
def settle_removed(body: Body, drive: Drive, w: Bench, held: Held, e: int, thread: int, threads: int):
    """The rigid part of commanded motion that comes off: of a body that something holds, nothing."""
    if is_free(drive, held.let_go[e]):
        free_motion(body, drive, w.corrections, w.bones, w.whole, e, thread, threads, w.removed, w.wrench)
    elif thread == 0:  # what is left over from before would enter the carry by its round-off
        w.removed.velocity[e] = wp.vec3(0.0)
        w.removed.turn[e] = wp.mat33()
        w.removed.center[e] = wp.vec3(0.0)


@wp.func
def settle_bones(body: Body, drive: Drive, sharing: int, w: Bench, e: int, thread: int, threads: int):
    """From the chunks' corrections to what happens to the bones as a whole; 0 ``sharing``: they have been added up."""
    if sharing > 0:
        for b in range(thread // sharing, body.parent.shape[0], threads // sharing):
            add_chunks(body, w.corrections, e, b, thread % sharing, sharing, w.bone_corrections)
        meet_threads(threads)
    blend_corrections(body, drive, w.bone_corrections, w.bones, w.whole, w.wrench, e, thread, threads, w.change)


@wp.kernel
def drive_body(
    body: Body,
    drive: Drive,
    particles: Particles,
    body_mass: wp.array(dtype=float),
    step: int,
    x: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # in and out
    w: Bench,
    held: Held,
    motion: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    # out
    driven: Kinematic,
):
    """All that the drive does before substep ``step``, on a CPU, body by body."""
    e = wp.tid()
    if failure[e] != 0:
        return
    chunks = body.quarters.shape[0]
    for c in range(chunks):
        chunk_moments(body, particles, x, u, w.tracked, e, share_of(body.quarters, c, 0), w.moments)
    pose_end(body, drive, step, w, e, 0, 1)
    pose_command(body, drive, step, w, e, 0, 1)
    fit_motion(body, drive, step, 1, w, e, 0, 1)
    write_records(body, drive, step, w, e, 0, 1)
    hold_body(drive, step, body_mass[row(e, body_mass.shape[0])], w, held, e)
    free = is_free(drive, held.let_go[e])
    let_go = held.let_go[e] != 0
    center = w.bones.center[e, 0]
    for p in range(body.count):
        at = vector_at(x, e, body.first + p)
        before = vector_at(u, e, body.first + p)
        drive_particle(body, drive, at, before, w.record, center, let_go, e, p, u, motion, driven, w.pull, w.lean)
    if free:
        for c in range(chunks):
            share = share_of(body.quarters, c, 0)
            chunk_motion(body, particles, x, driven.vk, w.bones.center, e, share, w.corrections)
    settle_removed(body, drive, w, held, e, 0, 1)
    for c in range(chunks):
        share = share_of(body.quarters, c, 0)
        chunk_corrections(body, particles, x, w.bones.center, w.pull, w.lean, e, share, w.corrections)
    settle_bones(body, drive, 1, w, e, 0, 1)
    for p in range(body.count):
        at = vector_at(x, e, body.first + p)
        before = vector_at(u, e, body.first + p) + vector_at(w.pull, e, p)
        apply_correction(body, drive, at, before, center, w.change, w.removed, free, e, p, u, driven)


@wp.kernel
def fit_bones(body: Body, failure: wp.array(dtype=int), threads: int, w: Bench):
    """:func:`piavatar_envs.avatar.tracking.fit_bone` of bodies with many chunks, over ``(num_envs, bones, threads)``.

    One warp that goes from bone to bone would take longer than all else that is done for them.
    """
    e, b, thread = wp.tid()
    if failure[e] == 0:
        fit_bone(body, w.tracked, w.moments, e, b, thread, threads, w.bones)


@wp.kernel
def add_to_bones(body: Body, failure: wp.array(dtype=int), threads: int, w: Bench):
    """:func:`piavatar_envs.avatar.segment_sums.add_chunks` likewise."""
    e, b, thread = wp.tid()
    if failure[e] == 0:
        add_chunks(body, w.corrections, e, b, thread, threads, w.bone_corrections)


@wp.kernel(launch_bounds=(int(WARP) * PREPARING, BODIES_PREPARED))
def prepare_body(
    body: Body,
    drive: Drive,
    body_mass: wp.array(dtype=float),
    step: int,
    sharing: int,
    failure: wp.array(dtype=int),
    # in and out
    w: Bench,
    held: Held,
):
    """From the chunks' moments to the bones' records and the root wrench; a CUDA block has a body.

    Over ``(num_envs, threads)``, see :func:`warps_of_body`. What one warp needs not wait for in another is done at the
    same time; it is the same whether there are as many as ``PREPARING``, where bodies are few, or one.
    """
    i, _ = wp.tid()
    at = place_in_block(i, WARP)
    e = at[0]
    thread = at[1]
    threads = at[2]
    own = warp_of_block()
    warp = own[0]
    warps = own[1]
    if failure[e] != 0:
        return
    if warp == 0:
        fit_motion(body, drive, step, sharing, w, e, thread, threads)
    if warp == 1 % warps:
        pose_end(body, drive, step, w, e, thread, threads)
    if warp == 2 % warps:
        pose_command(body, drive, step, w, e, thread, threads)
    meet()
    if warp == 0:
        write_records(body, drive, step, w, e, thread, threads)
    if warp == 1 % warps and thread == 0:
        hold_body(drive, step, body_mass[row(e, body_mass.shape[0])], w, held, e)


@wp.kernel
def settle_motion(
    body: Body,
    drive: Drive,
    failure: wp.array(dtype=int),
    threads: int,
    # in and out
    w: Bench,
    held: Held,
):
    """:func:`settle_removed`, over ``(num_envs, threads)``."""
    e, thread = wp.tid()
    if failure[e] == 0:
        settle_removed(body, drive, w, held, e, thread, threads)


@wp.kernel(launch_bounds=(int(WARP), BODIES_AT_ONCE))
def settle_body(
    body: Body,
    drive: Drive,
    sharing: int,
    failure: wp.array(dtype=int),
    threads: int,
    # in and out
    w: Bench,
):
    """:func:`settle_bones`, over ``(num_envs, threads)``; a CUDA block has one."""
    e, thread = wp.tid()
    if failure[e] == 0:
        settle_bones(body, drive, sharing, w, e, thread, threads)
