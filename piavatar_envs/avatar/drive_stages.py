"""What there is to do for a body before an MPM substep, in stages, for one thread or for those of a CUDA block.

On a CPU one launch does all of it, a body after the other. On a GPU the passes over particles are launches of their
own, over all bodies; what there is to do for bones in between is one launch, a block a body. (A block that did all of
it for its body would be slower: in each pass and between them it waits for the last of its threads.)
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.bone_sums import add_chunks, chunk_corrections, chunk_moments, chunk_motion
from piavatar_envs.avatar.flesh import apply_correction, blend_corrections, drive_particle
from piavatar_envs.avatar.free_motion import free_motion, is_free
from piavatar_envs.avatar.lanes import meet_threads
from piavatar_envs.avatar.posing import carry_anchor, carry_bone, pose_bones, write_record
from piavatar_envs.avatar.rigid_fit import fit_bone, fit_whole
from piavatar_envs.avatar.root import hold_root, lay_command
from piavatar_envs.avatar.types import Bench, Body, Drive, Held
from piavatar_envs.mpm.shared_memory import meet
from piavatar_envs.mpm.types import Kinematic, Particles, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Threads of a warp.
WARP = wp.constant(32)
#: Threads of a CUDA block that does the bones of a body, and blocks of a multiprocessor: they wait for memory and for
#: one step after the other, so the more of them, the better.
BONE_THREADS, BODIES_AT_ONCE = 32, 32


@wp.func
def pose_ends(body: Body, drive: Drive, step: int, w: Bench, e: int, warp: int, warps: int, lane: int, lanes: int):
    """The kinematic pose at the end of substep ``step``, by one warp, and the commanded one at its start by another."""
    steps = float(drive.num_substeps)
    if warp == 1 % warps:
        pose_bones(
            body, float(step + 1) / steps, w.start_rotation, w.start_root, w.increment, w.root_increment,
            e, lane, lanes, w.after.rotation, w.after.position,
        )  # fmt: skip
    if warp == 2 % warps and drive.tone_rate > 0.0:
        pose_bones(
            body, float(step) / steps, w.command.rotation, w.command.root, w.command.increment, w.root_increment,
            e, lane, lanes, w.command_pose.rotation, w.command_pose.position,
        )  # fmt: skip


@wp.func
def carry_all(body: Body, drive: Drive, step: int, w: Bench, e: int, lane: int, lanes: int):
    """Advance the carried bones and the laid command by the motion of the substep that has just been.

    At the beginning of a control step contact has carried nothing yet, and the command is laid on the body.
    """
    if step > 0:
        for b in range(lane, body.parent.shape[0], lanes):
            carry_bone(drive.dt, w.bones, w.removed, e, b, w.carry)
        if lane == 0:
            carry_anchor(drive.dt, w.whole, w.removed, e, w.anchor)
    elif drive.tone_rate > 0.0:
        lay_command(body, w.command_pose, w.now, e, lane, lanes, w.anchor)
        for b in range(lane, body.parent.shape[0], lanes):
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
    lanes = wp.min(threads, WARP)
    warp = thread // lanes
    warps = threads // lanes
    lane = thread - warp * lanes
    for b in range(thread // sharing, body.parent.shape[0], threads // sharing):
        fit_bone(body, w.tracked, w.moments, e, b, thread % sharing, sharing, w.bones)
    pose_ends(body, drive, step, w, e, warp, warps, lane, lanes)
    meet()
    if warp == 0:
        fit_whole(body, w.bones, e, lane, lanes, w.whole)
        meet_threads(lanes)
        carry_all(body, drive, step, w, e, lane, lanes)
    meet()
    if warp == 0:
        for b in range(lane, body.parent.shape[0], lanes):
            write_record(
                body, drive, w.now, w.after, w.carry, w.bones, w.command_pose, w.anchor, w.gap, e, b, w.record
            )  # fmt: skip
    if warp == 1 % warps and lane == 0:
        fraction = float(step) / float(drive.num_substeps)
        hold_root(drive, fraction, w.command, w.now, w.carry, w.whole, mass, e, held, w.wrench)


@wp.func
def settle_removed(body: Body, drive: Drive, w: Bench, held: Held, e: int, lane: int, lanes: int):
    """The rigid part of commanded motion that comes off: of a body that something holds, nothing."""
    if is_free(drive, held.let_go[e]):
        free_motion(body, drive, w.corrections, w.bones, w.whole, e, lane, lanes, w.removed, w.wrench)
    elif lane == 0:  # what is left over from before would enter the carry by its round-off
        w.removed.velocity[e] = wp.vec3(0.0)
        w.removed.turn[e] = wp.mat33()
        w.removed.center[e] = wp.vec3(0.0)


@wp.func
def settle_bones(body: Body, drive: Drive, sharing: int, w: Bench, e: int, thread: int, threads: int):
    """From the chunks' corrections to what happens to the bones as a whole."""
    for b in range(thread // sharing, body.parent.shape[0], threads // sharing):
        add_chunks(body, w.corrections, e, b, thread % sharing, sharing, w.bone_corrections)
    meet()
    lanes = wp.min(threads, WARP)
    if thread < lanes:
        blend_corrections(body, drive, w.bone_corrections, w.bones, w.whole, w.wrench, e, thread, lanes, w.change)


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
    """All that the drive does before substep ``step``, on a CPU, body by body; pulls need one row."""
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
        drive_particle(body, drive, x, w.record, center, let_go, e, p, 0, u, motion, driven, w.pull, w.lean)
    if free:
        for c in range(chunks):
            chunk_motion(body, particles, x, driven.vk, w.bones.center, e, c, 0, 1, w.corrections)
    settle_removed(body, drive, w, held, e, 0, 1)
    for c in range(chunks):
        chunk_corrections(body, particles, x, w.bones.center, w.pull, w.lean, e, c, 0, 0, 1, w.corrections)
    settle_bones(body, drive, 1, w, e, 0, 1)
    for p in range(body.count):
        apply_correction(body, drive, x, w.pull, center, w.change, w.removed, free, e, p, 0, u, driven)


@wp.kernel(launch_bounds=(BONE_THREADS, BODIES_AT_ONCE))
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
    """:func:`settle_removed` of a large body, by a warp, over ``(num_envs, threads)``."""
    e, thread = wp.tid()
    if failure[e] == 0:
        settle_removed(body, drive, w, held, e, thread, threads)


@wp.kernel(launch_bounds=(BONE_THREADS, BODIES_AT_ONCE))
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
