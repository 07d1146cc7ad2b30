"""What velocities of the joints do to bones and particles: the skinning Jacobian ``J``, applied and never stored.

A generalised velocity is that of the pelvis and, for every joint, the angular velocity against its parent in the
world's axes; see :mod:`piavatar_envs.avatar.mass_matrix`. Each bone then has a rigid motion, and a particle the blend
of those of its bones: at the particle, not at its skinned place, or angular momentum would not be kept.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.blending import blend_steps
from piavatar_envs.avatar.lanes import BLOCK, first_particle, meet_threads, over_ancestors, threads_of_environment
from piavatar_envs.avatar.loads import vector_at, vector_from
from piavatar_envs.avatar.mass_matrix import BONES, NUM_DOF
from piavatar_envs.avatar.rotation import quat_exp
from piavatar_envs.avatar.types import Body, vec8, vec12
from piavatar_envs.mpm.stores import store_velocities
from piavatar_envs.mpm.types import Kinematic, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def part_of(q: wp.array2d(dtype=float), e: int, first: int):
    """Three components of a generalised vector."""
    return wp.vec3(q[e, first], q[e, first + 1], q[e, first + 2])


@wp.func
def set_part(q: wp.array2d(dtype=float), e: int, first: int, v: wp.vec3):
    """Write three components of a generalised vector."""
    for i in range(3):
        q[e, first + i] = v[i]


@wp.func
def joint_alone(position: wp.array2d(dtype=wp.vec3), q: wp.array2d(dtype=float), row: int, e: int, b: int):
    """Rigid motion that joint ``b`` alone gives to what it carries; the pelvis' place moves with the first one."""
    w = part_of(q, row, 3 + 3 * b)
    v = wp.vec3()
    if b == 0:
        v = part_of(q, row, 0)
    else:
        v = wp.cross(w, position[e, 0] - position[e, b])
    return vec8(v[0], v[1], v[2], w[0], w[1], w[2], 0.0, 0.0)


_ADD = "value[k] += up < 0 ? 0.0f : more;"


@wp.func_native(over_ancestors(6, _ADD))
def add_ancestors6(value: vec8, parent: int, levels: int) -> vec8:
    """Sum of what the lanes of a warp have, of a bone each, over all from the root to a lane's own; six numbers."""
    ...


@wp.func_native(over_ancestors(3, _ADD))
def add_ancestors3(value: wp.vec3, parent: int, levels: int) -> wp.vec3:
    """:func:`add_ancestors6` of a vector."""
    ...


@wp.func
def spread_motion(
    body: Body,
    position: wp.array2d(dtype=wp.vec3),
    q: wp.array2d(dtype=float),
    row: int,
    e: int,
    thread: int,
    threads: int,
    # out
    field: wp.array2d(dtype=vec8),
):
    """Rigid motion of every bone under generalised velocity ``q[row]``: velocity where the pelvis joint is, and spin.

    A thread that is alone goes through the bones in their order, parents first. Each lane of a warp has a bone.
    """
    meet_threads(threads)
    if threads == 1:
        for b in range(BONES):
            motion = joint_alone(position, q, row, e, b)
            if b > 0:
                motion = field[e, body.parent[b]] + motion
            field[e, b] = motion
    else:
        own = wp.min(thread, BONES - 1)
        whole = add_ancestors6(joint_alone(position, q, row, e, own), body.parent[own], body.levels)
        if thread < BONES:
            field[e, own] = whole
    meet_threads(threads)


@wp.func
def motion_apart(b: vec12):
    """What bones move a particle by besides the blend of their motions at its place [m/s].

    Of :func:`piavatar_envs.avatar.blending.blend_images`. Linear blend skinning has a particle where its bones have it
    in the mean. In a bent joint they have it at places that are centimetres apart, and each turns its own: the mean of
    that is not what their mean motion does to the mean place. Without it particles would leave their places with every
    turn. Rigid motion has nothing of it.
    """
    return wp.vec3(b[9], b[10], b[11]) - wp.cross(wp.vec3(b[3], b[4], b[5]), wp.vec3(b[6], b[7], b[8]))


@wp.func
def blended_motion(b: vec12, arm: wp.vec3):
    """The blend of the bones' first motions, ``arm`` from where their velocity is [m/s].

    Of :func:`piavatar_envs.avatar.blending.blend_images`, or of :func:`piavatar_envs.avatar.blending.blend_steps`.
    """
    return wp.vec3(b[0], b[1], b[2]) + wp.cross(wp.vec3(b[3], b[4], b[5]), arm)


@wp.kernel(launch_bounds=(BLOCK, 10))
def take_over(
    body: Body,
    dt: float,
    x: wp.array2d(dtype=wp.vec3),
    pelvis: wp.array(dtype=wp.vec3),
    steps: wp.array2d(dtype=vec12),
    failure: wp.array(dtype=int),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
    driven: Kinematic,
):
    """Write ``J qdot`` of the middle of the substep, and leave the physical velocity what it is not of the whole one.

    Particle and bones are half a step on there. Moved by ``J qdot`` of its beginning, a straight way, what turns by
    ``theta`` in a substep would be ``theta^2 / 2`` further from its axis, of which no stress knows: limbs would swell
    within seconds. The whole velocity is the physical one and what that lacks, the first of the bones' motions in
    ``steps``, about where the ``pelvis`` joint begins [m]; the second is that of the joints, about where it is
    half-way. To that comes what ``vk`` has kept where bones are not alone, see
    :func:`piavatar_envs.avatar.attachment.attach_flesh`.
    """
    i, _ = wp.tid()
    threads = threads_of_environment(x.shape[0])
    own = first_particle(i, threads)
    e = own[0]
    if failure[e] != 0:
        return
    p = own[1]
    center = pelvis[e]
    root = steps[e, 0]
    last = body.count - 1
    together = body.first + body.alone
    n = body.first + wp.min(p, last)
    following = vector_at(x, e, n)
    following_u = vector_at(u, e, n)
    following_apart = vector_from(driven.vk, together, e, n)
    while p < body.count:
        arm = following - center
        before = following_u
        apart = following_apart
        n = body.first + wp.min(p + threads, last)
        following = vector_at(x, e, n)
        following_u = vector_at(u, e, n)
        following_apart = vector_from(driven.vk, together, e, n)
        s = blend_steps(steps, e, body.skin, p)
        whole = before + blended_motion(s, arm)
        spin = wp.vec3(s[9], s[10], s[11])
        vk = wp.vec3(s[6], s[7], s[8]) + wp.cross(spin, arm)
        vk += wp.cross(0.5 * dt * spin, vk - wp.vec3(root[6], root[7], root[8]))
        store_velocities(u, driven, e, body.first + p, whole - vk, vk + apart, spin, True)
        p += threads


@wp.func
def next_position(
    body: Body,
    dt: float,
    field: wp.array2d(dtype=vec8),
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    r: int,
    e: int,
    b: int,
):
    """Where a joint will be from its parent's, which has turned already [m]; the pelvis', in the world."""
    if b == 0:
        s = field[e, 0]
        return position[e, 0] + dt * wp.vec3(s[0], s[1], s[2])
    a = body.parent[b]
    return wp.quat_rotate(rotation[e, a], body.rest_joint[r, b] - body.rest_joint[r, a])


@wp.func
def move_joints(
    body: Body,
    dt: float,
    field: wp.array2d(dtype=vec8),
    e: int,
    thread: int,
    threads: int,
    # in and out
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
):
    """Turn every bone by its spin over ``dt``, and the pelvis on; joints stay together. Threads as above."""
    meet_threads(threads)
    r = row(e, body.rest_joint.shape[0])
    for b in range(thread, BONES, threads):
        s = field[e, b]
        rotation[e, b] = wp.normalize(quat_exp(dt * wp.vec3(s[3], s[4], s[5])) * rotation[e, b])
    meet_threads(threads)
    if threads == 1:
        for b in range(BONES):
            position[e, b] = next_position(body, dt, field, rotation, position, r, e, b)
            if b > 0:
                position[e, b] = position[e, body.parent[b]] + position[e, b]
    else:
        own = wp.min(thread, BONES - 1)
        step = next_position(body, dt, field, rotation, position, r, e, own)
        place = add_ancestors3(step, body.parent[own], body.levels)
        if thread < BONES:
            position[e, own] = place
    meet_threads(threads)


@wp.func
def add_change(
    change: wp.array2d(dtype=float),
    row: int,
    e: int,
    thread: int,
    threads: int,
    # in and out
    q: wp.array2d(dtype=float),
    outside: wp.array2d(dtype=float),
):
    """What the particles did to the joints: it was not the joints' own doing."""
    meet_threads(threads)
    for i in range(thread, NUM_DOF, threads):
        q[e, i] = q[e, i] + change[row, i]
        outside[e, i] = outside[e, i] + change[row, i]


@wp.func
def go_on(
    change: wp.array2d(dtype=float),
    outside: wp.array2d(dtype=float),
    own: int,
    row: int,
    e: int,
    thread: int,
    threads: int,
    # in and out
    q: wp.array2d(dtype=float),
    taken: wp.array2d(dtype=float),
):
    """The velocity that joints will have if all else does again what it did; what particles lack without it.

    The joints' own ``change`` is in row ``own``; what was ``taken`` of the particles before is in ``row``, where what
    they lack of their whole velocity comes.
    """
    meet_threads(threads)
    for i in range(thread, NUM_DOF, threads):
        after = q[e, i] + change[own, i] + outside[e, i]
        q[e, i] = after
        taken[row, i] = after - taken[row, i] - outside[e, i]
