"""What holds flesh to bones that move under torques; see :mod:`piavatar_envs.avatar.articulated`."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.blending import skinned_place
from piavatar_envs.avatar.joint_bench import JointBench
from piavatar_envs.avatar.joint_motion import skinned_motion
from piavatar_envs.avatar.loads import int_at, number_at, vector_at
from piavatar_envs.avatar.part_sums import (
    PART_BLOCK,
    WORDS,
    Parts,
    bring_particle,
    lane_of_warp,
    place_in_parts,
    room_of_particles,
    store_second,
    sum_both,
    sum_one,
    warp_of_block,
)
from piavatar_envs.avatar.pulls import implicit_velocity
from piavatar_envs.avatar.types import Body, vec12
from piavatar_envs.mpm.shared_memory import meet, threads_of_block
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel(launch_bounds=(PART_BLOCK, 5))
def sum_displacement(
    body: Body,
    parts: Parts,
    mass: wp.array2d(dtype=float),
    x: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    scratch: wp.array(dtype=vec12),
    # in and out
    w: JointBench,
):
    """Of the particles from where the pose has them by linear blend skinning: its two momenta, of every chunk.

    Over ``(num_envs, parts, PART_BLOCK)``, a CUDA block a part; on a CPU one thread has the only one.
    """
    i, j, k = wp.tid()
    at = place_in_parts(i, j, k, x.shape[0])
    e = at[0]
    if failure[e] != 0:
        return
    thread = at[2]
    threads = threads_of_block()
    room = room_of_particles(scratch)
    first = at[1] * parts.size
    last = wp.min(first + parts.size, body.count)
    r = row(e, mass.shape[0])
    for p in range(first + thread, last, threads):
        n = body.first + p
        place = vector_at(x, e, n)
        none = wp.vec3()
        bring_particle(
            room, WORDS * (p - first), number_at(mass, r, n), place, place - skinned_place(body, w.place, e, p), none
        )
    meet()
    warp = warp_of_block()
    lane = lane_of_warp()
    n = int_at(parts.start, at[1]) + warp[0]
    end = int_at(parts.start, at[1] + 1)
    while n < end:
        c = int_at(parts.chunk, n)
        origin = vector_at(w.pose.position, e, int_at(body.chunk_bone, c))
        sum_one(body, parts, room, origin, e, c, lane[0], lane[1], w.other_moments)
        n += warp[1]


@wp.kernel(launch_bounds=(PART_BLOCK, 4))
def attach_flesh(
    body: Body,
    parts: Parts,
    dt: float,
    mass: wp.array2d(dtype=float),
    x: wp.array2d(dtype=wp.vec3),
    hold: wp.array2d(dtype=wp.vec2),
    vk: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    scratch: wp.array(dtype=vec12),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
    followed: wp.array2d(dtype=wp.vec3),
    w: JointBench,
):
    """Hand back, and pull every particle to its place on the bones, implicit in time and critically damped.

    What a new pose has changed of ``J qdot`` goes to the physical velocity, as
    :func:`piavatar_envs.avatar.joint_motion.hand_back` has it. ``hold`` is the rate of the pull [1/s], and the share of
    its way that a bone's particle goes in this substep besides, through its flesh; ``followed`` is the velocity of that
    way [m/s], of which the pull does not know. Of what the pull has taken of the velocity, and of what it leaves, the
    bones get the moments. Launched as :func:`sum_displacement`.
    """
    i, j, k = wp.tid()
    at = place_in_parts(i, j, k, x.shape[0])
    e = at[0]
    if failure[e] != 0:
        return
    thread = at[2]
    threads = threads_of_block()
    room = room_of_particles(scratch)
    first = at[1] * parts.size
    last = wp.min(first + parts.size, body.count)
    r = row(e, mass.shape[0])
    p = first + thread
    pelvis = w.pose.position[e, 0]
    n = body.first + wp.min(p, last - 1)
    following = vector_at(x, e, n)
    following_v = vector_at(u, e, n) + vector_at(vk, e, n)
    while p < last:
        place = following
        v = following_v
        n = body.first + wp.min(p + threads, last - 1)
        following = vector_at(x, e, n)
        following_v = vector_at(u, e, n) + vector_at(vk, e, n)
        before = v - skinned_motion(body, w.moving, e, p, place - pelvis)
        way = skinned_place(body, w.place, e, p) - place
        held = hold[row(e, hold.shape[0]), p]
        through = wp.vec3()
        if held[1] > 0.0:
            through = followed[e, p]
            followed[e, p] = (held[1] / dt) * way
        after = implicit_velocity(held[0], dt, way, before - through) + through
        bring_particle(room, WORDS * (p - first), number_at(mass, r, body.first + p), place, before - after, after)
        p += threads
    meet()
    store_second(room, last - first, thread, threads, e, body.first + first, u)
    warp = warp_of_block()
    lane = lane_of_warp()
    n = int_at(parts.start, at[1]) + warp[0]
    end = int_at(parts.start, at[1] + 1)
    while n < end:
        c = int_at(parts.chunk, n)
        origin = vector_at(w.pose.position, e, int_at(body.chunk_bone, c))
        sum_both(body, parts, room, origin, e, c, lane[0], lane[1], w.moments, w.other_moments)
        n += warp[1]
