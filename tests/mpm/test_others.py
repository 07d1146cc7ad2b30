"""Who is noted to have other fields at a node."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.mpm.records import TO_KINEMATIC


@pytest.fixture
def heap(meet, device):
    """Three boxes that come together on a floor, added up by groups."""
    if device == "cpu":
        pytest.skip("groups are a GPU's")
    bodies = [
        {"box": ((-0.23, -0.1, -0.1), (-0.03, 0.1, 0.1)), "velocity": (2.0, 0.2, -0.3)},
        {"box": ((0.0, -0.08, -0.1), (0.2, 0.12, 0.1)), "velocity": (-1.5, 0.0, -0.3), "density": 600.0},
        {"box": ((-0.1, -0.1, 0.13), (0.1, 0.1, 0.23)), "velocity": (0.0, 0.0, -3.0)},
    ]
    return meet(bodies, num_substeps=5, planes=[((0.0, 0.0, 1.0), -0.11, 0.5)], scatter="runs", control_dt=0.005)


def test_bits_are_nodes_where_others_have_mass(heap):
    """Of every field in every block that has several; none elsewhere."""
    heap.run(2)
    blocks, count = heap.scratch.blocks, heap.model.num_blocks
    mass = heap.scratch.velocity.numpy()[0, :, 0]
    fields, slot, held = (getattr(blocks, name).numpy()[0] for name in ("fields", "slot", "held"))
    used = int(blocks.count.numpy()[0])
    bits = np.unpackbits(blocks.others.numpy()[0].view(np.uint8), bitorder="little").reshape(-1, 64)
    expected = np.zeros((used, 64), bool)
    for own in range(used):
        field, block = divmod(int(held[own]), count)
        for other in range(3):
            if other != field and (fields[block] >> other) & 1:
                first = 2 * int(TO_KINEMATIC) * int(slot[other * count + block])
                expected[own] |= mass[first : first + 64] != 0.0
    assert heap.failures == [0] and 100 < expected.sum() < 0.5 * expected.size
    np.testing.assert_array_equal(bits[:used], expected)
