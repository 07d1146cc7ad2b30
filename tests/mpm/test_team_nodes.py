"""A particle's threads have each of its 27 nodes once, know where they are, and what they weigh."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import warp as wp

from piavatar_envs.mpm.team_nodes import (
    MOST_OF_EIGHT,
    MOST_OF_FOUR,
    node_of_thread,
    place_of_node,
    record_in_team,
    records_of_thread,
    weights_of_thread,
)
from piavatar_envs.mpm.types import group, vec8, vec8i

wp.set_module_options({"enable_backward": False})


@wp.struct
class Nodes:
    """Of every particle and thread: what it has, also of each of its nodes, last."""

    node: wp.array3d(dtype=wp.vec3i)
    place: wp.array3d(dtype=wp.vec3)
    asked: wp.array3d(dtype=int)
    record: wp.array2d(dtype=vec8i)
    weight: wp.array2d(dtype=vec8)


@wp.func
def look(
    team: int, thread: int, base: wp.array(dtype=wp.vec3i), w: wp.array(dtype=wp.mat33), own: wp.vec2i, has: Nodes
):
    p = thread // team
    t = thread % team
    for n in range(MOST_OF_FOUR):
        if n < has.node.shape[2]:
            at = node_of_thread(team, base[p], n)
            has.node[p, t, n] = at
            has.place[p, t, n] = place_of_node(team, base[p], n)
            has.asked[p, t, n] = record_in_team(team, base[p], wp.max(at, wp.vec3i()), own)
    has.record[p, t] = records_of_thread(team, base[p], own)
    has.weight[p, t] = weights_of_thread(team, base[p], w[p][0], w[p][1], w[p][2])


@wp.kernel
def look_by_eight(base: wp.array(dtype=wp.vec3i), w: wp.array(dtype=wp.mat33), slot: wp.array2d(dtype=int), has: Nodes):
    own = wp.vec2i(64 * slot[wp.tid() // 8, wp.tid() % 8], 0)
    look(8, wp.tid(), base, w, own, has)


@wp.kernel
def look_by_four(base: wp.array(dtype=wp.vec3i), w: wp.array(dtype=wp.mat33), slot: wp.array2d(dtype=int), has: Nodes):
    p = wp.tid() // 4
    own = wp.vec2i(64 * slot[p, wp.tid() % 4], 64 * slot[p, wp.tid() % 4 + 4])
    look(4, wp.tid(), base, w, own, has)


@pytest.mark.parametrize(("team", "most"), [(8, int(MOST_OF_EIGHT)), (4, int(MOST_OF_FOUR))])
def test_a_team_has_every_node_once(device, team, most):
    if device == "cpu":
        pytest.skip("teams are a GPU's")
    rng = np.random.default_rng(1)
    base = np.array(list(itertools.product(range(4, 8), range(8, 12), range(4))))  # all places in a block
    count = len(base)
    w = rng.uniform(0.1, 0.9, (count, 3, 3)).astype(np.float32)
    slot = rng.permuted(np.tile(np.arange(8), (count, 1)), axis=1)

    def zeros(dtype, *shape):
        return wp.zeros((count, team, *shape), dtype=dtype, device=device)

    nodes = {"node": zeros(wp.vec3i, most), "place": zeros(wp.vec3, most), "asked": zeros(int, most)}
    has = group(Nodes, **nodes, record=zeros(vec8i), weight=zeros(vec8))
    inputs = [
        wp.array(value, dtype=dtype, device=device) for value, dtype in ((base, wp.vec3i), (w, wp.mat33), (slot, int))
    ]
    kernel = look_by_eight if team == 8 else look_by_four
    wp.launch(kernel, count * team, inputs, [has], device=device, block_dim=128)
    node, place, asked, record, weight = (
        getattr(has, name).numpy() for name in ("node", "place", "asked", "record", "weight")
    )
    for p in range(count):
        is_one = node[p, ..., 0] >= 0
        assert sorted(map(tuple, node[p][is_one])) == list(itertools.product(range(3), repeat=3))
        np.testing.assert_array_equal(place[p][is_one], node[p][is_one])
        at = base[p] % 4 + node[p][is_one]
        place_in_block = (at % 4) @ [16, 4, 1]
        expected = 64 * slot[p][(at // 4) @ [4, 2, 1]] + place_in_block
        np.testing.assert_array_equal(record[p, :, :most][is_one], expected)
        np.testing.assert_array_equal(asked[p][is_one], expected)
        along = np.take_along_axis(w[p], node[p][is_one].T, axis=1)
        np.testing.assert_allclose(weight[p, :, :most][is_one], along.prod(0), rtol=1e-6)
        assert not weight[p, :, :most][~is_one].any() and np.isin(record[p, :, :most][~is_one], expected).all()
        # of the first 18 nodes, those of two threads next to each other share a sector: an even place, and the next
        first, second = (record[p, n::2, : 16 // team].ravel() for n in (0, 1))
        assert np.all(first % 2 == 0) and np.all(second == first + 1)
