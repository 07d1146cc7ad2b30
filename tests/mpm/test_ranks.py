"""Parts of the particles are put in order by what they have to do."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.ranks import (
    NEAR_BOUNDARY,
    PART,
    TELLING,
    Ranks,
    allocate_ranks,
    forget_ranks,
    raise_rank,
    record_order,
)

wp.set_module_options({"enable_backward": False})


@wp.kernel
def raise_ranks(rank: wp.array2d(dtype=int), ranks: Ranks):
    e, p = wp.tid()
    raise_rank(ranks, e, p, rank[e, p])


@wp.kernel
def forget(ranks: Ranks):
    forget_ranks(ranks, wp.tid())


@pytest.mark.parametrize("num_particles", [1, 33, 4000])
def test_parts_are_in_order_of_their_highest_rank(device, num_particles):
    """Each has one place; and again, when everything has been forgotten."""
    rng = np.random.default_rng(2)
    ranks = allocate_ranks(3, num_particles, device)
    parts = -(-num_particles // int(PART))
    assert ranks.order.shape == (3, parts)
    program = Program(device)
    record_order(program, ranks)
    for share in (0.05, 0.0, 0.01):
        rank = rng.choice(
            [0, int(TELLING), int(NEAR_BOUNDARY)], (3, num_particles), p=[1 - share, 0.6 * share, 0.4 * share]
        )
        rank[:, 0] = [0, int(TELLING), int(NEAR_BOUNDARY)]
        padded = np.pad(rank, ((0, 0), (0, parts * int(PART) - num_particles)))
        highest = padded.reshape(3, parts, -1).max(2)
        wp.launch(raise_ranks, rank.shape, [wp.array(rank, dtype=int, device=device)], [ranks], device=device)
        assert np.array_equal(ranks.rank.numpy(), highest)
        program.run()
        order = ranks.order.numpy()
        assert np.array_equal(np.sort(order, 1), np.tile(np.arange(parts), (3, 1)))
        assert np.all(np.diff(np.take_along_axis(highest, order, 1), axis=1) <= 0)
        wp.launch(forget, 3, [], [ranks], device=device)
        assert not ranks.rank.numpy().any() and not ranks.count.numpy().any()
