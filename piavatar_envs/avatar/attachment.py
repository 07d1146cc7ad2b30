"""What holds flesh to bones that move under torques; see :mod:`piavatar_envs.avatar.articulated`."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.blending import skinned_place
from piavatar_envs.avatar.joint_motion import skinned_motion
from piavatar_envs.avatar.lanes import first_particle, threads_of_environment
from piavatar_envs.avatar.loads import vector_at
from piavatar_envs.avatar.pulls import implicit_velocity
from piavatar_envs.avatar.types import Body, vec8
from piavatar_envs.mpm.stores import store_pair, store_vector
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def find_displacement(
    body: Body,
    x: wp.array2d(dtype=wp.vec3),
    place: wp.array2d(dtype=wp.mat44),
    failure: wp.array(dtype=int),
    # out
    displacement: wp.array2d(dtype=wp.vec3),
):
    """Of the particles from where the pose has them by linear blend skinning [m], at their places in the world."""
    i, _ = wp.tid()
    threads = threads_of_environment(x.shape[0])
    own = first_particle(i, x.shape[0])
    e = own[0]
    if failure[e] != 0:
        return
    p = own[1]
    while p < body.count:
        q = body.first + p
        store_vector(displacement, e, q, vector_at(x, e, q) - skinned_place(body, place, e, p), True)
        p += threads


@wp.kernel
def attach_flesh(
    body: Body,
    dt: float,
    x: wp.array2d(dtype=wp.vec3),
    position: wp.array2d(dtype=wp.vec3),
    place: wp.array2d(dtype=wp.mat44),
    moving: wp.array2d(dtype=vec8),
    hold: wp.array2d(dtype=wp.vec2),
    vk: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
    followed: wp.array2d(dtype=wp.vec3),
    # out
    lost: wp.array2d(dtype=wp.vec3),
):
    """:func:`hand_back`, and pull every particle to its place on the bones, implicit in time and critically damped.

    ``hold`` is the rate of the pull [1/s], and the share of its way that a bone's particle goes in this substep
    besides, through its flesh. ``lost`` is what the pull has taken of the velocity, ``followed`` the velocity of that
    way [m/s]; the pull does not know of the last one's.
    """
    i, _ = wp.tid()
    threads = threads_of_environment(x.shape[0])
    own = first_particle(i, x.shape[0])
    e = own[0]
    if failure[e] != 0:
        return
    p = own[1]
    pelvis = position[e, 0]
    last = body.count - 1
    n = body.first + wp.min(p, last)
    following = vector_at(x, e, n)
    following_v = vector_at(u, e, n) + vector_at(vk, e, n)
    while p < body.count:
        at = following
        v = following_v
        n = body.first + wp.min(p + threads, last)
        following = vector_at(x, e, n)
        following_v = vector_at(u, e, n) + vector_at(vk, e, n)
        before = v - skinned_motion(body, moving, e, p, at - pelvis)
        way = skinned_place(body, place, e, p) - at
        held = hold[row(e, hold.shape[0]), p]
        through = wp.vec3()
        if held[1] > 0.0:
            through = followed[e, p]
            followed[e, p] = (held[1] / dt) * way
        after = implicit_velocity(held[0], dt, way, before - through) + through
        store_pair(u, lost, e, body.first + p, after, before - after, True, True)
        p += threads
