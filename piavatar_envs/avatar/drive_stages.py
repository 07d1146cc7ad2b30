"""What there is to do for a body before an MPM substep, in stages, for one thread or for those of a CUDA block.

On a CPU one launch does all of it, a body after the other. On a GPU the passes over particles are launches of their
own, over all bodies; what there is to do for bones in between is one launch, a warp a body. (A block that did all of
it for its body would be slower: in each pass and between them it waits for the last of its threads.)
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.bone_sums import add_chunks, chunk_corrections, chunk_moments, chunk_motion
from piavatar_envs.avatar.flesh import apply_correction, blend_corrections, drive_particle
from piavatar_envs.avatar.free_motion import free_motion, is_free
from piavatar_envs.avatar.lanes import meet_threads
from piavatar_envs.avatar.loads import vector_at
from piavatar_envs.avatar.posing import carry_anchor, carry_bone, pose_bones, write_record
from piavatar_envs.avatar.rigid_fit import fit_bone, fit_whole
from piavatar_envs.avatar.root import hold_root, lay_command
from piavatar_envs.avatar.types import Bench, Body, Drive, Held
from piavatar_envs.mpm.types import Kinematic, Particles, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Threads of a warp, which does the bones of a body, and bodies of a multiprocessor: they wait for memory and for one
#: step after the other, so the more of them, the better.
WARP, BODIES_AT_ONCE = 32, 32


@wp.func
def pose_ends(body: Body, drive: Drive, step: int, w: Bench, e: int, thread: int, threads: int):
    """The kinematic pose at the end of substep ``step``, and the commanded one at its start."""
    steps = float(drive.num_substeps)
    pose_bones(
        body, float(step + 1) / steps, w.start_rotation, w.start_root, w.increment, w.root_increment,
        e, thread, threads, w.after.rotation, w.after.position,
    )  # fmt: skip
    if drive.tone_rate > 0.0:
        pose_bones(
            body, float(step) / steps, w.command.rotation, w.command.root, w.command.increment, w.root_increment,
            e, thread, threads, w.command_pose.rotation, w.command_pose.position,
        )  # fmt: skip


@wp.func
def carry_all(body: Body, drive: Drive, step: int, w: Bench, e: int, thread: int, threads: int):
    """Advance the carried bones and the laid command by the motion of the substep that has just been.

    At the beginning of a control step contact has carried nothing yet, and the command is laid on the body.
    """
    if step > 0:
        for b in range(thread, body.parent.shape[0], threads):
            carry_bone(drive.dt, w.bones, w.removed, e, b, w.carry)
        if thread == 0:
            carry_anchor(drive.dt, w.whole, w.removed, e, w.anchor)
    elif drive.tone_rate > 0.0:
        lay_command(body, w.command_pose, w.now, e, thread, threads, w.anchor)
        for b in range(thread, body.parent.shape[0], threads):
            # how far bones are from where fixed offsets would put them
            w.gap[e, b] = w.tracked[e, b] - w.now.position[e, b]


@wp.func
def prepare_bones(
    body: Body,
    drive: Drive,
    step: int,
    sharing: int,
    mass: float,
    w: Bench,
    held: Held,
    e: int,
    thread: int,
    threads: int,
):
    """From the chunks' moments to the bones' records and the root wrench; ``sharing`` threads share a bone's chunks."""
    for b in range(thread // sharing, body.parent.shape[0], threads // sharing):
        fit_bone(body, w.tracked, w.moments, e, b, thread % sharing, sharing, w.bones)
    pose_ends(body, drive, step, w, e, thread, threads)
    meet_threads(threads)
    fit_whole(body, w.bones, e, thread, threads, w.whole)
    meet_threads(threads)
    carry_all(body, drive, step, w, e, thread, threads)
    meet_threads(threads)
    for b in range(thread, body.parent.shape[0], threads):
        write_record(body, drive, w.now, w.after, w.carry, w.bones, w.command_pose, w.anchor, w.gap, e, b, w.record)
    if thread == 0:
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
    """From the chunks' corrections to what happens to the bones as a whole."""
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
    chunks = body.chunk_bone.shape[0]
    for c in range(chunks):
        chunk_moments(body, particles, x, u, w.tracked, e, c, 0, 1, w.moments)
    prepare_bones(body, drive, step, 1, body_mass[row(e, body_mass.shape[0])], w, held, e, 0, 1)
    free = is_free(drive, held.let_go[e])
    let_go = held.let_go[e] != 0
    center = w.bones.center[e, 0]
    for p in range(body.count):
        at = vector_at(x, e, body.first + p)
        before = vector_at(u, e, body.first + p)
        drive_particle(body, drive, at, before, w.record, center, let_go, e, p, u, motion, driven, w.pull, w.lean)
    if free:
        for c in range(chunks):
            chunk_motion(body, particles, x, driven.vk, w.bones.center, e, c, 0, 1, w.corrections)
    settle_removed(body, drive, w, held, e, 0, 1)
    for c in range(chunks):
        chunk_corrections(body, particles, x, w.bones.center, w.pull, w.lean, e, c, 0, 1, w.corrections)
    settle_bones(body, drive, 1, w, e, 0, 1)
    for p in range(body.count):
        at = vector_at(x, e, body.first + p)
        before = vector_at(u, e, body.first + p) + vector_at(w.pull, e, p)
        apply_correction(body, drive, at, before, center, w.change, w.removed, free, e, p, u, driven)


@wp.kernel(launch_bounds=(WARP, BODIES_AT_ONCE))
def prepare_body(
    body: Body,
    drive: Drive,
    body_mass: wp.array(dtype=float),
    step: int,
    sharing: int,
    failure: wp.array(dtype=int),
    threads: int,
    # in and out
    w: Bench,
    held: Held,
):
    """:func:`prepare_bones`, over ``(num_envs, threads)``; a CUDA block has one."""
    e, thread = wp.tid()
    if failure[e] == 0:
        prepare_bones(body, drive, step, sharing, body_mass[row(e, body_mass.shape[0])], w, held, e, thread, threads)


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


@wp.kernel(launch_bounds=(WARP, BODIES_AT_ONCE))
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
