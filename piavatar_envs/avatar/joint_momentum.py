"""What momentum the joints have to do with: that of the particles as they see it, and that which they must not make."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.blending import motion_at
from piavatar_envs.avatar.joint_motion import set_part
from piavatar_envs.avatar.lanes import add_rows12, add_rows16, highest_bit, meet_threads, sum_threads16
from piavatar_envs.avatar.mass_matrix import BONES, I3
from piavatar_envs.avatar.rigid_fit import point_inertia, spin_of, symmetric
from piavatar_envs.avatar.types import Body, vec8, vec12, vec16

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Where the momenta of what the pull leaves begin in :attr:`JointBench.other_moments`, and those of the ways.
LEFT, WAY = wp.constant(0), wp.constant(6)


@wp.func
def gather_bones(
    body: Body,
    moments: wp.array2d(dtype=vec16),
    e: int,
    row: int,
    thread: int,
    threads: int,
    # out
    bones: wp.array2d(dtype=vec16),
    linear: wp.array2d(dtype=wp.vec3),
    angular: wp.array2d(dtype=wp.vec3),
):
    """Moments of the bones about their joints from those of their chunks, and from them two momenta each.

    These are in row ``row``.
    """
    for b in range(thread, BONES, threads):
        s = add_rows16(moments, e, body.chunk_start[b], body.chunk_start[b + 1])
        bones[e, b] = s
        linear[row, b] = wp.vec3(s[4], s[5], s[6])
        angular[row, b] = wp.vec3(s[13], s[14], s[15])


@wp.func
def gather_other(
    body: Body,
    moments: wp.array2d(dtype=vec12),
    first: int,
    e: int,
    row: int,
    thread: int,
    threads: int,
    # out
    linear: wp.array2d(dtype=wp.vec3),
    angular: wp.array2d(dtype=wp.vec3),
):
    """The two momenta of one of the velocities that the sums have, in row ``row``."""
    for b in range(thread, BONES, threads):
        t = add_rows12(moments, e, body.chunk_start[b], body.chunk_start[b + 1])
        linear[row, b] = wp.vec3(t[first], t[first + 1], t[first + 2])
        angular[row, b] = wp.vec3(t[first + 3], t[first + 4], t[first + 5])


@wp.func
def take_child(
    position: wp.array2d(dtype=wp.vec3),
    e: int,
    row: int,
    a: int,
    b: int,
    # in and out
    linear: wp.array2d(dtype=wp.vec3),
    angular: wp.array2d(dtype=wp.vec3),
):
    """Add the momenta of bone ``b`` and all beyond to those of ``a``, which it hangs on."""
    arm = position[e, b] - position[e, a]
    angular[row, a] = angular[row, a] + angular[row, b] + wp.cross(arm, linear[row, b])
    linear[row, a] = linear[row, a] + linear[row, b]


@wp.func
def pass_down(
    body: Body,
    position: wp.array2d(dtype=wp.vec3),
    e: int,
    velocities: int,
    own: int,
    step: int,
    thread: int,
    threads: int,
    # in and out
    linear: wp.array2d(dtype=wp.vec3),
    angular: wp.array2d(dtype=wp.vec3),
    # out
    momentum: wp.array2d(dtype=float),
):
    """``J^T m u`` from the momenta of the bones about their joints: each joint has what all beyond it have.

    Of so many velocities, the first in row ``own``, others ``step`` rows apart. A thread that is alone goes from bone
    to bone, the lanes of a warp from level to level, a bone each.
    """
    meet_threads(threads)
    if threads == 1:
        for v in range(velocities):
            for back in range(BONES - 1):
                b = BONES - 1 - back  # children come after their parents
                take_child(position, e, own + v * step, body.parent[b], b, linear, angular)
    else:
        depth = int(-1)
        children = int(0)
        if thread < BONES:
            depth = body.depth[thread]
            children = body.children[thread]
        for back in range(body.levels - 1):
            if depth == body.levels - 2 - back:
                while children != 0:
                    b = highest_bit(children)
                    children -= 1 << b
                    for v in range(velocities):
                        take_child(position, e, own + v * step, thread, b, linear, angular)
            meet_threads(threads)
    for v in range(velocities):
        for b in range(thread, BONES, threads):
            set_part(momentum, own + v * step, 3 + 3 * b, angular[own + v * step, b])
        if thread == 0:
            set_part(momentum, own + v * step, 0, linear[own + v * step, 0])


@wp.func
def balance(
    position: wp.array2d(dtype=wp.vec3),
    bones: wp.array2d(dtype=vec16),
    reaction: float,
    support: wp.vec3,
    moment: wp.vec3,
    field: wp.array2d(dtype=vec8),
    e: int,
    row: int,
    thread: int,
    threads: int,
    # in and out
    change: wp.array2d(dtype=float),
):
    """Give ``change[row]`` of the joints' velocities, that moves bones as ``field``, the momentum that it must have.

    That is ``support``, an impulse, and its ``moment`` about the pelvis joint, and with ``reaction`` 1 what the bones'
    sums say. A rigid motion of the body makes up the difference. The blend of the bones' motions has the momenta of the
    bones' own sums, because weights add up to one.
    """
    m = float(0.0)
    first = wp.vec3()
    I = wp.mat33()
    P = wp.vec3()
    L = wp.vec3()
    for b in range(thread, BONES, threads):
        s = bones[e, b]
        arm = position[e, b] - position[e, 0]
        d = wp.vec3(s[1], s[2], s[3])  # first moment about the joint, as are the others
        w = wp.vec3(field[e, b][3], field[e, b][4], field[e, b][5])
        v = motion_at(field[e, b], arm)  # at the joint
        second = symmetric(wp.vec3(s[7], s[8], s[9]), wp.vec3(s[10], s[11], s[12]))
        inertia = wp.diag(wp.vec3(wp.trace(second))) - second
        p = s[0] * v + wp.cross(w, d) - reaction * wp.vec3(s[4], s[5], s[6])
        P += p
        L += wp.cross(d, v) + inertia * w - reaction * wp.vec3(s[13], s[14], s[15]) + wp.cross(arm, p)
        m += s[0]
        first += d + s[0] * arm
        I += inertia + point_inertia(s[0], arm)
        I += 2.0 * wp.dot(d, arm) * I3 - wp.outer(d, arm) - wp.outer(arm, d)
    # fmt: off
    t = sum_threads16(
        vec16(
            m, first[0], first[1], first[2], P[0], P[1], P[2], L[0], L[1], L[2],
            I[0, 0], I[1, 1], I[2, 2], I[1, 2], I[2, 0], I[0, 1],
        ),
        threads,
    )
    # fmt: on
    if thread > 0:
        return
    center = wp.vec3(t[1], t[2], t[3]) / t[0]
    P = wp.vec3(t[4], t[5], t[6]) - support
    L = wp.vec3(t[7], t[8], t[9]) - moment
    I = symmetric(wp.vec3(t[10], t[11], t[12]), wp.vec3(t[13], t[14], t[15]))
    W = spin_of(I - point_inertia(t[0], center), L - wp.cross(center, P))
    V = P / t[0] - wp.cross(W, center)
    for i in range(3):
        change[row, i] = change[row, i] - V[i]
        change[row, 3 + i] = change[row, 3 + i] - W[i]
