"""What every two bones of an avatar move both: lists of particles, and their moments.

What a bone has alone needs no lists: weights of a particle add up to one, so that it is what is left of all that the
bone moves. See :mod:`piavatar_envs.avatar.mass_matrix`.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.body import CHUNK, BodyPoints
from piavatar_envs.avatar.bone_sums import AT_ONCE
from piavatar_envs.avatar.lanes import BLOCK
from piavatar_envs.avatar.loads import float_at, int_at, number_at, vector_at
from piavatar_envs.avatar.quarters import own_share, share_chunks, store_one
from piavatar_envs.avatar.skeleton import NUM_JOINTS
from piavatar_envs.avatar.types import Body, vec12
from piavatar_envs.mpm.types import Particles, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.struct
class Pairs:
    """Particles that two bones move: lists in chunks, as those of :class:`piavatar_envs.avatar.types.Body`."""

    # (bones * bones,) pair of two bones; -1 where they have no particle in common, and for a bone with itself
    of: wp.array(dtype=int)
    # bone c has particles in common with others beside[beside_start[c] : beside_start[c + 1]]
    beside_start: wp.array(dtype=int)
    beside: wp.array(dtype=int)
    first: wp.array(dtype=int)  # (pairs,) one of the bones of a pair, about whose joint its moments are
    second: wp.array(dtype=int)  # (pairs,) the other one
    quarters: wp.array(dtype=wp.vec4i)  # of warps that share chunks, see piavatar_envs.avatar.quarters
    chunk_start: wp.array(dtype=int)  # (pairs + 1,) pair q owns chunks chunk_start[q] : chunk_start[q + 1]
    entry: wp.array(dtype=int)
    entry_weight: wp.array(dtype=float)  # product of the two weights


def build_pairs(points: BodyPoints, device: str) -> Pairs:
    """Lists of all pairs of two bones that have particles in common."""
    weights = points.skin_weights / points.skin_weights.sum(1, keepdims=True)
    particles: dict[tuple[int, int], list[np.ndarray]] = {}
    products: dict[tuple[int, int], list[np.ndarray]] = {}
    for i in range(4):
        for j in range(i + 1, 4):
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
        "beside_start": np.cumsum([0, *(of >= 0).sum(1)]),
        "beside": np.nonzero(of >= 0)[1],
        "first": [a for a, _ in sorted(particles)],
        "second": [b for _, b in sorted(particles)],
        "chunk_start": chunk_start,
        "entry": np.concatenate(entries),
    }
    for name, numbers in lists.items():
        setattr(pairs, name, wp.array(np.asarray(numbers, np.int32), dtype=int, device=device))
    pairs.entry_weight = wp.array(np.concatenate(entry_weights).astype(np.float32), dtype=float, device=device)
    first, borders = np.array(lists["first"])[chunk_pair], np.array(entry_start)
    quarters = share_chunks(np.arange(len(first)), borders[:-1], borders[1:], first, device)
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
    """Mass, first and second moment of chunks about a joint; over ``(num_envs, warps of the quarters, threads)``.

    ``position`` are those of the joints [m].
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
