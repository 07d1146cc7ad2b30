"""What there is to do for a body before an MPM substep, in stages, for one thread or for those of a CUDA block.

On a CPU one launch does all of it, a body after the other. On a GPU the passes over particles are launches of their
own, over all bodies; what there is to do for bones in between is one launch, a warp a body, or three where bodies are
few. (A block that did all of it for its body would be slower: in each pass and between them it waits for the last of
its threads.) Bones of large bodies have so many chunks that adding those up is a launch of its own.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.bone_sums import add_chunks, chunk_corrections, chunk_moments, chunk_motion
from piavatar_envs.avatar.flesh import apply_correction, blend_corrections, drive_particle
from piavatar_envs.avatar.free_motion import free_motion, is_free
from piavatar_envs.avatar.kinematics import pose_bones
from piavatar_envs.avatar.lanes import meet_threads, place_in_block, warp_of_block
from piavatar_envs.avatar.loads import vector_at
from piavatar_envs.avatar.posing import carry_anchor, carry_bone, write_record
from piavatar_envs.avatar.quarters import share_of
from piavatar_envs.avatar.rigid_fit import fit_bone, fit_whole
from piavatar_envs.avatar.root import hold_root, lay_command
from piavatar_envs.avatar.types import Bench, Body, Drive, Held
from piavatar_envs.mpm.shared_memory import meet
from piavatar_envs.mpm.types import Kinematic, Particles, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

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
    """:func:`piavatar_envs.avatar.rigid_fit.fit_bone` of bodies with many chunks, over ``(num_envs, bones, threads)``.

    One warp that goes from bone to bone would take longer than all else that is done for them.
    """
    e, b, thread = wp.tid()
    if failure[e] == 0:
        fit_bone(body, w.tracked, w.moments, e, b, thread, threads, w.bones)


@wp.kernel
def add_to_bones(body: Body, failure: wp.array(dtype=int), threads: int, w: Bench):
    """:func:`piavatar_envs.avatar.bone_sums.add_chunks` likewise."""
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
