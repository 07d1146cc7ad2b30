"""The list of nodes at which fields may touch."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from piavatar_envs.mpm.meeting import (
    FEWEST_NODES,
    NODES_AT_ONCE,
    Meeting,
    begin_lists,
    begin_meeting,
    node_meeting,
    nodes_meeting,
    note_meeting,
    warps_of_meeting,
)

NODES = 64 * 5


@wp.kernel
def list_nodes(here: wp.array2d(dtype=bool), substep: int, meeting: Meeting):
    """A thread a node, as many in every environment."""
    e = wp.tid() // here.shape[1]
    n = wp.tid() % here.shape[1]
    if n == 0:
        begin_meeting(meeting, e, substep)
    note_meeting(meeting, e, substep, n, here[e, n])


@wp.kernel
def read_list(substep: int, meeting: Meeting, count: wp.array(dtype=int), node: wp.array2d(dtype=wp.vec2i)):
    """Also beyond its end."""
    e, n = wp.tid()
    count[e] = nodes_meeting(meeting, e, substep)
    node[e, n] = node_meeting(meeting, e, substep, n)


def model_of(device: str, num_envs: int, blocks: int) -> SimpleNamespace:
    return SimpleNamespace(
        device=device, num_envs=num_envs, max_slots=2 * blocks, contact=SimpleNamespace(num_fields=2)
    )


def test_every_node_is_listed_once(device):
    """Of each environment, in one substep for the next, which reads that list while it writes another."""
    if device == "cpu":
        pytest.skip("relays are a GPU's")
    rng = np.random.default_rng(4)
    meeting = begin_lists(model_of(device, 3, NODES // 64))
    count = wp.zeros(3, dtype=int, device=device)
    node = wp.zeros((3, NODES + 7), dtype=wp.vec2i, device=device)
    listed = np.zeros((3, NODES), bool)
    for substep, share in enumerate((0.1, 1.0, 0.0, 0.5, 0.02, 0.0, 0.3), start=-1):
        here = rng.random((3, NODES)) < share
        here[1, :40] = False  # a warp has none, the next some
        inputs = [wp.array(here, dtype=bool, device=device), substep]
        wp.launch(list_nodes, 3 * NODES, inputs, [meeting], device=device, block_dim=128)
        for at, expected in ((substep, listed), (substep + 1, here)):
            if at < 0:
                continue
            wp.launch(read_list, node.shape, [at, meeting], [count, node], device=device)
            assert count.numpy().tolist() == expected.sum(1).tolist()
            for found, own, number in zip(node.numpy(), expected, count.numpy(), strict=True):
                assert np.array_equal(np.sort(found[:number] @ [64, 1]), np.flatnonzero(own))
        listed = here


@pytest.mark.parametrize("num_envs", [1, 64, 4096])
@pytest.mark.parametrize("blocks", [1, 7, 9000])
def test_environments_have_warps(num_envs, blocks):
    """Many if there are few environments; never more than nodes."""
    warps = warps_of_meeting(model_of("cpu", num_envs, blocks))
    assert min(FEWEST_NODES, 64 * blocks) <= warps <= 64 * blocks
    assert warps == 64 * blocks or num_envs * warps >= NODES_AT_ONCE
