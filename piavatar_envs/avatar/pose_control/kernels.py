"""One substep of the pose controller, before the MPM substep: from the particles' moments to their new velocities.

In order: fit rigid motions to the physical velocity, pose the bones and carry them by these motions, hold the root,
write the kinematic velocity of every particle and pull its shape and pose, take the rigid part out of the commanded
motion of unsupported bodies, return the momentum of the pulls to the bones, and move the whole by the root's force.

Two critically damped pulls act on the physical velocity, both implicit in time and both without net momentum:

- *shape preservation* (``alpha``): of a particle towards its skinned place on the carried bones. It acts only on the
  motion relative to the bones, and its momentum is returned bone by bone.
- *tone*: of the bones towards the commanded pose, relative to the body's own rigid motion. A body of tone 0 yields and
  keeps its bent joints; a body of tone 1 recoils and returns.

On a CPU :func:`command_body` runs all stages, one body after the other. On a GPU the passes over particles are
launches of their own, because a CUDA block that ran all stages would wait in each pass for its last thread; the work on
bones between them is a launch with one warp a body, or three where bodies are few. Bones of large bodies have so many
chunks that their sum is a launch of its own.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.controller import implicit_velocity, pull_denominator, pull_gain
from piavatar_envs.avatar.correctives import corrected_rest, correction_rate
from piavatar_envs.avatar.kinematics import pose_bones
from piavatar_envs.avatar.pose_control.bones import carry_anchor, carry_bone, write_record
from piavatar_envs.avatar.pose_control.root import axial, free_motion, hold_root, is_free, lay_command, root_change
from piavatar_envs.avatar.segment_sums import (
    add_chunks,
    chunk_corrections,
    chunk_moments,
    chunk_motion,
    share_of,
)
from piavatar_envs.avatar.skinning import (
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
from piavatar_envs.avatar.tracking import fit_bone, fit_whole, spin_of
from piavatar_envs.avatar.types import (
    Body,
    PoseControl,
    PoseWorkspace,
    RemovedMotion,
    RigidFit,
    RigidFits,
    RootState,
    Wrench,
    vec44,
)
from piavatar_envs.core.arrays import number_at, store_pair, store_vector, vec8, vec12, vector_at
from piavatar_envs.core.cuda_intrinsics import (
    BLOCK,
    first_particle,
    place_in_block,
    sum_threads12,
    sync_block,
    sync_threads,
    threads_of_environment,
    warp_of_block,
)
from piavatar_envs.mpm.types import Kinematic, Particles, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


#: Threads of a warp, which handles the bones of a body.
WARP = wp.constant(32)
#: Resident bodies of a multiprocessor: many, because their warps mostly wait for memory.
BODIES_AT_ONCE = 32
#: Warps that prepare a body, and the number of bodies a multiprocessor up to which each body has so many.
PREPARING, BODIES_PREPARED = 3, 10


def warps_of_body(device: str, bodies: int) -> int:
    """Return the number of warps that prepare each of ``bodies`` bodies."""
    gpu = wp.get_device(device)
    return PREPARING if gpu.is_cuda and bodies <= BODIES_PREPARED * gpu.sm_count else 1


@wp.kernel
def command_body(
    body: Body,
    control: PoseControl,
    shape_rates: wp.array(dtype=wp.vec2),
    particles: Particles,
    body_mass: wp.array(dtype=float),
    step: int,
    x: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # in and out
    w: PoseWorkspace,
    root: RootState,
    motion: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    # out
    kinematic: Kinematic,
):
    """Run all stages before MPM substep ``step`` on a CPU, over ``num_envs``."""
    e = wp.tid()
    if failure[e] != 0:
        return
    chunks = body.quarters.shape[0]
    for c in range(chunks):
        chunk_moments(body, particles, x, u, w.tracked, e, share_of(body.quarters, c, 0), w.moments)
    pose_end(body, control, step, w, e, 0, 1)
    pose_command(body, control, step, w, e, 0, 1)
    fit_motion(body, control, step, 1, w, e, 0, 1)
    write_records(body, control, step, w, e, 0, 1)
    hold_body(control, step, body_mass[row(e, body_mass.shape[0])], w, root, e)
    free = is_free(control, root.released[e])
    released = root.released[e] != 0
    center = w.bones.center[e, 0]
    elapsed = float(step) / float(control.num_substeps)
    for p in range(body.count):
        at = vector_at(x, e, body.first + p)
        before = vector_at(u, e, body.first + p)
        command_particle(
            body, control, shape_rates, at, before, w.record, w.load, center, released, elapsed, e, p, u, motion,
            kinematic, w.pull, w.lean, w.jump,
        )  # fmt: skip
    if free:
        for c in range(chunks):
            share = share_of(body.quarters, c, 0)
            chunk_motion(body, particles, x, kinematic.vk, w.bones.center, e, share, w.corrections)
    remove_motion(body, control, w, root, e, 0, 1)
    for c in range(chunks):
        share = share_of(body.quarters, c, 0)
        chunk_corrections(body, particles, x, w.bones.center, w.pull, w.lean, w.jump, e, share, w.corrections, w.jumps)
    correct_bones(body, control, 1, w, root, e, 0, 1)
    for p in range(body.count):
        at = vector_at(x, e, body.first + p)
        before = vector_at(u, e, body.first + p) + vector_at(w.pull, e, p)
        apply_correction(body, control, at, before, center, w.change, w.removed, free, e, p, u, kinematic)


@wp.func
def pose_end(body: Body, control: PoseControl, step: int, w: PoseWorkspace, e: int, thread: int, threads: int):
    """Pose the bones for the end of substep ``step``."""
    fraction = float(step + 1) / float(control.num_substeps)
    pose_bones(
        body, fraction, w.start_rotation, w.start_root, w.increment, w.root_increment, e, thread, threads,
        w.after.rotation, w.after.position,
    )  # fmt: skip


@wp.func
def pose_command(body: Body, control: PoseControl, step: int, w: PoseWorkspace, e: int, thread: int, threads: int):
    """Pose the bones as commanded at the start of substep ``step``, if tone is on."""
    if control.tone_rate > 0.0:
        fraction = float(step) / float(control.num_substeps)
        pose_bones(
            body, fraction, w.command.rotation, w.command.root, w.command.increment, w.root_increment, e, thread,
            threads, w.command_pose.rotation, w.command_pose.position,
        )  # fmt: skip


@wp.kernel
def fit_bones(body: Body, failure: wp.array(dtype=int), threads: int, w: PoseWorkspace):
    """Fit the rigid motion of every bone of bodies with many chunks, over ``(num_envs, bones, threads)``."""
    e, b, thread = wp.tid()
    if failure[e] == 0:
        fit_bone(body, w.tracked, w.moments, e, b, thread, threads, w.bones)


@wp.func
def fit_motion(
    body: Body, control: PoseControl, step: int, chunk_threads: int, w: PoseWorkspace, e: int, thread: int, threads: int
):
    """Fit the motion of bones and body from the chunks' moments, and carry them by the last substep's motion.

    ``chunk_threads`` threads share a bone's chunks; 0: the bones have been fitted, see :func:`fit_bones`. At the
    beginning of a control step contact has carried nothing yet.
    """
    if chunk_threads > 0:
        for b in range(thread // chunk_threads, body.parent.shape[0], threads // chunk_threads):
            fit_bone(body, w.tracked, w.moments, e, b, thread % chunk_threads, chunk_threads, w.bones)
        sync_threads(threads)
    fit_whole(body, w.bones, e, thread, threads, w.whole)
    sync_threads(threads)
    if step > 0:
        for b in range(thread, body.parent.shape[0], threads):
            carry_bone(control.dt, w.bones, w.removed, e, b, w.carry)
        if thread == 0:
            carry_anchor(control.dt, w.whole, w.removed, e, w.anchor)


@wp.func
def write_records(body: Body, control: PoseControl, step: int, w: PoseWorkspace, e: int, thread: int, threads: int):
    """Write the records that particles blend, from the bones' motion and both poses.

    At the beginning of a control step the command is aligned with the body.
    """
    if step == 0 and control.tone_rate > 0.0:
        lay_command(body, w.command_pose, w.now, e, thread, threads, w.anchor)
        for b in range(thread, body.parent.shape[0], threads):
            w.gap[e, b] = w.tracked[e, b] - w.now.position[e, b]
    sync_threads(threads)
    for b in range(thread, body.parent.shape[0], threads):
        write_record(body, control, w.now, w.after, w.carry, w.bones, w.command_pose, w.anchor, w.gap, e, b, w.record)


@wp.func
def hold_body(control: PoseControl, step: int, mass: float, w: PoseWorkspace, root: RootState, e: int):
    """Compute the root wrench of a substep."""
    fraction = float(step) / float(control.num_substeps)
    hold_root(control, fraction, w.command, w.now, w.carry, w.whole, mass, e, root, w.wrench)


@wp.kernel(launch_bounds=(int(WARP) * PREPARING, BODIES_PREPARED))
def prepare_body(
    body: Body,
    control: PoseControl,
    body_mass: wp.array(dtype=float),
    step: int,
    chunk_threads: int,
    failure: wp.array(dtype=int),
    # in and out
    w: PoseWorkspace,
    root: RootState,
):
    """Compute the bones' records and the root wrench from the chunks' moments, with a CUDA block a body.

    Over ``(num_envs, threads)``, see :func:`warps_of_body`. Independent steps run in different warps; the result does
    not depend on their number.
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
        fit_motion(body, control, step, chunk_threads, w, e, thread, threads)
    if warp == 1 % warps:
        pose_end(body, control, step, w, e, thread, threads)
    if warp == 2 % warps:
        pose_command(body, control, step, w, e, thread, threads)
    sync_block()
    if warp == 0:
        write_records(body, control, step, w, e, thread, threads)
    if warp == 1 % warps and thread == 0:
        hold_body(control, step, body_mass[row(e, body_mass.shape[0])], w, root, e)


@wp.func
def rates_of_shape(control: PoseControl, shape_rates: wp.array(dtype=wp.vec2), p: int):
    """Return a particle's rates of physical and of kinematic shape preservation [1/s], its own if there are such."""
    if shape_rates.shape[0] > 0:
        return shape_rates[p]
    return wp.vec2(control.shape_rate, control.kinematic_shape_rate)


@wp.func
def command_particle(
    body: Body,
    control: PoseControl,
    shape_rates: wp.array(dtype=wp.vec2),
    at: wp.vec3,
    before: wp.vec3,
    record: wp.array2d(dtype=vec44),
    load: wp.array(dtype=float),
    center: wp.vec3,
    released: bool,
    elapsed: float,
    e: int,
    p: int,
    # in and out
    u: wp.array2d(dtype=wp.vec3),
    motion: wp.array2d(dtype=wp.vec3),
    # out
    kinematic: Kinematic,
    pull: wp.array2d(dtype=wp.vec3),
    lean: wp.array2d(dtype=wp.vec3),
    jump: wp.array2d(dtype=wp.vec3),
):
    """Write the kinematic velocity of a particle, and what acts on its physical velocity.

    That is its pull [m/s] and its displacement to the commanded pose [m]. If a root may be held, ``jump`` gets the
    change of its velocity as commanded [m/s].

    ``vk = (LBS(G T_{s+1}) - LBS(G T_s)) / dt + (dR - I)(x - LBS(G T_s)) / dt``: the second term turns the displacement
    that contact has caused along with the bone. The rest pose is that when a share ``elapsed`` of the control step is
    over. Flesh with a velocity lag misses its share of every change of that velocity. ``at`` is the particle's position
    and ``before`` its velocity; the bones' blended velocity is that at ``center``, the pelvis'.
    """
    velocity_lag = number_at(body.velocity_lag, row(e, body.velocity_lag.shape[0]), p)
    rest = corrected_rest(body, elapsed, e, p)
    rate = correction_rate(body, 1.0 / control.control_dt, e, p)
    s = blend_records(record, e, body.skin, p, rest, rate, control.dt)
    displacement = at - blended_vector(s, AT_PLACE)
    turn = blended_turn(s)
    k = blended_vector(s, AT_STEP) + turn * displacement
    # the paper's shape preservation is part of the prescribed velocity
    rates = rates_of_shape(control, shape_rates, p)
    k -= rates[1] * displacement
    relative = before - blended_velocity(s, at - center)
    pulled = implicit_velocity(rates[0], control.dt, -displacement, relative) - relative
    way = blended_vector(s, AT_LEAN)
    change = wp.vec3()
    if control.root_rate > 0.0:
        change = k - vector_at(kinematic.vk, e, body.first + p)
    if velocity_lag > 0.0:
        # a body that nothing supports could not take the reaction
        if control.free_motion == 0 and not released:
            missed = velocity_lag * (k - motion[e, p])
            u[e, body.first + p] = before - missed
            change -= missed
        motion[e, p] = k
    pulled += pull_gain(control.tone_rate, control.dt) * way
    if load.shape[0] > 0 and not released:
        pulled += (control.dt * load[p]) * control.gravity
    store_pair(kinematic.vk, kinematic.spin, e, body.first + p, k, -0.5 * axial(turn), True, True)
    store_pair(pull, lean, e, p, pulled, way, control.tone_rate > 0.0, True)
    if control.root_rate > 0.0:
        store_vector(jump, e, p, change, True)


@wp.kernel(launch_bounds=(BLOCK, 6))
def command_particles(
    body: Body,
    control: PoseControl,
    shape_rates: wp.array(dtype=wp.vec2),
    x: wp.array2d(dtype=wp.vec3),
    record: wp.array2d(dtype=vec44),
    load: wp.array(dtype=float),
    bones: RigidFits,
    released: wp.array(dtype=int),
    elapsed: float,
    failure: wp.array(dtype=int),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
    motion: wp.array2d(dtype=wp.vec3),
    # out
    kinematic: Kinematic,
    pull: wp.array2d(dtype=wp.vec3),
    lean: wp.array2d(dtype=wp.vec3),
    jump: wp.array2d(dtype=wp.vec3),
):
    """Run :func:`command_particle` for every particle, over ``(num_envs, particle_threads)``."""
    i, _ = wp.tid()
    threads = threads_of_environment(x.shape[0])
    own = first_particle(i, threads)
    e = own[0]
    if failure[e] != 0:
        return
    p = own[1]
    last = body.count - 1
    center = bones.center[e, 0]
    gone = released[e] != 0
    n = wp.min(p, last)
    following = vector_at(x, e, body.first + n)
    following_u = vector_at(u, e, body.first + n)
    while p < body.count:
        at = following
        before = following_u
        n = wp.min(p + threads, last)
        following = vector_at(x, e, body.first + n)
        following_u = vector_at(u, e, body.first + n)
        command_particle(
            body, control, shape_rates, at, before, record, load, center, gone, elapsed, e, p, u, motion, kinematic,
            pull, lean, jump,
        )  # fmt: skip
        p += threads


@wp.func
def remove_motion(
    body: Body, control: PoseControl, w: PoseWorkspace, root: RootState, e: int, thread: int, threads: int
):
    """Compute the rigid part that is subtracted from commanded motion; zero for a supported body."""
    if is_free(control, root.released[e]):
        free_motion(body, control, w.corrections, w.bones, w.whole, e, thread, threads, w.removed)
    elif thread == 0:  # an earlier value would enter the carry
        w.removed.velocity[e] = wp.vec3(0.0)
        w.removed.turn[e] = wp.mat33()
        w.removed.center[e] = wp.vec3(0.0)
        w.removed.turning[e] = wp.vec3(0.0)
        w.removed.acceleration[e] = wp.vec3(0.0)


@wp.kernel
def remove_motions(
    body: Body,
    control: PoseControl,
    failure: wp.array(dtype=int),
    threads: int,
    # in and out
    w: PoseWorkspace,
    root: RootState,
):
    """Run :func:`remove_motion`, over ``(num_envs, threads)``."""
    e, thread = wp.tid()
    if failure[e] == 0:
        remove_motion(body, control, w, root, e, thread, threads)


@wp.kernel
def add_to_bones(body: Body, failure: wp.array(dtype=int), threads: int, w: PoseWorkspace):
    """Sum the corrections of bodies with many chunks, over ``(num_envs, bones, threads)``."""
    e, b, thread = wp.tid()
    if failure[e] == 0:
        add_chunks(body, w.corrections, e, b, thread, threads, w.bone_corrections)


@wp.func
def bone_change(velocity: wp.vec3, spin: wp.vec3, arm: wp.vec3):
    """Return a change of rigid motion with the velocity at the pelvis' centre, ``arm`` from that of ``velocity``."""
    v = velocity + wp.cross(spin, arm)
    return vec8(v[0], v[1], v[2], spin[0], spin[1], spin[2], 0.0, 0.0)


@wp.func
def blend_corrections(
    body: Body,
    control: PoseControl,
    corrections: wp.array2d(dtype=vec12),
    jumps: wp.array2d(dtype=vec8),
    bones: RigidFits,
    whole: RigidFit,
    removed: RemovedMotion,
    e: int,
    thread: int,
    threads: int,
    # in and out
    wrench: Wrench,
    root: RootState,
    # out
    change: wp.array2d(dtype=vec8),
):
    """Compute the change of every bone's rigid motion.

    It returns the momentum of the shape pull, and adds tone, damping of motion between bones and the root wrench.
    """
    r = row(e, body.bone_mass.shape[0])
    dt = control.dt
    gain = pull_gain(control.tone_rate, dt)
    keep = 1.0 / pull_denominator(control.tone_rate, dt) - 1.0 + (wp.exp(-control.damping * dt) - 1.0)
    m = float(0.0)
    P = wp.vec3()
    L = wp.vec3()
    for b in range(thread, body.parent.shape[0], threads):
        s = corrections[e, b]
        p1 = wp.vec3(s[0], s[1], s[2])
        l1 = wp.vec3(s[3], s[4], s[5])
        arm = bones.center[e, b] - whole.center[e]
        mass = wp.max(body.bone_mass[r, b], 1.0e-12)
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
    # these changes are internal, so their rigid part is subtracted; only the root moves the whole body
    V, W = root_change(body, control, total[0], jumps, bones, removed, whole, e, thread, threads, wrench, root)
    V -= wp.vec3(total[1], total[2], total[3]) / total[0]
    W -= spin_of(whole.inertia[e], wp.vec3(total[4], total[5], total[6]))
    rigid = bone_change(V, W, bones.center[e, 0] - whole.center[e])
    for b in range(thread, body.parent.shape[0], threads):
        change[e, b] = change[e, b] + rigid


@wp.func
def correct_bones(
    body: Body,
    control: PoseControl,
    chunk_threads: int,
    w: PoseWorkspace,
    root: RootState,
    e: int,
    thread: int,
    threads: int,
):
    """Compute the change of the bones' motion from the chunks' corrections; 0 ``chunk_threads``: already summed."""
    if chunk_threads > 0:
        for b in range(thread // chunk_threads, body.parent.shape[0], threads // chunk_threads):
            add_chunks(body, w.corrections, e, b, thread % chunk_threads, chunk_threads, w.bone_corrections)
        sync_threads(threads)
    blend_corrections(
        body, control, w.bone_corrections, w.jumps, w.bones, w.whole, w.removed, e, thread, threads, w.wrench, root,
        w.change,
    )  # fmt: skip


@wp.kernel(launch_bounds=(int(WARP), BODIES_AT_ONCE))
def correct_body(
    body: Body,
    control: PoseControl,
    chunk_threads: int,
    failure: wp.array(dtype=int),
    threads: int,
    # in and out
    w: PoseWorkspace,
    root: RootState,
):
    """Run :func:`correct_bones`, over ``(num_envs, threads)``, with a CUDA block a body."""
    e, thread = wp.tid()
    if failure[e] == 0:
        correct_bones(body, control, chunk_threads, w, root, e, thread, threads)


@wp.func
def apply_correction(
    body: Body,
    control: PoseControl,
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
    kinematic: Kinematic,
):
    """Change the physical velocity by the pull and the bones' blended field.

    ``at`` is the particle's position, ``before`` its velocity with the pull. Where the body is ``free``, the rigid part
    of its commanded motion comes off.
    """
    field = motion_at(blend_changes(change, e, body.skin, p), at - center)
    store_vector(u, e, body.first + p, before + field, True)
    if free:
        v = vector_at(kinematic.vk, e, body.first + p) - removed.velocity[e]
        v += removed.turn[e] * (at - removed.center[e] + control.dt * v)
        store_vector(kinematic.vk, e, body.first + p, v, True)
        # half the curl of this velocity, in which the turns are composed, not added
        w = kinematic.spin[e, body.first + p]
        back = -0.5 * axial(removed.turn[e])
        kinematic.spin[e, body.first + p] = w + back + (0.5 * control.dt) * wp.cross(back, w)


@wp.kernel(launch_bounds=(BLOCK, 10))
def apply_corrections(
    body: Body,
    control: PoseControl,
    x: wp.array2d(dtype=wp.vec3),
    pull: wp.array2d(dtype=wp.vec3),
    bones: RigidFits,
    change: wp.array2d(dtype=vec8),
    removed: RemovedMotion,
    released: wp.array(dtype=int),
    failure: wp.array(dtype=int),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
    kinematic: Kinematic,
):
    """Run :func:`apply_correction` for every particle, over ``(num_envs, particle_threads)``."""
    i, _ = wp.tid()
    threads = threads_of_environment(x.shape[0])
    own = first_particle(i, threads)
    e = own[0]
    if failure[e] != 0:
        return
    free = is_free(control, released[e])
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
        apply_correction(body, control, at, before, center, change, removed, free, e, p, u, kinematic)
        p += threads
