"""Mass matrix of a skinned body's joints, ``M = J^T m J`` with the skinning Jacobian ``J`` at the particles.

A joint ``c`` turns all that it carries about its place ``p_c``. With ``W_pc``, the sum of a particle's weights of the
bones beyond the joint, a velocity of the joints moves it by

    v_p = v_0 + sum_c W_pc  w_c x (x_p - p_c),

``v_0`` the velocity of the pelvis and ``w_0`` its spin, ``w_c`` the angular velocity of a joint against its parent, in
the world's axes. The generalised velocity is ``(v_0, w_0, ..., w_21)``, 69 numbers. The block of two joints is

    M_cd = sum_p m W_pc W_pd ((a . b) I - b a^T),   a = x_p - p_c,  b = x_p - p_d.

Nothing of the size of ``J`` is stored. A particle has four bones at most, so few pairs of bones have particles in
common; their moments are summed over fixed lists (no atomics), then from bone to bone up the tree, once for each of the
two joints (the composite bodies of Featherstone, "Rigid Body Dynamics Algorithms", 2008, ch. 6, but for bodies that
share matter). Moments are always about the joints at hand: about a common point, a hand's inertia would be the small
difference of large numbers.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.body import CHUNK, BodyPoints
from piavatar_envs.avatar.lanes import store_sum12
from piavatar_envs.avatar.rigid_fit import symmetric
from piavatar_envs.avatar.skeleton import NUM_JOINTS, PARENTS
from piavatar_envs.avatar.types import Body, vec12, vec16
from piavatar_envs.mpm.types import Particles, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Components of a generalised velocity: the pelvis' velocity, then the angular velocities of all joints.
NUM_DOF = 3 + 3 * NUM_JOINTS
BONES = wp.constant(NUM_JOINTS)
I3 = wp.constant(wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))


@wp.struct
class Pairs:
    """Particles that two bones move, or one: lists in chunks, as those of :class:`piavatar_envs.avatar.types.Body`."""

    of: wp.array(dtype=int)  # (bones * bones,) pair of two bones; -1 where they have no particle in common
    first: wp.array(dtype=int)  # (pairs,) one of the bones of a pair, about whose joint its moments are
    chunk_pair: wp.array(dtype=int)  # (chunks,)
    # pair q owns chunks chunk_start[q] : chunk_start[q + 1], chunk c holds entries entry_start[c] : entry_start[c + 1]
    chunk_start: wp.array(dtype=int)
    entry_start: wp.array(dtype=int)
    entry: wp.array(dtype=int)
    entry_weight: wp.array(dtype=float)  # product of the two weights


def build_pairs(points: BodyPoints, device: str) -> Pairs:
    """Lists of all pairs of bones that have particles in common, a bone with itself among them."""
    weights = points.skin_weights / points.skin_weights.sum(1, keepdims=True)
    particles: dict[tuple[int, int], list[np.ndarray]] = {}
    products: dict[tuple[int, int], list[np.ndarray]] = {}
    for i in range(4):
        for j in range(i, 4):
            product = weights[:, i] * weights[:, j]
            bones = np.sort(points.skin_joints[:, [i, j]], axis=1)
            for a, b in np.unique(bones[product > 0.0], axis=0):
                found = np.flatnonzero((product > 0.0) & (bones[:, 0] == a) & (bones[:, 1] == b))
                particles.setdefault((int(a), int(b)), []).append(found)
                products.setdefault((int(a), int(b)), []).append(product[found])
    of = np.full((NUM_JOINTS, NUM_JOINTS), -1)
    chunk_pair, chunk_start, entry_start, entries, entry_weights = [], [0], [0], [], []
    for pair, (a, b) in enumerate(sorted(particles)):
        of[a, b] = of[b, a] = pair
        found, product = np.concatenate(particles[a, b]), np.concatenate(products[a, b])
        for begin in range(0, len(found), CHUNK):
            entries.append(found[begin : begin + CHUNK])
            entry_weights.append(product[begin : begin + CHUNK])
            entry_start.append(entry_start[-1] + len(entries[-1]))
            chunk_pair.append(pair)
        chunk_start.append(len(entry_start) - 1)
    pairs = Pairs()
    lists = {
        "of": of.ravel(),
        "first": [a for a, _ in sorted(particles)],
        "chunk_pair": chunk_pair,
        "chunk_start": chunk_start,
        "entry_start": entry_start,
        "entry": np.concatenate(entries),
    }
    for name, numbers in lists.items():
        setattr(pairs, name, wp.array(np.asarray(numbers, np.int32), dtype=int, device=device))
    pairs.entry_weight = wp.array(np.concatenate(entry_weights).astype(np.float32), dtype=float, device=device)
    return pairs


def filled_entries(pairs: Pairs) -> np.ndarray:
    """Where the mass matrix need not be zero, shape ``(69, 69)`` bool: where two joints carry what moves with both."""
    shared = pairs.of.numpy().reshape(NUM_JOINTS, NUM_JOINTS) >= 0
    for columns in (False, True):
        for bone in range(NUM_JOINTS - 1, 0, -1):  # children come after their parents
            view = shared.T if columns else shared
            view[PARENTS[bone]] |= view[bone]
    joints = np.kron(shared, np.ones((3, 3), bool))
    filled = np.ones((NUM_DOF, NUM_DOF), bool)
    filled[3:, 3:] = joints
    return filled


@wp.kernel
def sum_pairs(
    body: Body,
    pairs: Pairs,
    particles: Particles,
    x: wp.array2d(dtype=wp.vec3),
    position: wp.array2d(dtype=wp.vec3),
    threads: int,
    # out
    sums: wp.array2d(dtype=vec12),
):
    """Mass, first and second moment of one chunk about a joint; launched over ``(num_envs, chunks, threads)``.

    ``position`` are those of the joints [m].
    """
    e, c, thread = wp.tid()
    origin = position[e, pairs.first[pairs.chunk_pair[c]]]
    r = row(e, particles.mass.shape[0])
    m = float(0.0)
    mx = wp.vec3()
    diag = wp.vec3()
    off = wp.vec3()
    for n in range(pairs.entry_start[c] + thread, pairs.entry_start[c + 1], threads):
        p = body.first + pairs.entry[n]
        w = pairs.entry_weight[n] * particles.mass[r, p]
        d = x[e, p] - origin
        wd = w * d
        m += w
        mx += wd
        diag += wp.cw_mul(wd, d)
        off += wp.vec3(wd[1] * d[2], wd[2] * d[0], wd[0] * d[1])
    total = vec12(m, mx[0], mx[1], mx[2], diag[0], diag[1], diag[2], off[0], off[1], off[2], 0.0, 0.0)
    store_sum12(sums, e, c, total, threads)


@wp.func
def two_sided(m: float, first: wp.vec3, second: wp.mat33):
    """Moments of two joints as one record: ``sum m``, ``sum m a`` and, by rows, ``sum m b a^T``."""
    # fmt: off
    return vec16(
        m, first[0], first[1], first[2],
        second[0, 0], second[0, 1], second[0, 2],
        second[1, 0], second[1, 1], second[1, 2],
        second[2, 0], second[2, 1], second[2, 2],
        0.0, 0.0, 0.0,
    )
    # fmt: on


@wp.func
def second_moment(s: vec16):
    """``sum m b a^T`` of a record."""
    return wp.mat33(s[4], s[5], s[6], s[7], s[8], s[9], s[10], s[11], s[12])


@wp.func
def moved(s: vec16, alpha: wp.vec3, beta: wp.vec3):
    """The record of a joint with itself, seen from two others: ``a + alpha`` and ``b + beta``."""
    m = s[0]
    first = wp.vec3(s[1], s[2], s[3])
    both = second_moment(s) + wp.outer(first, alpha) + wp.outer(beta, first) + m * wp.outer(beta, alpha)
    return two_sided(m, first + m * alpha, both)


@wp.kernel
def place_pairs(
    pairs: Pairs,
    sums: wp.array2d(dtype=vec12),
    position: wp.array2d(dtype=wp.vec3),
    # out
    moments: wp.array2d(dtype=vec16),
):
    """Moments of every two bones, zero where they share nothing; launched over ``(num_envs, bones * bones)``."""
    e, n = wp.tid()
    pair = pairs.of[n]
    if pair < 0:
        moments[e, n] = vec16()
        return
    s = vec12()
    for c in range(pairs.chunk_start[pair], pairs.chunk_start[pair + 1]):
        s += sums[e, c]
    second = symmetric(wp.vec3(s[4], s[5], s[6]), wp.vec3(s[7], s[8], s[9]))
    origin = position[e, pairs.first[pair]]
    alpha = origin - position[e, n // BONES]
    beta = origin - position[e, n % BONES]
    moments[e, n] = moved(two_sided(s[0], wp.vec3(s[1], s[2], s[3]), second), alpha, beta)


@wp.func
def lift(s: vec16, step: wp.vec3, away: wp.vec3):
    """The record with ``a + step``; ``away`` is ``b - a``."""
    first = wp.vec3(s[1], s[2], s[3])
    return two_sided(s[0], first + s[0] * step, second_moment(s) + wp.outer(first + s[0] * away, step))


@wp.func
def transposed(s: vec16, away: wp.vec3):
    """The record with ``a`` and ``b`` exchanged; ``away`` is ``b - a``."""
    return two_sided(s[0], wp.vec3(s[1], s[2], s[3]) + s[0] * away, wp.transpose(second_moment(s)))


@wp.kernel
def compose_moments(body: Body, position: wp.array2d(dtype=wp.vec3), columns: int, moments: wp.array2d(dtype=vec16)):
    """Add what every bone has to what its parent has, for one side of the pairs; launched over ``(num_envs, bones)``.

    Children come after their parents in the order of the bones. With ``columns`` 0 and then 1, the moments of two bones
    become those of all that two joints carry.
    """
    e, other = wp.tid()
    for n in range(BONES - 1):
        b = BONES - 1 - n
        a = body.parent[b]
        step = position[e, b] - position[e, a]
        if columns == 0:
            lifted = lift(moments[e, b * BONES + other], step, position[e, b] - position[e, other])
            moments[e, a * BONES + other] = moments[e, a * BONES + other] + lifted
        else:
            away = position[e, other] - position[e, b]
            lifted = lift(transposed(moments[e, other * BONES + b], away), step, -away)
            back = transposed(lifted, position[e, a] - position[e, other])
            moments[e, other * BONES + a] = moments[e, other * BONES + a] + back


@wp.func
def set_block(matrix: wp.array3d(dtype=float), e: int, i: int, j: int, block: wp.mat33):
    """Write 3 x 3 numbers."""
    for a in range(3):
        for b in range(3):
            matrix[e, i + a, j + b] = block[a, b]


@wp.kernel
def fill_mass_matrix(
    moments: wp.array2d(dtype=vec16),
    # out
    mass: wp.array3d(dtype=float),
):
    """Blocks of all pairs of joints, and those of the pelvis' velocity; launched over ``(num_envs, bones * bones)``.

    Only those of the lower triangle.
    """
    e, n = wp.tid()
    c = n // BONES
    d = n % BONES
    if d > c:
        return
    s = moments[e, n]
    both = second_moment(s)
    set_block(mass, e, 3 + 3 * c, 3 + 3 * d, wp.trace(both) * I3 - both)
    if d == 0:
        lever = -wp.skew(wp.vec3(s[1], s[2], s[3]))  # v_0 . (w x a)
        set_block(mass, e, 3 + 3 * c, 0, wp.transpose(lever))
        if c == 0:
            set_block(mass, e, 0, 0, s[0] * I3)
