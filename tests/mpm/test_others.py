"""Who is noted to have other fields at a node."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.contact import solve_contact
from piavatar_envs.mpm.contact_normals import find_facing
from piavatar_envs.mpm.grid_arrays import TO_KINEMATIC
from piavatar_envs.mpm.solver import record_marks, record_p2g
from piavatar_envs.mpm.sparse_grid import THREADS, plan_sweep


@pytest.fixture
def heap(meet, three_boxes, device):
    """Three boxes that come together on a floor, added up by groups."""
    if device == "cpu":
        pytest.skip("groups are a GPU's")
    return meet(three_boxes, num_substeps=5, planes=[((0.0, 0.0, 1.0), -0.11, 0.5)], scatter="runs", control_dt=0.005)


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


def shared_slots(blocks) -> np.ndarray:
    """Slots of blocks that have several fields."""
    count, held = int(blocks.count.numpy()[0]), blocks.held.numpy()[0]
    fields = blocks.fields.numpy()[0][held[:count] % blocks.fields.shape[1]]
    return np.flatnonzero(fields & (fields - 1))


def told_by_scatter(sim) -> tuple[np.ndarray, np.ndarray]:
    """Offsets and kinematic momentum [units] of all slots' nodes, scattered as bits are now; no sums are left."""
    model, sums = sim.model, sim.scratch.sums
    graph = LaunchGraph(model.device)
    record_p2g(graph, model, sim.state, sim.scratch)
    graph.run()
    offsets = sums.offset_fixed.numpy()[0].reshape(model.max_slots, 64, -1).astype(float)
    kinematic = sums.fixed.numpy()[0].reshape(model.max_slots, 2, 64, -1)[:, 1].astype(float)
    for array in (sums.fixed, sums.offset_fixed, sums.told):
        array.zero_()
    return offsets, kinematic


def test_a_node_with_a_bit_is_told_by_all_around(heap):
    """Bits here and there, few enough for a particle to have one at its nodes and most others to have none."""
    heap.set(vk=np.random.default_rng(3).normal(0.0, 0.3, heap.state.vk.numpy().shape))
    marks = LaunchGraph(heap.model.device)
    record_marks(marks, heap.model, heap.state, heap.scratch)
    marks.run()
    whole = told_by_scatter(heap)  # who has just been marked tells all nodes
    slots = shared_slots(heap.scratch.blocks)
    nodes = np.argwhere(whole[0][slots].any(2) & whole[1][slots].any(2))
    nodes = np.random.default_rng(4).choice(nodes, 5, replace=False)
    chosen = np.zeros((heap.model.max_slots, 64), bool)
    chosen[slots[nodes[:, 0]], nodes[:, 1]] = True
    heap.scratch.blocks.others.assign(np.packbits(chosen, axis=1, bitorder="little").view(np.int32).reshape(1, -1))
    for found, expected in zip(told_by_scatter(heap), whole, strict=True):
        scale = np.abs(expected).max()
        assert np.abs(expected[chosen]).max() > 0.01 * scale
        np.testing.assert_allclose(found[chosen], expected[chosen], atol=1e-5 * scale)
        assert np.abs(found[slots]).sum() < 0.9 * np.abs(expected[slots]).sum()


@pytest.mark.parametrize("told", [True, False])
def test_contact_acts_only_where_fields_have_told(heap, told):
    """All nodes have offsets; whether they count as told is what bits say."""
    heap.run(2)
    model, scratch = heap.model, heap.scratch
    marks, contact, sweep = LaunchGraph(model.device), LaunchGraph(model.device), plan_sweep(model)
    record_marks(marks, model, heap.state, scratch)
    record_p2g(marks, model, heap.state, scratch)
    marks.run()
    assert (scratch.blocks.others.numpy()[0].reshape(-1, 2)[shared_slots(scratch.blocks)] == -1).all()
    if not told:
        scratch.blocks.others.zero_()
    inputs = [model.grid, model.contact, sweep, scratch.blocks, heap.state.failure]
    outputs = [scratch.sums, scratch.velocity, scratch.facing, scratch.sensors]
    contact.launch(find_facing, sweep.threads, inputs, outputs, block_dim=THREADS)
    inputs = [
        model.grid,
        model.step,
        model.boundaries,
        model.contact,
        sweep,
        scratch.blocks,
        heap.state.failure,
        scratch.facing,
    ]
    outputs = [scratch.sums, scratch.velocity, scratch.sensors]
    contact.launch(solve_contact, sweep.threads, inputs, outputs, block_dim=THREADS)
    contact.run()
    assert scratch.sensors.touched.numpy()[0][shared_slots(scratch.blocks)].any() == told
