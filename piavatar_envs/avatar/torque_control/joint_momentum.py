"""Momentum at the joints: ``J^T m u`` from sums over particles, and changes of velocity that keep the body's momentum.

The symbols are those of :mod:`piavatar_envs.avatar.torque_control.articulated_body`. ``J^T`` is applied to the momenta
of the bones, from the tips of the limbs to the pelvis: each joint sums all bones beyond it.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.skinning import motion_at
from piavatar_envs.avatar.torque_control.joint_motion import add_ancestors3, set_triple
from piavatar_envs.avatar.torque_control.mass_matrix import BONES, I3, NUM_DOF
from piavatar_envs.avatar.tracking import inertia_of, point_inertia, spin_of, summed_second_moment, symmetric
from piavatar_envs.avatar.types import Body
from piavatar_envs.core.arrays import vec8, vec12, vec16
from piavatar_envs.core.cuda_intrinsics import (
    sum_threads16,
    sync_threads,
)

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


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
def predict_velocity(
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


@wp.func
def expect_half(
    change: wp.array2d(dtype=float),
    row: int,
    dt: float,
    e: int,
    thread: int,
    threads: int,
    # in and out
    outside: wp.array2d(dtype=float),
):
    """Add half the substep's change by bias forces, ``change[row]`` [1/s], to the predicted change ``outside``.

    ``outside`` contains their whole change, with the opposite sign. Half of it the particles have when they move.
    """
    sync_threads(threads)
    for i in range(thread, NUM_DOF, threads):
        outside[e, i] = outside[e, i] + 0.5 * dt * change[row, i]


@wp.func
def centripetal(
    body: Body, position: wp.array2d(dtype=wp.vec3), moving: wp.array2d(dtype=vec8), e: int, b: int
) -> wp.vec3:
    """Return the acceleration of joint ``b`` relative to its parent, of constant ``qdot`` [m/s^2]; 0 for the pelvis."""
    if b == 0:
        return wp.vec3()
    a = body.parent[b]
    spin = wp.vec3(moving[e, a][3], moving[e, a][4], moving[e, a][5])
    return wp.cross(spin, wp.cross(spin, position[e, b] - position[e, a]))


@wp.func
def bias_forces(
    body: Body,
    position: wp.array2d(dtype=wp.vec3),
    bones: wp.array2d(dtype=vec16),
    moving: wp.array2d(dtype=vec8),
    row: int,
    e: int,
    thread: int,
    threads: int,
    # out
    linear: wp.array2d(dtype=wp.vec3),
    angular: wp.array2d(dtype=wp.vec3),
):
    """Write ``m Jdot qdot`` of every bone to ``linear[row]`` [N], its moment about the joint to ``angular[row]`` [N m].

    These are the centripetal and Coriolis terms of articulated bodies (Featherstone, Rigid Body Dynamics Algorithms,
    2008, section 5.2), from the bones' moments and their rigid motions ``moving``. Spins of joints relative to their
    parents are components of ``qdot`` in the world frame, so constant ones turn no bone faster.
    """
    sync_threads(threads)
    if threads == 1:
        for b in range(BONES):
            pull = centripetal(body, position, moving, e, b)
            if b > 0:
                pull += angular[row, body.parent[b]]
            angular[row, b] = pull
    else:
        own = wp.min(thread, BONES - 1)
        pull = add_ancestors3(centripetal(body, position, moving, e, own), body.parent[own], body.levels)
        if thread < BONES:
            angular[row, own] = pull
    for b in range(thread, BONES, threads):
        s = bones[e, b]
        spin = wp.vec3(moving[e, b][3], moving[e, b][4], moving[e, b][5])
        first = wp.vec3(s[1], s[2], s[3])
        pull = angular[row, b]
        linear[row, b] = s[0] * pull + wp.cross(spin, wp.cross(spin, first))
        angular[row, b] = wp.cross(first, pull) - wp.cross(spin, summed_second_moment(s) * spin)


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
    const auto load = [&](int first) {
#pragma unroll
        for (int n = 0; n < AHEAD; ++n) {
            const int c = first + n;
            next[n] = c < chunks ? from[words * c] : 0.0f;
            next_bone[n] = c < chunks ? chunk_bone.data[c] : last;
        }
    };
    load(0);
    for (int first = 0; bone < last; first += AHEAD) {
        float value[AHEAD];
        int of[AHEAD];
#pragma unroll
        for (int n = 0; n < AHEAD; ++n) value[n] = next[n], of[n] = next_bone[n];
        load(first + AHEAD);
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
def add_child(
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
constexpr int VECTORS = 4;
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
    """Run :func:`pass_down` for four velocities in a warp."""
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

    A warp does so for four velocities, a single thread for ``velocities`` of them: the first in row ``own``, the
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
                add_child(position, e, row, body.parent[b], b, linear, angular)
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
        inertia = inertia_of(summed_second_moment(s))
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
