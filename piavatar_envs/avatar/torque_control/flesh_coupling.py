"""Coupling of flesh and bones under torques: implicit pulls, the split of the velocity, placement of firm particles."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.controller import implicit_velocity
from piavatar_envs.avatar.correctives import corrected_rest, correction_rate
from piavatar_envs.avatar.segment_sums import (
    PARTITION_THREADS,
    Partitions,
    particle_arena,
    place_in_partitions,
    quarters_at_once,
    share_of,
    store_point,
    store_second_vectors,
    sum_chunk,
)
from piavatar_envs.avatar.skinning import blend_back, blend_images, blend_places, blend_steps, skinned_place
from piavatar_envs.avatar.torque_control.joint_motion import blended_motion, motion_apart
from piavatar_envs.avatar.torque_control.workspace import TorqueWorkspace
from piavatar_envs.avatar.types import Body
from piavatar_envs.core.arrays import (
    int_at,
    matrix_at,
    number_at,
    prefetch_rows,
    set_vector,
    store_matrix,
    store_triple,
    vector_at,
    vector_from,
)
from piavatar_envs.core.cuda_intrinsics import (
    BLOCK,
    environment_of,
    first_particle,
    lane_of_warp,
    sync_block,
    threads_of_block,
    threads_of_environment,
    warp_of_block,
)
from piavatar_envs.mpm.colliders import signed_distance
from piavatar_envs.mpm.measured_strain import affine_after_move
from piavatar_envs.mpm.types import Boundaries, Grid, Kinematic, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def pulled_rest(body: Body, elapsed: float, e: int, p: int, w: TorqueWorkspace):
    """Return the rest position that a particle is pulled to when a share ``elapsed`` of the control step is over [m].

    That of a firm particle has its slip.
    """
    rest = corrected_rest(body, elapsed, e, p)
    if p < w.slip.shape[1]:
        rest += vector_at(w.slip, e, p)
    return rest


@wp.func
def sum_partition(partitions: Partitions, arena: wp.uint64, pelvis: wp.vec3, e: int, part: int, w: TorqueWorkspace):
    """Sum the chunks of a partition from its arena, with positions relative to the ``pelvis``."""
    warp = warp_of_block()
    lane = lane_of_warp()
    quarters = quarters_at_once(lane[1])
    n = int_at(partitions.start, part) + quarters * warp[0]
    end = int_at(partitions.start, part + 1)
    while n < end:
        share = share_of(partitions.quarters, n, lane[0])
        origin = vector_at(w.pose.position, e, share[1] & 255) - pelvis
        sum_chunk(partitions, arena, share, origin, e, w.moments, w.other_moments)
        n += quarters * warp[1]


@wp.kernel(launch_bounds=(PARTITION_THREADS, 4))
def attach_flesh(
    body: Body,
    partitions: Partitions,
    dt: float,
    elapsed: float,
    per_time: float,
    mass: wp.array2d(dtype=float),
    x: wp.array2d(dtype=wp.vec3),
    rate: wp.array2d(dtype=float),
    failure: wp.array(dtype=int),
    scratch: wp.array(dtype=float),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
    driven: Kinematic,
    w: TorqueWorkspace,
):
    """Update ``u`` to the new ``J``, pull every particle to its skinned place, and sum moments of the bones.

    The change of ``J qdot`` with the pose is added to ``u``. ``vk`` keeps
    :func:`~piavatar_envs.avatar.torque_control.joint_motion.motion_apart` of particles that several bones move, and
    ``spin`` the displacements to the skinned places, both for :func:`split_velocity`. The pull is implicit in time and
    critically damped, with ``rate`` [1/s]; a rate of 0 leaves a velocity exactly as it is. The moments are those of
    the velocity that the pull removes, of the remaining velocity, and of the displacements to the skinned places. The
    rest pose is that when a share ``elapsed`` of the control step is over; ``per_time`` is one over its time [1/s].

    Over ``(num_envs, partitions, PARTITION_THREADS)``, a CUDA block a partition; on a CPU one thread has the only one.
    """
    i, j, k = wp.tid()
    at = place_in_partitions(i, j, k, x.shape[0])
    e = at[0]
    if failure[e] != 0:
        return
    thread = at[2]
    threads = threads_of_block()
    arena = particle_arena(scratch)
    first = at[1] * partitions.size
    last = wp.min(first + partitions.size, body.count)
    r = row(e, mass.shape[0])
    p = first + thread
    pelvis = vector_at(w.pose.position, e, 0)
    prefetch_rows(x, e, body.first + first, last - first, thread)
    prefetch_rows(u, e, body.first + first, last - first, thread)
    prefetch_rows(driven.vk, e, body.first + first, last - first, thread)
    while p < last:
        n = body.first + p
        arm = vector_at(x, e, n) - pelvis
        v = vector_at(u, e, n) + vector_at(driven.vk, e, n)
        if w.commanded.shape[1] > 0:
            v -= vector_at(w.commanded, e, p)
        m = number_at(mass, r, n)  # loaded before any store, to avoid waiting for it
        own_rate = number_at(rate, row(e, rate.shape[0]), p)
        rate_inside = correction_rate(body, per_time, e, p)
        now = blend_images(w.place, w.moving, e, body.skin, p, pulled_rest(body, elapsed, e, p, w), rate_inside)
        apart = wp.vec3()
        if p >= body.alone:
            apart = motion_apart(now)
            set_vector(driven.vk, e, n, apart)
        before = v - blended_motion(now, arm) - apart
        way = wp.vec3(now[6], now[7], now[8]) - arm
        set_vector(driven.spin, e, n, way)
        after = implicit_velocity(own_rate, dt, way, before)
        store_point(arena, partitions.size, p - first, m, arm, before - after, after, way)
        p += threads
    sync_block()
    store_second_vectors(arena, last - first, thread, threads, e, body.first + first, u)
    sum_partition(partitions, arena, pelvis, e, at[1], w)


@wp.func
def chord(start: wp.vec3, end: wp.vec3, way: wp.vec3, spin: wp.vec3, dt: float):
    """Return the velocity from ``start`` [m] to beside the place ``end``, from which ``way`` leads back when turned."""
    turn = wp.cross(spin, way)
    return (end - way - start) / dt - turn - 0.5 * dt * wp.cross(spin, turn)


@wp.kernel(launch_bounds=(BLOCK, 10))
def split_velocity(
    body: Body,
    dt: float,
    elapsed: float,
    x: wp.array2d(dtype=wp.vec3),
    w: TorqueWorkspace,
    failure: wp.array(dtype=int),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
    driven: Kinematic,
):
    """Write the velocity ``vk`` of the joints' motion in this substep, and set ``u`` to the rest of the total velocity.

    ``vk`` leads exactly to the particle's place at the end of the substep: it is the chord between its two skinned
    places, and turns its displacement from them. Moved along ``J qdot`` of the substep's beginning, a particle that
    turns by ``theta`` would end ``1 + theta^2 / 2`` times as far from its axis; ``u`` would have to lead it back, and
    its gradient would strain the flesh, always in the same sense.
    At the end a share ``elapsed`` of the control step is over.

    The total velocity is ``u`` plus the bones' motion in ``steps``, about the pelvis joint at the
    beginning, plus the motion apart that :func:`attach_flesh` leaves in ``vk``. ``steps`` has the spin at the midpoint,
    too. :func:`attach_flesh` leaves the displacements to the skinned places in ``spin``.
    """
    i, _ = wp.tid()
    threads = threads_of_environment(x.shape[0])
    own = first_particle(i, threads)
    e = own[0]
    if failure[e] != 0:
        return
    p = own[1]
    center = w.pelvis[e]
    while p < body.count:
        n = body.first + p
        arm = vector_at(x, e, n) - center
        total = vector_at(u, e, n)
        way = vector_at(driven.spin, e, n)
        apart = vector_from(driven.vk, body.first + body.alone, e, n)
        steps = blend_steps(w.steps, e, body.skin, p)
        end = blend_places(w.end, e, body.skin, p, pulled_rest(body, elapsed, e, p, w))
        spin = wp.vec3(steps[6], steps[7], steps[8])
        vk = chord(arm, end, way, spin, dt)
        total += blended_motion(steps, arm) + apart
        store_triple(u, driven.vk, driven.spin, e, n, total - vk, vk, spin, True)
        p += threads


@wp.func
def keep_outside(boundaries: Boundaries, e: int, x: wp.vec3):
    """Return ``x`` [m], projected on the surface of each boundary that it lies beyond, in their order."""
    for b in range(boundaries.count):
        d = signed_distance(boundaries, e, b, x)
        x = x - wp.min(d[3], 0.0) * wp.vec3(d[0], d[1], d[2])
    return x


@wp.kernel
def find_places(
    body: Body,
    place: wp.array2d(dtype=wp.mat44),
    failure: wp.array(dtype=int),
    # out
    at: wp.array2d(dtype=wp.vec3),
):
    """Write the skinned places of all particles [m], relative to the pelvis joint; over ``(num_envs, particles)``."""
    e, p = wp.tid()
    if failure[e] == 0:
        set_vector(at, e, p, skinned_place(body, place, 1.0, e, p))


@wp.kernel
def put_in_place(
    body: Body,
    grid: Grid,
    boundaries: Boundaries,
    firm: wp.array(dtype=int),
    place: wp.array2d(dtype=wp.mat44),
    position: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    vk: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # in and out
    x: wp.array2d(dtype=wp.vec3),
    C: wp.array3d(dtype=float),
    slip: wp.array2d(dtype=wp.vec3),
):
    """Move the ``firm`` particles to their skinned places, but not beyond boundaries; over ``num_envs * firm.size``.

    No particle's velocity ``v`` changes. The angular momentum ``m s x v`` of displacement ``s`` is compensated in the
    affine velocity. ``slip`` stores the displacement, in the frame of the rest pose.
    """
    own = environment_of(wp.tid(), firm.shape[0])
    e = own[0]
    if failure[e] != 0:
        return
    p = firm[own[1]]
    q = body.first + p
    at = keep_outside(boundaries, e, vector_at(position, e, 0) + skinned_place(body, place, 1.0, e, p))
    way = at - vector_at(x, e, q)
    affine = affine_after_move(grid, matrix_at(C, e, q), way, vector_at(u, e, q) + vector_at(vk, e, q))
    slipped = vector_at(slip, e, p) + blend_back(place, e, body.skin, p, way)
    set_vector(x, e, q, at)  # stores after all loads
    set_vector(slip, e, p, slipped)
    store_matrix(C, e, q, affine)
