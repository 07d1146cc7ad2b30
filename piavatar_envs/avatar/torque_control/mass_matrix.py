"""Mass matrix of a skinned body's joints, ``M = J^T m J`` with the skinning Jacobian ``J`` at the particles.

A joint ``c`` turns all bones beyond it about its position ``p_c``. With ``W_pc``, the sum of a particle's weights of
these bones, the velocity of the joints moves a particle by

    v_p = v_0 + sum_c W_pc  w_c x (x_p - p_c),

where ``v_0`` is the velocity of the pelvis, ``w_0`` its spin, and ``w_c`` the angular velocity of a joint relative to
its parent, in the world's axes. The generalised velocity is ``(v_0, w_0, ..., w_21)``, 69 numbers. The block of two
joints is

    M_cd = sum_p m W_pc W_pd ((a . b) I - b a^T),   a = x_p - p_c,  b = x_p - p_d.

``J`` is never stored. A particle has at most four bones, so few pairs of bones share particles. The moments of each
pair are summed over fixed lists (no atomics), then from bone to bone up the tree, once for each of the two joints (the
composite bodies of Featherstone, "Rigid Body Dynamics Algorithms", 2008, ch. 6, but for bodies that share matter).
Moments are always about the joints at hand: about a common point, a hand's inertia would be the small difference of
large numbers. The moments of the matter that a bone moves alone need no lists, because the weights of a particle add up
to one: they are those of all matter that the bone moves, which other stages need too, less those of its pairs.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.device import CHUNK, BodyPoints
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, PARENTS
from piavatar_envs.avatar.segment_sums import AT_ONCE, own_share, share_chunks, store_one, warps_of
from piavatar_envs.avatar.skinning import in_order
from piavatar_envs.avatar.torque_control.tree_cholesky import (
    Pattern,
    factor_size,
    find_pattern,
    lower_entries,
    set_in_arenas,
)
from piavatar_envs.avatar.tracking import inertia_of, summed_second_moment, symmetric
from piavatar_envs.avatar.types import Body
from piavatar_envs.core.arrays import add_rows12, add_rows16, float_at, int_at, number_at, vec12, vec16, vector_at
from piavatar_envs.core.cuda_intrinsics import BLOCK, highest_bit, sum_threads16, sync_block, warp_threads
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.types import Model, Particles, State, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def two_sided(m: float, first: wp.vec3, second: wp.mat33):
    """Return the moments of two joints as one record: ``sum m``, ``sum m a`` and, by rows, ``sum m b a^T``."""
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
    """Return ``sum m b a^T`` of a record."""
    return wp.mat33(s[4], s[5], s[6], s[7], s[8], s[9], s[10], s[11], s[12])


@wp.func
def moved(s: vec16, alpha: wp.vec3, beta: wp.vec3):
    """Return the record with ``a + alpha`` and ``b + beta``: for one joint, or any two where ``alpha`` is zero."""
    m = s[0]
    first = wp.vec3(s[1], s[2], s[3])
    both = second_moment(s) + wp.outer(first, alpha) + wp.outer(beta, first) + m * wp.outer(beta, alpha)
    return two_sided(m, first + m * alpha, both)


# On a GPU the records of pairs are in shared memory, word by word, with rows an odd number of words apart, so that
# threads read from different banks along rows and along columns.
_ROW, _WORDS = NUM_JOINTS + 1 - NUM_JOINTS % 2, 13
_WORD = _ROW * NUM_JOINTS
#: First word of the joint positions, which follow all records.
PLACES = wp.constant(_WORDS * _WORD)


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
__shared__ float __align__(16) words[{_WORDS * _WORD + 3 * NUM_JOINTS}];
return reinterpret_cast<wp::uint64>(words + at);
#else
return reinterpret_cast<wp::uint64>(scratch.data);
#endif
""")
def record_arena(scratch: wp.array(dtype=vec16), at: int) -> wp.uint64:
    """Return the arena of an environment's records: a CUDA block's shared memory from word ``at``, or ``scratch``."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
const float* const from = reinterpret_cast<const float*>(records) + {_ROW} * c + d;
wp::vec_t<16, wp::float32> value;
#pragma unroll
for (int k = 0; k < {_WORDS}; ++k) value[k] = from[{_WORD} * k];
return value;
#else
return reinterpret_cast<const wp::vec_t<16, wp::float32>*>(records)[{NUM_JOINTS} * c + d];
#endif
""")
def read_pair(records: wp.uint64, c: int, d: int) -> vec16:
    """Return the record of bones ``c`` and ``d``."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
float* const to = reinterpret_cast<float*>(records) + {_ROW} * c + d;
#pragma unroll
for (int k = 0; k < {_WORDS}; ++k) to[{_WORD} * k] = value[k];
#else
reinterpret_cast<wp::vec_t<16, wp::float32>*>(records)[{NUM_JOINTS} * c + d] = value;
#endif
""")
def write_pair(records: wp.uint64, c: int, d: int, value: vec16):
    """Write the record of bones ``c`` and ``d``."""
    ...


@wp.func
def lift(s: vec16, step: wp.vec3, away: wp.vec3):
    """Return the record with ``a + step``; ``away`` is ``b - a``."""
    first = wp.vec3(s[1], s[2], s[3])
    return two_sided(s[0], first + s[0] * step, second_moment(s) + wp.outer(first + s[0] * away, step))


@wp.func
def transposed(s: vec16, away: wp.vec3):
    """Return the record with ``a`` and ``b`` exchanged; ``away`` is ``b - a``."""
    return two_sided(s[0], wp.vec3(s[1], s[2], s[3]) + s[0] * away, wp.transpose(second_moment(s)))


@wp.struct
class Pairs:
    """Pairs of bones that share particles: lists in chunks, as those of :class:`piavatar_envs.avatar.types.Body`."""

    # (bones * bones,) pair of two bones; -1 where they have no particle in common, and for a bone with itself
    of: wp.array(dtype=int)
    # bone c has particles in common with others neighbors[neighbor_start[c] : neighbor_start[c + 1]]
    neighbor_start: wp.array(dtype=int)
    neighbors: wp.array(dtype=int)
    first: wp.array(dtype=int)  # (pairs,) first bone of a pair; its joint is the reference of the moments
    second: wp.array(dtype=int)  # (pairs,) the other one
    quarters: wp.array(dtype=wp.vec4i)  # of warps that share chunks, see piavatar_envs.avatar.segment_sums
    chunk_start: wp.array(dtype=int)  # (pairs + 1,) pair q owns chunks chunk_start[q] : chunk_start[q + 1]
    entry: wp.array(dtype=int)
    entry_weight: wp.array(dtype=float)  # product of the two weights


def build_pairs(points: BodyPoints, device: str) -> Pairs:
    """Build the lists of all pairs of bones that share particles."""
    weights = points.skin_weights / points.skin_weights.sum(1, keepdims=True)
    shared, numbers, products = [], [], []  # particles, pairs of bones as numbers, and products of their weights
    for i, j in combinations(range(weights.shape[1]), 2):
        product = weights[:, i] * weights[:, j]
        shared.append(np.flatnonzero(product > 0.0))
        bones = np.sort(points.skin_joints[shared[-1]][:, [i, j]], axis=1)
        numbers.append(NUM_JOINTS * bones[:, 0] + bones[:, 1])
        products.append(product[shared[-1]])
    particle, number, product = (np.concatenate(found) for found in (shared, numbers, products))
    order = np.argsort(number.astype(np.uint16), kind="stable")  # 16 bits are sorted by digits, in linear time
    found, begins = np.unique(number[order], return_index=True)
    first, second = np.divmod(found, NUM_JOINTS)
    of = np.full((NUM_JOINTS, NUM_JOINTS), -1)
    of[first, second] = of[second, first] = np.arange(len(found))
    sizes = np.diff([*begins, len(order)])
    chunks = -(-sizes // CHUNK)
    chunk_pair = np.repeat(np.arange(len(found)), chunks)
    within = np.arange(len(chunk_pair)) - np.repeat(np.cumsum(chunks) - chunks, chunks)
    borders = np.append(begins[chunk_pair] + CHUNK * within, len(order))
    pairs = Pairs()
    lists = {
        "of": of.ravel(),
        "neighbor_start": np.cumsum([0, *(of >= 0).sum(1)]),
        "neighbors": np.nonzero(of >= 0)[1],
        "first": first,
        "second": second,
        "chunk_start": np.cumsum([0, *chunks]),
        "entry": particle[order],
    }
    for name, values in lists.items():
        setattr(pairs, name, wp.array(np.asarray(values, np.int32), dtype=int, device=device))
    pairs.entry_weight = wp.array(product[order].astype(np.float32), dtype=float, device=device)
    quarters = share_chunks(np.arange(len(chunk_pair)), borders[:-1], borders[1:], first[chunk_pair], device)
    pairs.quarters = wp.array(quarters, dtype=wp.vec4i, device=device)
    return pairs


@wp.kernel(launch_bounds=(BLOCK, 12))
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
    """Sum mass, first and second moment of chunks about a joint; over ``(num_envs, warps of the quarters, threads)``.

    ``position`` holds the joint positions [m].
    """
    i, j, k = wp.tid()
    e, share = own_share(pairs.quarters, i, j, k, threads)
    origin = vector_at(position, e, share[1] & 255)
    r = row(e, particles.mass.shape[0])
    m = float(0.0)
    mx = wp.vec3()
    diag = wp.vec3()
    off = wp.vec3()
    n = share[2]
    last = share[3] - 1
    while n <= last:
        for _ in range(AT_ONCE):
            entry = wp.min(n, last)
            p = body.first + int_at(pairs.entry, entry)
            w = wp.where(n > last, 0.0, float_at(pairs.entry_weight, entry)) * number_at(particles.mass, r, p)
            d = vector_at(x, e, p) - origin
            wd = w * d
            m += w
            mx += wd
            diag += wp.cw_mul(wd, d)
            off += wp.vec3(wd[1] * d[2], wd[2] * d[0], wd[0] * d[1])
            n += share[1] >> 8
    total = vec12(m, mx[0], mx[1], mx[2], diag[0], diag[1], diag[2], off[0], off[1], off[2], 0.0, 0.0)
    store_one(sums, e, share, total)


#: Components of a generalised velocity: the pelvis' velocity, then the angular velocities of all joints.
NUM_DOF = 3 + 3 * NUM_JOINTS
BONES = wp.constant(NUM_JOINTS)
#: Pairs of bones whose blocks are in the lower triangle.
LOWER = wp.constant(NUM_JOINTS * (NUM_JOINTS + 1) // 2)
#: Lanes that share the sums of a bone.
LANES = wp.constant(4)
I3 = wp.constant(wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))


def filled_entries(pairs: Pairs) -> np.ndarray:
    """Return the mask of the entries that may be nonzero, ``(69, 69)`` bool: those of joints with common matter."""
    shared = (pairs.of.numpy().reshape(NUM_JOINTS, NUM_JOINTS) >= 0) | np.eye(NUM_JOINTS, dtype=bool)
    for columns in (False, True):
        for bone in range(NUM_JOINTS - 1, 0, -1):  # children come after their parents
            view = shared.T if columns else shared
            view[PARENTS[bone]] |= view[bone]
    joints = np.kron(shared, np.ones((3, 3), bool))
    filled = np.ones((NUM_DOF, NUM_DOF), bool)
    filled[3:, 3:] = joints
    return filled


@wp.func
def place_pair(
    pairs: Pairs,
    sums: wp.array2d(dtype=vec12),
    position: wp.array2d(dtype=wp.vec3),
    e: int,
    pair: int,
    # out
    records: wp.uint64,
):
    """Store the moments of the matter that both bones of a pair move, about their joints, in either order."""
    c = pairs.first[pair]  # the sums are about its joint
    d = pairs.second[pair]
    s = add_rows12(sums, e, pairs.chunk_start[pair], pairs.chunk_start[pair + 1])
    second = symmetric(wp.vec3(s[4], s[5], s[6]), wp.vec3(s[7], s[8], s[9]))
    own = two_sided(s[0], wp.vec3(s[1], s[2], s[3]), second)
    here = wp.vec3()
    to_d = position[e, c] - position[e, d]
    write_pair(records, c, d, moved(own, here, to_d))
    write_pair(records, d, c, moved(own, to_d, here))


@wp.func
def place_bone(
    body: Body,
    pairs: Pairs,
    moments: wp.array2d(dtype=vec16),
    position: wp.array2d(dtype=wp.vec3),
    e: int,
    c: int,
    thread: int,
    threads: int,
    # in and out
    records: wp.uint64,
):
    """Store the moments of the matter that a bone moves alone, about its joint: all that it moves less its pairs.

    ``threads`` consecutive threads share the bone.
    """
    s = vec16()
    for n in range(body.chunk_start[c] + thread, body.chunk_start[c + 1], threads):
        s += add_rows16(moments, e, n, n + 1)
    own = two_sided(s[0], wp.vec3(s[1], s[2], s[3]), summed_second_moment(s))
    for n in range(pairs.neighbor_start[c] + thread, pairs.neighbor_start[c + 1], threads):
        d = pairs.neighbors[n]
        own -= moved(read_pair(records, c, d), wp.vec3(), position[e, d] - position[e, c])
    own = sum_threads16(own, threads)
    if thread == 0:
        write_pair(records, c, c, own)


@wp.func
def take_row(position: wp.array2d(dtype=wp.vec3), records: wp.uint64, e: int, a: int, b: int, other: int):
    """Return the moments shared by bone ``b``, with all beyond, and ``other``, moved to the parent ``a`` of ``b``."""
    step = position[e, b] - position[e, a]
    return lift(read_pair(records, b, other), step, position[e, b] - position[e, other])


@wp.func
def take_column(position: wp.array2d(dtype=wp.vec3), records: wp.uint64, e: int, a: int, b: int, other: int):
    """Return the same as :func:`take_row` with ``other`` as the first bone of the pair."""
    step = position[e, b] - position[e, a]
    away = position[e, other] - position[e, b]
    lifted = lift(transposed(read_pair(records, other, b), away), step, -away)
    return transposed(lifted, position[e, a] - position[e, other])


@wp.func
def compose_alone(body: Body, position: wp.array2d(dtype=wp.vec3), records: wp.uint64, e: int):
    """Add the shared moments of every bone to those of its parent, for both bones of all pairs, on a single thread."""
    for other in range(BONES):
        for back in range(BONES - 1):
            b = BONES - 1 - back  # children come after their parents
            a = body.parent[b]
            taken = take_row(position, records, e, a, b, other)
            write_pair(records, a, other, read_pair(records, a, other) + taken)
    for other in range(BONES):
        for back in range(BONES - 1):
            b = BONES - 1 - back
            a = body.parent[b]
            taken = take_column(position, records, e, a, b, other)
            write_pair(records, other, a, read_pair(records, other, a) + taken)


@wp.func
def compose_in_warp(
    body: Body,
    position: wp.array2d(dtype=wp.vec3),
    records: wp.uint64,
    e: int,
    rows: bool,
    thread: int,
    threads: int,
):
    """Run :func:`compose_alone` for one bone of the pairs; threads of a CUDA block share the pairs of a level."""
    for back in range(body.levels - 1):
        level = body.levels - 2 - back
        first = body.level_start[level]
        for n in range(thread, (body.level_start[level + 1] - first) * BONES, threads):
            a = first + n // BONES
            other = n % BONES
            children = body.children[a]
            if children != 0:
                c = wp.where(rows, a, other)
                d = wp.where(rows, other, a)
                own = read_pair(records, c, d)
                while children != 0:
                    b = highest_bit(children)
                    children -= 1 << b
                    if rows:
                        own += take_row(position, records, e, a, b, other)
                    else:
                        own += take_column(position, records, e, a, b, other)
                write_pair(records, c, d, own)
        sync_block()


@wp.func_native("return (int)((sqrtf(8.0f * (float)n + 1.0f) - 1.0f) * 0.5f);")
def row_of_pair(n: int) -> int:
    """Return the row of an entry of a lower triangle stored row by row."""
    ...


@wp.func
def fill_blocks(s: vec16, pattern: Pattern, c: int, d: int, at: wp.uint64):
    """Write the block of joints ``c`` and ``d`` of the mass matrix; with ``d`` 0 also those of the pelvis' velocity."""
    both = second_moment(s)
    own = (1 + c) * (1 + BONES)
    set_in_arenas(at, pattern.block[own + 1 + d], inertia_of(both))
    if d == 0:
        set_in_arenas(at, pattern.block[own], wp.skew(wp.vec3(s[1], s[2], s[3])))  # of v_0 . (w x a), transposed
        if c == 0:
            set_in_arenas(at, 0, s[0] * I3)


@wp.func
def fill_mass(pattern: Pattern, records: wp.uint64, thread: int, threads: int, at: wp.uint64):
    """Write the mass matrix to ``at`` from its records; on a GPU it replaces them in the same arena."""
    if threads == 1:
        for c in range(BONES):
            for d in range(c + 1):
                fill_blocks(read_pair(records, c, d), pattern, c, d, at)
    else:  # a thread has two blocks of the lower triangle, or one
        n = wp.min(thread + threads, LOWER - 1)
        c = row_of_pair(thread)
        d = thread - c * (c + 1) // 2
        far_c = row_of_pair(n)
        far_d = n - far_c * (far_c + 1) // 2
        s = read_pair(records, c, d)
        far = read_pair(records, far_c, far_d)
        sync_block()
        fill_blocks(s, pattern, c, d, at)
        if thread + threads < LOWER:
            fill_blocks(far, pattern, far_c, far_d, at)
    sync_block()


@wp.func
def compose_mass(
    body: Body,
    pairs: Pairs,
    sums: wp.array2d(dtype=vec12),
    moments: wp.array2d(dtype=vec16),
    position: wp.array2d(dtype=wp.vec3),
    pattern: Pattern,
    records: wp.uint64,
    e: int,
    thread: int,
    threads: int,
    at: wp.uint64,
):
    """Compose the mass matrix at ``at`` from the moments of pairs and of bones, by blocks of the ``pattern``.

    The moments of two bones become those of all matter that two joints carry: first for one bone of the pairs, then for
    the other. The threads of a CUDA block share the bones.
    """
    for n in range(thread, BONES * BONES, threads):
        write_pair(records, n // BONES, n % BONES, vec16())
    sync_block()
    for pair in range(thread, pairs.first.shape[0], threads):
        place_pair(pairs, sums, position, e, pair, records)
    sync_block()
    lanes = wp.min(threads, LANES)
    for n in range(thread, lanes * BONES, threads):
        place_bone(body, pairs, moments, position, e, n // lanes, n % lanes, lanes, records)
    sync_block()
    if threads == 1:
        compose_alone(body, position, records, e)
    else:
        compose_in_warp(body, position, records, e, True, thread, threads)
        compose_in_warp(body, position, records, e, False, thread, threads)
    fill_mass(pattern, records, thread, threads, at)


#: Greatest age of a mass matrix [s]; fast limbs become unstable with an older one.
LONGEST_REFRESH = 0.005
#: Most substeps that use the same mass matrix. In directions in which a turned limb has become much heavier, the
#: projection by an old matrix overshoots, and the error grows from substep to substep. The moments of its pairs must be
#: as new as the matrix: reusing older ones, turned with the bones, makes bodies on the floor unstable.
MOST_USES = 2
#: Share of the grid's additional inertia of flesh that is added for joints whose limbs are thinner than a cell.
#: Without it small bodies on the floor become unstable; ankles get less, because walking needs fast feet.
GRID_SHARES = {"elbow": 0.5, "wrist": 0.5, "ankle": 0.25}


def grid_inertia(points: BodyPoints, dx: float) -> np.ndarray:
    """Return the inertia that is added to light joints for the projection, ``(22,)`` [kg m^2].

    Between particles and nodes matter is spread: with quadratic weights by a mean square of ``dx^2/4`` along each axis
    (``D_p`` of Jiang et al. 2015), so that flesh of mass ``m`` turns on the grid with ``m dx^2/2`` in addition to its
    own inertia. Without this inertia a light joint takes over more velocity from a hand than the grid allows, and the
    exchange becomes unstable; a share of it is enough. Velocity that is not taken over stays with the particles, so no
    momentum is lost. The mass is that of the bones' flesh in the shape that the body is built with.

    The torque solve omits it: otherwise less of a torque would reach the ground. Heavier joints have none, because the
    reaction of the flesh's pull is projected too, and would be incomplete.
    """
    joints, weights = in_order(points.skin_joints, points.skin_weights)
    shares = weights * points.mass[0][:, None]
    mass = np.bincount(joints.ravel(), shares.ravel(), minlength=NUM_JOINTS)
    known = np.array([GRID_SHARES.get(name.split("_")[-1], 0.0) for name in JOINT_NAMES])
    return known * 0.5 * dx**2 * mass


class MassMatrix:
    """Mass matrix ``M = J^T m J`` of one avatar in every environment, with the sums that it is built from.

    Attributes:
        pairs: pairs of bones that share particles.
        sums: their moments, ``(num_envs, chunks)``.
        pattern: positions of the entries of its factors.
        matrix: the mass matrix, ``(num_envs, factor_size)``; see :meth:`read`.
        records: scratch memory of the composition on a CPU, one body after the other.
        refresh: number of substeps that use a matrix.
    """

    def __init__(self, points: BodyPoints, body: Body, model: Model) -> None:
        n, device = model.num_envs, model.device
        self.body, self.model, self.threads = body, model, warp_threads(device)
        self.pairs = build_pairs(points, device)
        self.pattern = find_pattern(filled_entries(self.pairs), device)
        self.matrix = self.make_factors(n)
        self.sums = wp.zeros((n, int(self.pairs.chunk_start.numpy()[-1])), dtype=vec12, device=device)
        self.records = wp.zeros(NUM_JOINTS * NUM_JOINTS, dtype=vec16, device=device)
        self.refresh = min(MOST_USES, max(1, int(LONGEST_REFRESH / model.step.dt + 1e-6)))

    def is_due(self, step: int) -> bool:
        """Return whether the matrix is rebuilt in substep ``step`` of a control step."""
        return step % self.refresh == 0

    def make_factors(self, systems: int) -> wp.array:
        """Allocate ``systems`` Cholesky factors, or matrices."""
        return wp.zeros((systems, factor_size(self.pattern)), dtype=float, device=self.model.device)

    def read(self) -> np.ndarray:
        """Return the mass matrices of all environments, ``(num_envs, 69, 69)``."""
        rows, columns, numbers = lower_entries(self.pattern)
        matrix = np.zeros((self.model.num_envs, NUM_DOF, NUM_DOF))
        matrix[:, rows, columns] = matrix[:, columns, rows] = self.matrix.numpy()[:, numbers]
        return matrix

    def record_sums(self, graph: LaunchGraph, state: State, position: wp.array) -> None:
        """Append the moments of all pairs for joints at ``position`` [m]."""
        graph.launch(
            sum_pairs,
            (self.sums.shape[0], warps_of(self.pairs.quarters, self.threads), self.threads),
            [self.body, self.pairs, self.model.particles, state.x, position, self.threads],
            [self.sums],
            block_dim=BLOCK,
        )
