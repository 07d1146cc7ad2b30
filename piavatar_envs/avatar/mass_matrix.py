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
difference of large numbers. Of what a bone moves alone nothing is summed: its moments are those of all that it moves,
which are there for other reasons, less those of its pairs.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.cholesky import Pattern
from piavatar_envs.avatar.lanes import add_rows12, add_rows16, highest_bit, sum_threads16
from piavatar_envs.avatar.mass_pairs import Pairs
from piavatar_envs.avatar.mass_records import lift, moved, read_pair, second_moment, transposed, two_sided, write_pair
from piavatar_envs.avatar.rigid_fit import symmetric
from piavatar_envs.avatar.skeleton import NUM_JOINTS, PARENTS
from piavatar_envs.avatar.types import Body, vec12, vec16
from piavatar_envs.avatar.warp_cholesky import set_in_rooms
from piavatar_envs.mpm.shared_memory import meet

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Components of a generalised velocity: the pelvis' velocity, then the angular velocities of all joints.
NUM_DOF = 3 + 3 * NUM_JOINTS
BONES = wp.constant(NUM_JOINTS)
#: Pairs of bones whose blocks are in the lower triangle.
LOWER = wp.constant(NUM_JOINTS * (NUM_JOINTS + 1) // 2)
#: Lanes that share what a bone moves.
LANES = wp.constant(4)
I3 = wp.constant(wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))


def filled_entries(pairs: Pairs) -> np.ndarray:
    """Where the mass matrix need not be zero, shape ``(69, 69)`` bool: where two joints carry what moves with both."""
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
    """Moments of what two bones both move, about their joints, for either as the first."""
    c = pairs.first[pair]  # about whose joint the sums are
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
    """Moments of what a bone moves alone, about its joint: of all that it moves, less what it moves with others.

    So many ``threads`` that follow each other share the bone.
    """
    s = vec16()
    for n in range(body.chunk_start[c] + thread, body.chunk_start[c + 1], threads):
        s += add_rows16(moments, e, n, n + 1)
    second = symmetric(wp.vec3(s[7], s[8], s[9]), wp.vec3(s[10], s[11], s[12]))
    own = two_sided(s[0], wp.vec3(s[1], s[2], s[3]), second)
    for n in range(pairs.beside_start[c] + thread, pairs.beside_start[c + 1], threads):
        d = pairs.beside[n]
        own -= moved(read_pair(records, c, d), wp.vec3(), position[e, d] - position[e, c])
    own = sum_threads16(own, threads)
    if thread == 0:
        write_pair(records, c, c, own)


@wp.func
def take_row(position: wp.array2d(dtype=wp.vec3), records: wp.uint64, e: int, a: int, b: int, other: int):
    """What bone ``b``, with all beyond, has in common with an ``other``, as bone ``a`` has it, which it hangs on."""
    step = position[e, b] - position[e, a]
    return lift(read_pair(records, b, other), step, position[e, b] - position[e, other])


@wp.func
def take_column(position: wp.array2d(dtype=wp.vec3), records: wp.uint64, e: int, a: int, b: int, other: int):
    """Likewise for the second bone of a pair, where the first is the ``other``."""
    step = position[e, b] - position[e, a]
    away = position[e, other] - position[e, b]
    lifted = lift(transposed(read_pair(records, other, b), away), step, -away)
    return transposed(lifted, position[e, a] - position[e, other])


@wp.func
def compose_alone(body: Body, position: wp.array2d(dtype=wp.vec3), records: wp.uint64, e: int):
    """Add what every bone has in common with another to what its parent has, for both sides; a thread, bone by bone."""
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
def compose_together(
    body: Body,
    position: wp.array2d(dtype=wp.vec3),
    records: wp.uint64,
    e: int,
    rows: bool,
    thread: int,
    threads: int,
):
    """:func:`compose_alone` of one side: the threads of a CUDA block share a level's bones and all others."""
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
        meet()


@wp.func_native("return (int)((sqrtf(8.0f * (float)n + 1.0f) - 1.0f) * 0.5f);")
def row_of_pair(n: int) -> int:
    """Row of entry ``n`` of a lower triangle whose rows follow each other."""
    ...


@wp.func
def fill_blocks(s: vec16, pattern: Pattern, c: int, d: int, at: wp.uint64):
    """The block of two joints of the mass matrix; those of the pelvis' velocity with the first joint's."""
    both = second_moment(s)
    own = (1 + c) * (1 + BONES)
    set_in_rooms(at, pattern.block[own + 1 + d], wp.trace(both) * I3 - both)
    if d == 0:
        set_in_rooms(at, pattern.block[own], wp.skew(wp.vec3(s[1], s[2], s[3])))  # of v_0 . (w x a), transposed
        if c == 0:
            set_in_rooms(at, 0, s[0] * I3)


@wp.func
def fill_mass(pattern: Pattern, records: wp.uint64, thread: int, threads: int, at: wp.uint64):
    """The mass matrix ``at`` its place from its records, which are there, too, on a GPU, and where it goes twice."""
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
        meet()
        fill_blocks(s, pattern, c, d, at)
        if thread + threads < LOWER:
            fill_blocks(far, pattern, far_c, far_d, at)
    meet()


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
    """The mass matrix, ``at`` its place, from the moments of pairs and of bones, by blocks of the ``pattern``.

    Moments of every two bones become those of all that two joints carry: first for one side of the pairs, then for the
    other. The threads of a CUDA block share the bones.
    """
    for n in range(thread, BONES * BONES, threads):
        write_pair(records, n // BONES, n % BONES, vec16())
    meet()
    for pair in range(thread, pairs.first.shape[0], threads):
        place_pair(pairs, sums, position, e, pair, records)
    meet()
    lanes = wp.min(threads, LANES)
    for n in range(thread, lanes * BONES, threads):
        place_bone(body, pairs, moments, position, e, n // lanes, n % lanes, lanes, records)
    meet()
    if threads == 1:
        compose_alone(body, position, records, e)
    else:
        compose_together(body, position, records, e, True, thread, threads)
        compose_together(body, position, records, e, False, thread, threads)
    fill_mass(pattern, records, thread, threads, at)
