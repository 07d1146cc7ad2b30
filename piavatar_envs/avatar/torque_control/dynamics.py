"""Joint dynamics: motion of bones and particles, momentum of particles at the joints, and torques implicit in time.

The symbols are those of :mod:`piavatar_envs.avatar.torque_control.controller`; a generalised velocity is as
:mod:`piavatar_envs.avatar.torque_control.mass_matrix` defines it. The skinning Jacobian ``J`` is applied and never
stored: a generalised velocity gives each bone a rigid motion, and a particle the blend of its bones' motions. The blend
is evaluated at the particle, not at its skinned place; otherwise angular momentum would not be conserved.

The impulse of a spring ``K`` and a damper ``D`` over a substep depends on the velocity at its end. The change ``d`` by
the joints themselves is solved for; the change by contact, weight and flesh is predicted to be that of the last
substep, ``c``. The impulse is

    dt K e - A (v + d),   v = qdot + c,   A = dt D + dt^2 K.

Without ``c`` a blocked limb would transmit only ``M / (M + A)`` of its torque, because its damper would resist a motion
that contact is going to stop. With it the torque of a blocked limb approaches ``K e`` as ``(A / (M + A))^n`` over ``n``
substeps, and that of a free limb is unchanged.

Where the solution exceeds the strength of a joint, the joint applies its greatest torque instead of a spring, and the
system is solved again, so that all other joints respond to it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from piavatar_envs.avatar.rotation import quat_exp, quat_log, short_of_pi, torque_of_vector
from piavatar_envs.avatar.skinning import blend_steps, motion_at
from piavatar_envs.avatar.torque_control.mass_matrix import BONES, I3, NUM_DOF
from piavatar_envs.avatar.tracking import point_inertia, spin_of, symmetric
from piavatar_envs.avatar.types import Body, Pose
from piavatar_envs.core.arrays import store_triple, vec8, vec12, vec16, vector_at, vector_from
from piavatar_envs.core.cuda_intrinsics import (
    BLOCK,
    first_particle,
    over_ancestors,
    sum_threads16,
    sync_threads,
    threads_of_environment,
)
from piavatar_envs.core.structs import make_struct
from piavatar_envs.mpm.types import Kinematic, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def triple_of(q: wp.array2d(dtype=float), e: int, first: int):
    """Return three components of a generalised vector, from index ``first`` on."""
    return wp.vec3(q[e, first], q[e, first + 1], q[e, first + 2])


@wp.func
def set_triple(q: wp.array2d(dtype=float), e: int, first: int, v: wp.vec3):
    """Write three components of a generalised vector, from index ``first`` on."""
    for i in range(3):
        q[e, first + i] = v[i]


@wp.func
def joint_alone(position: wp.array2d(dtype=wp.vec3), q: wp.array2d(dtype=float), row: int, e: int, b: int):
    """Return the rigid motion that joint ``b`` alone adds to all bones beyond it; joint 0 also moves the pelvis."""
    w = triple_of(q, row, 3 + 3 * b)
    v = wp.vec3()
    if b == 0:
        v = triple_of(q, row, 0)
    else:
        v = wp.cross(w, position[e, 0] - position[e, b])
    return vec8(v[0], v[1], v[2], w[0], w[1], w[2], 0.0, 0.0)


_ADD = "value[k] += up < 0 ? 0.0f : more;"


@wp.func_native(over_ancestors(6, _ADD))
def add_ancestors6(value: vec8, parent: int, levels: int) -> vec8:
    """Sum a per-bone value from the root to each lane's bone: six numbers, one bone a lane."""
    ...


@wp.func_native(over_ancestors(3, _ADD))
def add_ancestors3(value: wp.vec3, parent: int, levels: int) -> wp.vec3:
    """Run :func:`add_ancestors6` for a vector of three numbers."""
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
    """Compute the rigid motion of every bone under generalised velocity ``q[row]``.

    ``field`` gets velocity at the pelvis joint [m/s] and spin [rad/s]. A single thread processes the bones in their
    order, parents first; in a warp each lane has a bone.
    """
    sync_threads(threads)
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
    sync_threads(threads)


@wp.func
def motion_apart(b: vec12):
    """Return the velocity from bones that place the particle differently, missing in the blended motion [m/s].

    ``b`` is a record of :func:`piavatar_envs.avatar.skinning.blend_images`. Linear blend skinning places a particle at
    the mean of its bones' images. In a bent joint these lie apart, and each bone turns its own image, so that the mean
    of their velocities differs from the mean motion at the mean place. Without this term particles would drift from
    their skinned places with every turn. It is zero for a rigid motion.
    """
    return wp.vec3(b[9], b[10], b[11]) - wp.cross(wp.vec3(b[3], b[4], b[5]), wp.vec3(b[6], b[7], b[8]))


@wp.func
def blended_motion(b: vec12, arm: wp.vec3):
    """Return the velocity of the bones' blended first motions at ``arm`` from their reference point [m/s].

    ``b`` is a record of :func:`piavatar_envs.avatar.skinning.blend_images` or
    :func:`piavatar_envs.avatar.skinning.blend_steps`.
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
    """Write ``vk = J qdot`` at the midpoint, and set ``u`` to the rest of the total velocity.

    Moved straight by ``J qdot`` of the substep's beginning, a particle that turns by ``theta`` would end
    ``1 + theta^2 / 2`` times as far from its axis, and limbs would swell without stress. The total velocity is ``u``
    plus the first of the bones' motions in ``steps``, about the ``pelvis`` joint at the beginning [m]; the second of
    these is the motion of the joints, about the pelvis joint at the midpoint. ``vk`` also keeps :func:`motion_apart`,
    stored there by :func:`piavatar_envs.avatar.torque_control.flesh_coupling.attach_flesh` for particles of several
    bones.
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
        store_triple(u, driven.vk, driven.spin, e, body.first + p, whole - vk, vk + apart, spin, True)
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
    """Return a joint's new offset from its parent, which must have turned already [m]; the pelvis' new position."""
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
    """Integrate bone rotations and the pelvis position over ``dt``; the other joints follow at fixed offsets.

    Threads share the bones as in :func:`spread_motion`.
    """
    sync_threads(threads)
    r = row(e, body.rest_joint.shape[0])
    for b in range(thread, BONES, threads):
        s = field[e, b]
        rotation[e, b] = wp.normalize(quat_exp(dt * wp.vec3(s[3], s[4], s[5])) * rotation[e, b])
    sync_threads(threads)
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
    sync_threads(threads)


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
    """Add the velocity change caused by particles to ``q`` and to ``outside``."""
    sync_threads(threads)
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
    """Predict the joint velocity with ``outside`` repeated, and write the remainder that particles take.

    Row ``own`` of ``change`` is the change by the joints themselves. Row ``row`` of ``taken`` holds the projected
    velocity, and gets what the total velocity exceeds ``u`` by, as a generalised velocity.
    """
    sync_threads(threads)
    for i in range(thread, NUM_DOF, threads):
        after = q[e, i] + change[own, i] + outside[e, i]
        q[e, i] = after
        taken[row, i] = after - taken[row, i] - outside[e, i]


# A lane of a warp sums one of the 28 numbers, so that those of a chunk are loaded at once, several chunks ahead.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
const int lane = threadIdx.x & 31;
constexpr int LANES = 32;
#else
constexpr int lane = 0, LANES = 1;
#endif
constexpr int AHEAD = 8;
const int chunks = chunk_bone.shape[0], last = bones.shape[1];
for (int word = lane; word < 28; word += LANES) {
    const int vector = word < 16 ? 0 : word < 22 ? 1 : 2, row = vector == 0 ? own : vector == 1 ? taken : off;
    const int component = word >= 16 ? (word - 16) % 6 : word >= 13 ? word - 10 : word >= 4 && word < 7 ? word - 4 : -1;
    wp::vec3* const momenta = component < 3 ? &wp::index(linear, row, 0) : &wp::index(angular, row, 0);
    float* const to = component < 0 ? nullptr : reinterpret_cast<float*>(momenta) + component % 3;
    const int words = word < 16 ? 16 : 12;
    const float* const from = word < 16 ? reinterpret_cast<const float*>(&wp::index(moments, e, 0)) + word
                                        : reinterpret_cast<const float*>(&wp::index(other_moments, e, 0)) + word - 16;
    float* const whole = reinterpret_cast<float*>(&wp::index(bones, e, 0)) + word;
    float sum = 0.0f, next[AHEAD];
    int bone = 0, next_bone[AHEAD];
    const auto ask = [&](int first) {
#pragma unroll
        for (int n = 0; n < AHEAD; ++n) {
            const int c = first + n;
            next[n] = c < chunks ? from[words * c] : 0.0f;
            next_bone[n] = c < chunks ? chunk_bone.data[c] : last;
        }
    };
    ask(0);
    for (int first = 0; bone < last; first += AHEAD) {
        float value[AHEAD];
        int of[AHEAD];
#pragma unroll
        for (int n = 0; n < AHEAD; ++n) value[n] = next[n], of[n] = next_bone[n];
        ask(first + AHEAD);
#pragma unroll
        for (int n = 0; n < AHEAD; ++n) {
            for (; bone < of[n]; ++bone) {
                if (to) to[3 * bone] = sum;
                if (word < 16) whole[16 * bone] = sum;
                sum = 0.0f;
            }
            sum += value[n];
        }
    }
}
""")
def gather_sums(
    chunk_bone: wp.array(dtype=int),
    moments: wp.array2d(dtype=vec16),
    other_moments: wp.array2d(dtype=vec12),
    e: int,
    own: int,
    taken: int,
    off: int,
    bones: wp.array2d(dtype=vec16),
    linear: wp.array2d(dtype=wp.vec3),
    angular: wp.array2d(dtype=wp.vec3),
):
    """Sum the moments of the ``bones`` about their joints over their chunks, and their momenta of three velocities.

    Row ``own`` of ``linear`` and ``angular`` gets the momenta of ``moments``, rows ``taken`` and ``off`` those of
    ``other_moments``.
    """
    ...


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
    """Add the momenta of bone ``b`` and all beyond to those of its parent ``a``."""
    arm = position[e, b] - position[e, a]
    angular[row, a] = angular[row, a] + angular[row, b] + wp.cross(arm, linear[row, b])
    linear[row, a] = linear[row, a] + linear[row, b]


# Each lane of a warp has a bone. Level by level, bones add the sums of their children, a child at a time.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
constexpr unsigned ALL = 0xffffffffu;
constexpr int VECTORS = 3;
const int bones = parent.shape[0], lane = threadIdx.x & 31, own = min(lane, bones - 1);
const int above = max(parent.data[own], 0);
const int depth = lane < bones ? depths.data[own] : -1, below = lane < bones ? children.data[own] : 0;
const wp::vec3 arm = wp::index(position, e, own) - wp::index(position, e, above);
float sum[VECTORS][6];
#pragma unroll
for (int v = 0; v < VECTORS; ++v)
#pragma unroll
    for (int c = 0; c < 3; ++c) {
        sum[v][c] = wp::index(linear, first + v * step, own)[c];
        sum[v][3 + c] = wp::index(angular, first + v * step, own)[c];
    }
#pragma unroll 1
for (int level = levels - 2; level >= 0; --level) {
    float given[VECTORS][6];
#pragma unroll
    for (int v = 0; v < VECTORS; ++v)
#pragma unroll
        for (int c = 0; c < 3; ++c) {
            const int i = (c + 1) % 3, j = (c + 2) % 3;
            given[v][c] = sum[v][c];
            given[v][3 + c] = sum[v][3 + c] + arm[i] * sum[v][j] - arm[j] * sum[v][i];
        }
    int left = depth == level ? below : 0;
#pragma unroll 1
    while (__any_sync(ALL, left != 0)) {
        const int from = left != 0 ? 31 - __clz(left) : lane;
        const float share = left != 0 ? 1.0f : 0.0f;
        left &= ~(1 << from);
#pragma unroll
        for (int v = 0; v < VECTORS; ++v)
#pragma unroll
            for (int c = 0; c < 6; ++c) sum[v][c] += share * __shfl_sync(ALL, given[v][c], from);
    }
}
__syncwarp();
#pragma unroll
for (int v = 0; v < VECTORS; ++v)
#pragma unroll
    for (int c = 0; c < 3; ++c) {
        if (lane < bones) wp::index(momentum, first + v * step, 3 + 3 * own + c) = sum[v][3 + c];
        if (lane == 0) wp::index(momentum, first + v * step, c) = sum[v][c];
    }
#endif
""")
def pass_down_in_warp(
    parent: wp.array(dtype=int),
    depths: wp.array(dtype=int),
    children: wp.array(dtype=int),
    levels: int,
    position: wp.array2d(dtype=wp.vec3),
    e: int,
    first: int,
    step: int,
    linear: wp.array2d(dtype=wp.vec3),
    angular: wp.array2d(dtype=wp.vec3),
    momentum: wp.array2d(dtype=float),
):
    """Run :func:`pass_down` for three velocities in a warp."""
    ...


@wp.func
def pass_down(
    body: Body,
    position: wp.array2d(dtype=wp.vec3),
    e: int,
    velocities: int,
    own: int,
    step: int,
    threads: int,
    # in and out
    linear: wp.array2d(dtype=wp.vec3),
    angular: wp.array2d(dtype=wp.vec3),
    # out
    momentum: wp.array2d(dtype=float),
):
    """Compute ``J^T m u`` from the momenta of the bones about their joints: each joint sums all bones beyond it.

    A warp does so for three velocities, a single thread for ``velocities`` of them: the first in row ``own``, the
    others ``step`` rows apart.
    """
    sync_threads(threads)
    if threads > 1:
        pass_down_in_warp(
            body.parent, body.depth, body.children, body.levels, position, e, own, step, linear, angular, momentum
        )  # fmt: skip
    else:
        for v in range(velocities):
            row = own + v * step
            for back in range(BONES - 1):
                b = BONES - 1 - back  # children come after their parents
                take_child(position, e, row, body.parent[b], b, linear, angular)
            for b in range(BONES):
                set_triple(momentum, row, 3 + 3 * b, angular[row, b])
            set_triple(momentum, row, 0, linear[row, 0])


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
    """Correct ``change[row]`` by a rigid motion so that the body's momentum is ``support``.

    Its angular momentum about the pelvis joint becomes ``moment``. With ``reaction`` 1 the momenta of the bones' sums
    are added to both. ``field`` are the rigid motions of the bones by ``change[row]``. Their blend has the momenta of
    the bones' own sums, because weights add up to one.
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


#: A bound that is never reached.
UNBOUNDED = 1.0e30
#: Inertia of a locked joint, far above that of any body [kg m^2].
LOCK = 1.0e6
#: Damping over stiffness of the stop at the end of a joint's range [s].
STOP_TIME = wp.constant(0.03)


@wp.struct
class Springs:
    """Springs and dampers: of the pelvis' position, then of all joints, ``(1 or num_envs, 1 + bones)``.

    Those of the pelvis, ``[:, :2]``, are external support: an unsupported body has none. The others are muscles,
    limited by :class:`Strength`.
    """

    stiffness: wp.array2d(dtype=float)  # [N/m], then [N m/rad]
    damping: wp.array2d(dtype=float)  # [N s/m], then [N m s/rad]


@wp.struct
class Target:
    """Target pose of the springs, and additional torques; ``(num_envs, bones)`` and ``(num_envs,)``."""

    rotation: wp.array2d(dtype=wp.quat)  # local; of the pelvis in the world
    root: wp.array(dtype=wp.vec3)  # of the pelvis joint [m]
    torque: wp.array2d(dtype=wp.vec3)  # about the axes of the rest pose, as the parent has turned them [N m]
    factor: wp.array(dtype=float)  # (1 or num_envs,) on the torques [-]


@wp.struct
class Strength:
    """Greatest torques of the joints about the axes of the rest pose, as the parent has turned them; ``(bones,)``."""

    lower: wp.array(dtype=wp.vec3)  # [N m], not positive
    upper: wp.array(dtype=wp.vec3)  # [N m], not negative
    factor: wp.array(dtype=float)  # (1 or num_envs,) on both [-]


@wp.struct
class Tissue:
    """Passive resistance of the joints: slight damping, and stiff stops at the ends of their ranges; ``(bones,)``."""

    damping: wp.array(dtype=float)  # [N m s/rad]
    stop: wp.array(dtype=float)  # stiffness beyond the range [N m/rad]
    lower: wp.array(dtype=wp.vec3)  # range of the rotation vector relative to the rest pose [rad]
    upper: wp.array(dtype=wp.vec3)
    lock: wp.array(dtype=float)  # inertia of locked joints, else 0 [kg m^2]


def make_strength(lower: np.ndarray, upper: np.ndarray, rows: int, device: str) -> Strength:
    """Upload limits of the torques, each ``(22, 3)`` [N m], with a factor of 1 on them in ``rows`` rows."""
    return make_struct(
        Strength,
        lower=wp.array(lower.astype(np.float32), dtype=wp.vec3, device=device),
        upper=wp.array(upper.astype(np.float32), dtype=wp.vec3, device=device),
        factor=wp.full(rows, 1.0, dtype=float, device=device),
    )


def make_tissue(
    damping: np.ndarray, stop: np.ndarray, lower: np.ndarray, upper: np.ndarray, locked: Sequence[int], device: str
) -> Tissue:
    """Upload the passive resistance of the joints.

    Args:
        damping: of all joints, shape ``(22,)`` [N m s/rad].
        stop: stiffness beyond their ranges, shape ``(22,)`` [N m/rad].
        lower: of the ranges of the rotation vectors, shape ``(22, 3)`` [rad].
        upper: likewise.
        locked: joints that do not move: the bones beyond them are rigid extensions of their parents.
        device: Warp device.
    """
    lock = np.zeros(len(damping))
    lock[list(locked)] = LOCK
    numbers = {"damping": damping, "stop": stop, "lock": lock}
    arrays = {name: wp.array(v.astype(np.float32), dtype=float, device=device) for name, v in numbers.items()}
    for name, bound in (("lower", lower), ("upper", upper)):
        arrays[name] = wp.array(bound.astype(np.float32), dtype=wp.vec3, device=device)
    return make_struct(Tissue, **arrays)


@wp.func
def implicit_inertia(dt: float, stiffness: float, damping: float):
    """Return ``A = dt D + dt^2 K``: the inertia of a spring and a damper, implicit in time."""
    return dt * damping + dt * dt * stiffness


@wp.func
def resistance(tissue: Tissue, stop: float, b: int):
    """Return the damping of tissue, with that of the ``stop`` where the joint is beyond its range [N m s/rad]."""
    return tissue.damping[b] + STOP_TIME * stop


@wp.func
def above(body: Body, rotation: wp.array2d(dtype=wp.quat), e: int, b: int):
    """Return the rotation of a bone's parent; the pelvis has the world as its parent."""
    if b == 0:
        return wp.quat(0.0, 0.0, 0.0, 1.0)
    return rotation[e, body.parent[b]]


@wp.func
def beyond(local: wp.quat, lower: wp.vec3, upper: wp.vec3):
    """Return the change of the rotation vector that leads back into the range [rad]; zero within it.

    The range ends before half a turn, even at the corners of the box: there rotation vectors jump, and a stop would
    push outwards.
    """
    v = quat_log(local)
    return short_of_pi(wp.max(lower, wp.min(v, upper))) - v


@wp.func
def stopping_torque(local: wp.quat, lower: wp.vec3, upper: wp.vec3):
    """Return the torque of the stop over its stiffness, in the frame of the parent [rad].

    It is conservative: the gradient of half the square of :func:`beyond`.
    """
    return torque_of_vector(quat_log(local), beyond(local, lower, upper))


@wp.func
def implicit_diagonal(
    body: Body,
    dt: float,
    pose: Pose,
    springs: Springs,
    tissue: Tissue,
    e: int,
    n: int,
    into: int,
    # out
    stop: wp.array2d(dtype=float),
    diagonal: wp.array2d(dtype=float),
):
    """Write ``A``, and the stop stiffness (0 within the range); ``n`` 0 is the pelvis' position, joints follow."""
    r = row(e, springs.stiffness.shape[0])
    value = implicit_inertia(dt, springs.stiffness[r, n], springs.damping[r, n])
    if n > 1:
        b = n - 1
        local = wp.quat_inverse(pose.rotation[e, body.parent[b]]) * pose.rotation[e, b]
        stiff = float(0.0)
        if wp.length(beyond(local, tissue.lower[b], tissue.upper[b])) > 0.0:
            stiff = tissue.stop[b]
        stop[e, b] = stiff
        value += implicit_inertia(dt, stiff, resistance(tissue, stiff, b)) + tissue.lock[b]
    set_triple(diagonal, into, 3 * n, wp.vec3(value))


@wp.func
def joint_impulse(
    body: Body,
    dt: float,
    pose: Pose,
    target: Target,
    springs: Springs,
    tissue: Tissue,
    stop: wp.array2d(dtype=float),
    q: wp.array2d(dtype=float),
    outside: wp.array2d(dtype=float),
    e: int,
    n: int,
    # out
    muscle: wp.array2d(dtype=float),
    impulse: wp.array2d(dtype=float),
):
    """Write the impulses of a joint at ``d = 0``: of muscles alone, and with tissue.

    Actions apply no torque to the pelvis.
    """
    r = row(e, springs.stiffness.shape[0])
    K = springs.stiffness[r, n]
    v = triple_of(q, e, 3 * n) + triple_of(outside, e, 3 * n)
    active = wp.vec3()
    passive = wp.vec3()
    if n == 0:
        active = dt * K * (target.root[e] - pose.position[e, 0])
    else:
        b = n - 1
        frame = above(body, pose.rotation, e, b)
        local = wp.quat_inverse(frame) * pose.rotation[e, b]
        push = K * quat_log(target.rotation[e, b] * wp.quat_inverse(local))
        if b > 0:
            push += target.factor[row(e, target.factor.shape[0])] * target.torque[e, b]
            stiff = stop[e, b]
            passive = dt * stiff * wp.quat_rotate(frame, stopping_torque(local, tissue.lower[b], tissue.upper[b]))
            passive -= implicit_inertia(dt, stiff, resistance(tissue, stiff, b)) * v
        active = dt * wp.quat_rotate(frame, push)
    active -= implicit_inertia(dt, K, springs.damping[r, n]) * v
    set_triple(muscle, e, 3 * n, active)
    set_triple(impulse, e, 3 * n, active + passive)


@wp.func
def limit_torque(
    body: Body,
    dt: float,
    pose: Pose,
    springs: Springs,
    strength: Strength,
    muscle: wp.array2d(dtype=float),
    rest: float,
    change: wp.array2d(dtype=float),
    row_of_change: int,
    again: bool,
    e: int,
    n: int,
    # in and out
    impulse: wp.array2d(dtype=float),
    left: wp.array2d(dtype=float),
) -> float:
    """Limit a muscle's impulse to its strength; return 1 if it was limited, else 0.

    ``left`` gets the implicit diagonal ``rest``, reduced by the ``A`` of a spring that was limited. With ``again``,
    joints already limited are skipped.
    """
    limited = float(0.0)
    r = row(e, springs.stiffness.shape[0])
    A = implicit_inertia(dt, springs.stiffness[r, n], springs.damping[r, n])
    if again and (left[e, 3 * n] != rest or A == 0.0):
        return limited
    if n > 1:
        before = triple_of(muscle, e, 3 * n)
        frame = above(body, pose.rotation, e, n - 1)
        limit = dt * strength.factor[row(e, strength.factor.shape[0])]
        own = wp.quat_rotate_inv(frame, before - A * triple_of(change, row_of_change, 3 * n))
        cut = wp.max(limit * strength.lower[n - 1], wp.min(own, limit * strength.upper[n - 1]))
        if wp.length_sq(cut - own) > 0.0:
            rest -= A
            limited = 1.0
            set_triple(impulse, e, 3 * n, triple_of(impulse, e, 3 * n) - before + wp.quat_rotate(frame, cut))
    set_triple(left, e, 3 * n, wp.vec3(rest))
    return limited


@wp.func
def find_given(
    left: wp.array2d(dtype=float),
    change: wp.array2d(dtype=float),
    row_of_change: int,
    e: int,
    thread: int,
    threads: int,
    # in and out
    impulse: wp.array2d(dtype=float),
):
    """Compute the impulses of joints and pelvis at the end of the substep: subtract ``left`` times the change."""
    for i in range(thread, NUM_DOF, threads):
        impulse[e, i] = impulse[e, i] - left[e, i] * change[row_of_change, i]
