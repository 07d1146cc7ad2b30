"""Stages of the torque controller between two passes over particles, one launch each.

On a GPU an environment has a CUDA block: four warps build the mass matrix, then two of them factorize it, one matrix
each; one warp runs all other stages, because a launch for a few microseconds of work costs more than the work. On a CPU
one thread runs a stage.

There are four right-hand sides: momentum of the pull, momentum of the remaining physical velocity, bias forces, and
displacements of particles from their places. There are two factors of the mass matrix: one with locked joints and the
added inertia of the projection, one with locked joints and everything implicit. Those of a kind are in one array: the
first of all environments, then the second, and so on.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.rotation import rigid_matrix
from piavatar_envs.avatar.torque_control.bone_contact import TRIPLES, Ground, add_to_sensors, measure_bones, stop_bones
from piavatar_envs.avatar.torque_control.joint_momentum import (
    add_change,
    balance,
    bias_forces,
    expect_half,
    gather_sums,
    pass_down,
    predict_velocity,
)
from piavatar_envs.avatar.torque_control.joint_motion import move_joints, set_triple, spread_motion, triple_of
from piavatar_envs.avatar.torque_control.joint_stops import (
    finish_stops,
    hold_joint,
    joint_inertia,
    release_joints,
    stay_in_range,
)
from piavatar_envs.avatar.torque_control.joint_tissue import Tissue, bend_of
from piavatar_envs.avatar.torque_control.joint_torques import (
    Springs,
    Strength,
    Target,
    final_impulses,
    implicit_diagonal,
    joint_impulse,
    limit_torque,
)
from piavatar_envs.avatar.torque_control.mass_matrix import BONES, PLACES, Pairs, compose_mass, record_arena
from piavatar_envs.avatar.torque_control.tree_cholesky import (
    ARENA_WORDS,
    add_blocks,
    factorize,
    factorize_in_arena,
    load_arena,
    load_factor,
    place_of_factor,
    solve,
    solve_four_in_place,
    store_arena,
    store_factor,
)
from piavatar_envs.avatar.torque_control.workspace import (
    TorqueWorkspace,
    load_positions,
    load_workspace,
    row_in_arena,
    store_motion,
    store_spin,
    store_workspace,
    view_vectors,
    warp_arena,
)
from piavatar_envs.avatar.types import Body, Pose
from piavatar_envs.core.arrays import vec8
from piavatar_envs.core.cuda_intrinsics import place_in_block, sum_threads, sync_block, sync_threads
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

WARP = wp.constant(32)
#: Threads that build a mass matrix: all compose it, then two warps compute a factor each.
MASS_BLOCK = wp.constant(128)
_ARENA_WORDS = wp.constant(ARENA_WORDS)
#: Most repeated solutions in a substep: a muscle at its limit changes the load of the others.
MOST_CUTS = wp.constant(8)
#: Repeated solutions in which a joint may be held again after it was released.
_FREE_CUTS = wp.constant(2)
#: Share of the deviation between pose and particles that one fit removes. Particles of fast, light joints (head, hands)
#: also deviate for other reasons, so that following them at once would destabilise these joints.
FIT_SHARE = 0.2
_FIT_SHARE = wp.constant(FIT_SHARE)


@wp.struct
class Support:
    """Force and torque of the pelvis springs on the body, summed over substeps; ``(num_envs,)``."""

    force: wp.array(dtype=wp.vec3)  # [N], once a control step that began with zero is complete
    torque: wp.array(dtype=wp.vec3)  # [N m]


@wp.func
def place_bones(
    body: Body,
    pose: Pose,
    origin: wp.vec3,
    e: int,
    thread: int,
    threads: int,
    # out
    place: wp.array2d(dtype=wp.mat44),
):
    """Write the matrices that take the bones from rest to their places in ``pose``, relative to ``origin`` [m]."""
    r = row(e, body.rest_joint.shape[0])
    for b in range(thread, BONES, threads):
        place[e, b] = rigid_matrix(pose.rotation[e, b], body.rest_joint[r, b], pose.position[e, b] - origin)


@wp.func
def begin(body: Body, e: int, thread: int, threads: int, w: TorqueWorkspace):
    """Compute motion and places of the bones for the passes over particles."""
    spread_motion(body, w.pose.position, w.velocity, e, e, thread, threads, w.moving)
    place_bones(body, w.pose, w.pose.position[e, 0], e, thread, threads, w.place)


@wp.func
def find_shares(
    body: Body, own: int, step: int, rows: int, e: int, thread: int, threads: int, arena: wp.uint64, w: TorqueWorkspace
):
    """Solve for the shares ``dq = M^-1 J^T m v`` of several velocities, from the bones' momenta.

    The share of the first velocity is in row ``own``, the others follow ``step`` rows apart: all four in a warp, a
    single thread passes down ``rows`` of them.
    """
    pass_down(body, w.pose.position, e, rows, own, step, threads, w.linear, w.angular, w.shares)
    load_factor(w.factors, e, arena)
    solve_four_in_place(w.pattern, w.factors, e, own, step, threads, arena, w.shares)


@wp.func
def advance_pose(
    body: Body, dt: float, tissue: Tissue, move: int, off: int, e: int, thread: int, threads: int, w: TorqueWorkspace
):
    """Advance the pose by half a substep (moves 0 and 1), or fit it to the particles (move 2).

    The fit is a share of ``dq = M^-1 J^T m way``, with the displacements ``way`` from particles to their places, in row
    ``off``. They are those of the beginning of the substep; since then particles have moved with the joints. All moves
    share one piece of code, to fetch fewer instructions.
    """
    time = 0.5 * dt
    if move < 2:
        spread_motion(body, w.pose.position, w.velocity, e, e, thread, threads, w.moving)
    else:
        time = -_FIT_SHARE
        for b in range(1 + thread, BONES, threads):
            stay_in_range(body, time, w.pose, tissue, off, e, b, w.shares)
        spread_motion(body, w.pose.position, w.shares, off, e, thread, threads, w.moving)
    if move == 1:
        store_spin(w.moving, e, thread, threads, w.steps)
    move_joints(body, time, w.moving, e, thread, threads, w.pose.rotation, w.pose.position)
    if move == 1:
        place_bones(body, w.pose, w.pelvis[e], e, thread, threads, w.end)


@wp.func
def pull_bones(body: Body, own: int, e: int, thread: int, threads: int, w: TorqueWorkspace):
    """Add the reaction of the flesh's pull to the joints, with exactly the momentum that particles have lost."""
    spread_motion(body, w.pose.position, w.shares, own, e, thread, threads, w.moving)
    none = wp.vec3(0.0)
    balance(w.pose.position, w.bones, 1.0, none, none, w.moving, e, own, thread, threads, w.shares)
    add_change(w.shares, own, e, thread, threads, w.velocity, w.outside)


@wp.func
def bend_joints(body: Body, e: int, thread: int, threads: int, w: TorqueWorkspace):
    """Compute the rotation vectors of all joints."""
    for b in range(thread, BONES, threads):
        w.bend[e, b] = bend_of(body, w.pose, e, b)
    sync_block()


@wp.func
def limit_joints(
    body: Body,
    dt: float,
    springs: Springs,
    tissue: Tissue,
    strength: Strength,
    driven: int,
    own: int,
    cuts: int,
    e: int,
    thread: int,
    threads: int,
    w: TorqueWorkspace,
) -> float:
    """Limit the impulses of the muscles at share ``own``, and hold joints at the ends of their ranges.

    Returns to all threads the number of joints for which either has changed. After the first of the repeated
    solutions, ``cuts``, muscles already limited are skipped.
    """
    changed = float(0.0)
    final = cuts >= _FREE_CUTS
    for k in range(thread, TRIPLES, threads):
        rest = w.diagonals[driven, 3 * k]
        changed += limit_torque(
            body, dt, w.pose, springs, strength, w.muscle, rest, w.shares, own, cuts > 0, e, k, w.impulse, w.left
        )  # fmt: skip
        if k > 1 and tissue.lock[wp.max(k - 1, 0)] == 0.0:
            inertia = joint_inertia(w.pattern, w.matrix, w.left[e, 3 * k], e, k)
            changed += hold_joint(
                body, dt, w.pose, tissue, inertia, w.velocity, w.outside, w.shares, own, final, e, k - 1, w.stops,
                w.impulse,
            )  # fmt: skip
    sync_threads(threads)
    return sum_threads(changed, threads)


@wp.func
def push_of(w: TorqueWorkspace, e: int, k: int):
    """Return triple ``k`` of the impulses by external forces; 0 is the pelvis' position."""
    push = wp.vec3()
    if w.push.shape[0] > 0:
        push = triple_of(w.push, e, 3 * k)
    return push


@wp.func
def apply_torques(
    body: Body,
    dt: float,
    target: Target,
    springs: Springs,
    tissue: Tissue,
    strength: Strength,
    ground: Ground,
    driven: int,
    own: int,
    e: int,
    thread: int,
    threads: int,
    arena: wp.uint64,
    w: TorqueWorkspace,
):
    """Solve for the velocity change by springs, torques, tissue, contact and external forces: share ``own``.

    ``driven`` is the factor of the mass matrix with everything implicit. ``impulse`` is left without external forces.
    """
    sync_threads(threads)
    bend_joints(body, e, thread, threads, w)
    for k in range(thread, TRIPLES, threads):
        joint_impulse(
            body,
            dt,
            w.pose,
            target,
            springs,
            tissue,
            w.bend,
            w.tissue,
            w.velocity,
            w.outside,
            e,
            k,
            w.muscle,
            w.impulse,
        )
        set_triple(w.impulse, e, 3 * k, triple_of(w.impulse, e, 3 * k) + push_of(w, e, k))
    release_joints(e, BONES, thread, threads, w.stops)
    load_factor(w.factors, driven, arena)
    factor = int(driven)
    contact = vec8()
    cuts = int(0)
    while factor >= 0:  # repeated while muscles reach their limits, and joints the ends of their ranges
        solve(w.pattern, w.factors, factor, w.impulse, e, own, thread, threads, arena, w.shares)
        contact = stop_bones(body, ground, dt, own, factor, e, thread, threads, arena, w)
        if cuts == MOST_CUTS:
            break
        if limit_joints(body, dt, springs, tissue, strength, driven, own, cuts, e, thread, threads, w) == 0.0:
            break
        cuts += 1
        factor = w.factors.shape[0] - 1
        at = place_of_factor(w.factors, factor, arena)
        load_arena(w.matrix, e, at)
        add_blocks(w.pattern.entry, w.stops.inertia, e, 1, at)
        factorize_in_arena(w.pattern, w.left, e, at)
    finish_stops(w.shares, own, e, BONES, thread, threads, w.stops, w.impulse)
    final_impulses(w.left, w.push, w.shares, own, e, thread, threads, w.impulse)
    spread_motion(body, w.pose.position, w.shares, own, e, thread, threads, w.moving)
    support = triple_of(w.impulse, e, 0) + push_of(w, e, 0) + wp.vec3(contact[0], contact[1], contact[2])
    moment = triple_of(w.impulse, e, 3) + push_of(w, e, 1) + wp.vec3(contact[3], contact[4], contact[5])
    if thread == 0:
        add_to_sensors(body, ground, contact, e, w.pose.position[e, 0])
    balance(w.pose.position, w.bones, 0.0, support, moment, w.moving, e, own, thread, threads, w.shares)


@wp.kernel(launch_bounds=(int(MASS_BLOCK), 8))
def build_mass(
    body: Body,
    pairs: Pairs,
    dt: float,
    target: Target,
    springs: Springs,
    tissue: Tissue,
    failure: wp.array(dtype=int),
    # in and out
    w: TorqueWorkspace,
):
    """Build the mass matrix from the bones' moments, and its factors.

    Over ``(num_envs, MASS_BLOCK)``, a CUDA block for each environment.
    """
    i, _ = wp.tid()
    at = place_in_block(i, MASS_BLOCK)
    e = at[0]
    thread = at[1]
    threads = at[2]
    if failure[e] != 0:
        return
    n = failure.shape[0]
    bend_joints(body, e, thread, threads, w)
    for k in range(thread, TRIPLES, threads):
        implicit_diagonal(body, dt, target, springs, tissue, w.bend, e, k, n + e, w.tissue, w.diagonals)
    records = record_arena(w.records, 0)
    load_positions(w.pose.position, e, thread, threads, records, PLACES)
    position = view_vectors(w.pose.position, records, PLACES, 0)
    mass = place_of_factor(w.matrix, e, records)
    compose_mass(body, pairs, w.pair_sums, w.moments, position, w.pattern, records, e, thread, threads, mass)
    store_arena(mass, e, thread, threads, w.matrix)
    sync_block()
    lanes = wp.min(threads, WARP)
    warp = thread // lanes
    for which in range(warp, 2, threads // lanes):
        system = which * n + e
        arena = record_arena(w.records, which * _ARENA_WORDS)
        if threads == 1:
            factorize(w.pattern, w.matrix, w.diagonals, e, system, arena, system, w.factors)
        else:
            factorize_in_arena(w.pattern, w.diagonals, system, arena)
        store_factor(arena, system, w.factors)


@wp.kernel
def begin_substep(
    body: Body,
    hulls: int,
    failure: wp.array(dtype=int),
    # in and out
    w: TorqueWorkspace,
):
    """Run :func:`begin` for joints that were not moved by a substep, or whose body has changed.

    ``hulls`` are as in :func:`~piavatar_envs.avatar.torque_control.bone_contact.measure_bones`.

    Over ``(num_envs, WARP)``, a CUDA block for each environment.
    """
    i, _ = wp.tid()
    at = place_in_block(i, WARP)
    e = at[0]
    thread = at[1]
    threads = at[2]
    if failure[e] == 0:
        measure_bones(body, hulls, e, thread, threads, w)
        begin(body, e, thread, threads, w)


@wp.kernel(launch_bounds=(int(WARP), 16))
def act(
    body: Body,
    dt: float,
    per_time: float,
    moves: int,
    target: Target,
    springs: Springs,
    tissue: Tissue,
    strength: Strength,
    failure: wp.array(dtype=int),
    # in and out
    ground: Ground,
    support: Support,
    w: TorqueWorkspace,
):
    """Project two velocities on the joints (reaction of the pull, then ``u``), apply torques, and advance the pose.

    With three ``moves`` the last one fits the pose; otherwise there are two. The places of the bones before the fit are
    written for :func:`~piavatar_envs.avatar.torque_control.flesh_coupling.split_velocity`, places and motion after it
    for the next substep. ``per_time`` is the share of an impulse in the support [1/s]. Launched as
    :func:`begin_substep`.
    """
    i, _ = wp.tid()
    at = place_in_block(i, WARP)
    e = at[0]
    thread = at[1]
    threads = at[2]
    if failure[e] != 0:
        return
    arena = warp_arena()
    n = failure.shape[0]
    own = row_in_arena(e, 0)
    taken = row_in_arena(n + e, 1)
    bias = row_in_arena(2 * n + e, 2)
    off = row_in_arena(3 * n + e, 3)
    near = load_workspace(w, e)
    gather_sums(
        body.chunk_bone, w.moments, w.other_moments, e, own, taken, off, near.bones, near.linear, near.angular
    )  # fmt: skip
    bias_forces(body, near.pose.position, near.bones, w.moving, bias, e, thread, threads, near.linear, near.angular)
    find_shares(body, own, taken - own, moves + 1, e, thread, threads, arena, near)
    pull_bones(body, own, e, thread, threads, near)
    add_change(near.shares, taken, e, thread, threads, w.velocity, w.outside)
    expect_half(near.shares, bias, dt, e, thread, threads, w.outside)
    apply_torques(body, dt, target, springs, tissue, strength, ground, n + e, own, e, thread, threads, arena, near)
    predict_velocity(near.shares, w.outside, own, taken, e, thread, threads, w.velocity, near.shares)
    spread_motion(body, near.pose.position, near.shares, taken, e, thread, threads, near.moving)
    store_motion(near.moving, e, thread, threads, w.steps)
    if thread == 0:
        w.pelvis[e] = near.pose.position[e, 0]
        support.force[e] = support.force[e] + per_time * triple_of(w.impulse, e, 0)
        support.torque[e] = support.torque[e] + per_time * triple_of(w.impulse, e, 3)
    for move in range(moves):
        advance_pose(body, dt, tissue, move, off, e, thread, threads, near)
    begin(body, e, thread, threads, near)
    store_workspace(w, e, near)
