"""Which particles of a relay are carried on first: those that take longest.

A launch has more CUDA blocks than a GPU has room for at once, and lasts as long as its last one. Those with particles
near a boundary take twice as long as others, those whose particles tell their nodes more than momentum take longer,
too. Where they come first, what comes last is short. Who they are is found when blocks are marked, for all substeps
until the next time; it changes slowly, and no result depends on it: sums are of whole numbers.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.types import group

wp.set_module_options({"enable_backward": False})

#: Particles of a part, which are carried on together; as many as a CUDA block has, where each has four threads.
PART = wp.constant(32)
#: Ranks of parts, from those that are nothing but momentum to those near a boundary.
RANKS = wp.constant(3)
TELLING, NEAR_BOUNDARY = wp.constant(1), wp.constant(2)


@wp.struct
class Ranks:
    """Parts of every environment's particles, in the order in which they are carried on."""

    order: wp.array2d(dtype=int)  # (num_envs, parts)
    rank: wp.array2d(dtype=int)  # (num_envs, parts) zero between relays
    # (num_envs, 2 RANKS) how many parts there are of each rank, and how many have a place; zero between relays
    count: wp.array2d(dtype=int)


def allocate_ranks(num_envs: int, num_particles: int, device: str) -> Ranks:
    """Nobody has a rank."""
    parts = -(-num_particles // int(PART))

    def zeros(count: int) -> wp.array:
        return wp.zeros((num_envs, count), dtype=int, device=device)

    return group(Ranks, order=zeros(parts), rank=zeros(parts), count=zeros(2 * int(RANKS)))


@wp.func
def raise_rank(ranks: Ranks, e: int, p: int, rank: int):
    """Particle ``p`` is of this ``rank``, and so its part of none below."""
    if rank > ranks.rank[e, p // PART]:
        wp.atomic_max(ranks.rank, e, p // PART, rank)


@wp.kernel
def count_ranks(ranks: Ranks):
    """How many parts there are of every rank."""
    e, part = wp.tid()
    wp.atomic_add(ranks.count, e, ranks.rank[e, part], 1)


@wp.kernel
def order_parts(ranks: Ranks):
    """Give every part a place, after those of higher rank."""
    e, part = wp.tid()
    rank = ranks.rank[e, part]
    place = wp.atomic_add(ranks.count, e, RANKS + rank, 1)
    for higher in range(RANKS):
        if higher > rank:
            place += ranks.count[e, higher]
    ranks.order[e, place] = part
    ranks.rank[e, part] = 0


@wp.func
def forget_ranks(ranks: Ranks, e: int):
    """Nothing has been counted, before ranks are found anew."""
    for n in range(2 * RANKS):
        ranks.count[e, n] = 0


def record_order(program: Program, ranks: Ranks) -> None:
    """Append what puts parts in order, their ranks having been found."""
    for kernel in (count_ranks, order_parts):
        program.launch(kernel, ranks.order.shape, [], [ranks])
