"""What holds flesh to bones that move under torques; see :mod:`piavatar_envs.avatar.articulated`."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.blending import skinned_place
from piavatar_envs.avatar.joint_bench import JointBench
from piavatar_envs.avatar.joint_motion import skinned_motion
from piavatar_envs.avatar.joint_stages import WARP
from piavatar_envs.avatar.lanes import BLOCK
from piavatar_envs.avatar.loads import number_at, vector_at
from piavatar_envs.avatar.part_sums import Parts, bring_particle, place_in_parts, room_of_particles, sum_both, sum_one
from piavatar_envs.avatar.pulls import implicit_velocity
from piavatar_envs.avatar.types import Body, vec12
from piavatar_envs.mpm.shared_memory import meet, threads_of_block
from piavatar_envs.mpm.stores import store_vector
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel(launch_bounds=(BLOCK, 10))
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

    Over ``(num_envs, parts, BLOCK)``, a CUDA block a part; on a CPU one thread has the only one.
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
        bring_particle(room, p - first, number_at(mass, r, n), place, place - skinned_place(body, w.place, e, p), none)
    meet()
    lanes = wp.min(threads, WARP)
    for n in range(parts.start[at[1]] + thread // lanes, parts.start[at[1] + 1], threads // lanes):
        c = parts.chunk[n]
        origin = w.pose.position[e, body.chunk_bone[c]]
        sum_one(body, room, first, origin, e, c, thread % lanes, lanes, w.other_moments)


@wp.kernel(launch_bounds=(BLOCK, 8))
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
        bring_particle(room, p - first, number_at(mass, r, body.first + p), place, before - after, after)
        store_vector(u, e, body.first + p, after, True)
        p += threads
    meet()
    lanes = wp.min(threads, WARP)
    for n in range(parts.start[at[1]] + thread // lanes, parts.start[at[1] + 1], threads // lanes):
        c = parts.chunk[n]
        origin = w.pose.position[e, body.chunk_bone[c]]
        sum_both(body, room, first, origin, e, c, thread % lanes, lanes, w.moments, w.other_moments)
