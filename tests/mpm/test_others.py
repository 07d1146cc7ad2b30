"""Who is noted to have other fields at a node."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.contact import solve_contact
from piavatar_envs.mpm.contact_normals import find_volume_gradients
from piavatar_envs.mpm.grid_arrays import TO_KINEMATIC
from piavatar_envs.mpm.solver import record_first_activation, record_p2g
from piavatar_envs.mpm.sparse_grid import THREADS, plan_sweep


@pytest.fixture
def heap(meet, three_boxes, device):
    """Three boxes that come together on a floor, added up by groups."""
    if device == "cpu":
        pytest.skip("tiles are a GPU's")
    return meet(three_boxes, num_substeps=5, planes=[((0.0, 0.0, 1.0), -0.11, 0.5)], path="tiled", control_dt=0.005)


def test_bits_are_nodes_where_others_have_mass(heap):
    """Of every field in every block that has several; none elsewhere."""
    heap.run(2)
    blocks, count = heap.scratch.blocks, heap.model.num_blocks
    mass = heap.scratch.velocity.numpy()[0, :, 0]
    fields, active, owner = (getattr(blocks, name).numpy()[0] for name in ("fields", "active", "owner"))
    used = int(blocks.num_active.numpy()[0])
    bits = np.unpackbits(blocks.contact_nodes.numpy()[0].view(np.uint8), bitorder="little").reshape(-1, 64)
    expected = np.zeros((used, 64), bool)
    for own in range(used):
        field, block = divmod(int(owner[own]), count)
        for other in range(3):
            if other != field and (fields[block] >> other) & 1:
                first = 2 * int(TO_KINEMATIC) * int(active[other * count + block])
                expected[own] |= mass[first : first + 64] != 0.0
    assert heap.failures == [0] and 100 < expected.sum() < 0.5 * expected.size
    np.testing.assert_array_equal(bits[:used], expected)


def shared_slots(blocks) -> np.ndarray:
    """Slots of blocks that have several fields."""
    count, owner = int(blocks.num_active.numpy()[0]), blocks.owner.numpy()[0]
    fields = blocks.fields.numpy()[0][owner[:count] % blocks.fields.shape[1]]
    return np.flatnonzero(fields & (fields - 1))


def told_by_scatter(sim) -> tuple[np.ndarray, np.ndarray]:
    """Offsets and kinematic momentum [units] of all slots' nodes, scattered as bits are now; no sums are left."""
    model, sums = sim.model, sim.scratch.accumulators
    graph = LaunchGraph(model.device)
    record_p2g(graph, model, sim.state, sim.scratch)
    graph.run()
    offsets = sums.offset_fixed.numpy()[0].reshape(model.max_active_blocks, 64, -1).astype(float)
    kinematic = sums.fixed.numpy()[0].reshape(model.max_active_blocks, 2, 64, -1)[:, 1].astype(float)
    for array in (sums.fixed, sums.offset_fixed, sums.candidates):
        array.zero_()
    return offsets, kinematic


def test_a_node_with_a_bit_is_told_by_all_around(heap):
    """Bits here and there, few enough for a particle to have one at its nodes and most others to have none."""
    heap.set(vk=np.random.default_rng(3).normal(0.0, 0.3, heap.state.vk.numpy().shape))
    marks = LaunchGraph(heap.model.device)
    record_first_activation(marks, heap.model, heap.state, heap.scratch)
    marks.run()
    whole = told_by_scatter(heap)  # who has just been marked tells all nodes
    active_blocks = shared_slots(heap.scratch.blocks)
    nodes = np.argwhere(whole[0][active_blocks].any(2) & whole[1][active_blocks].any(2))
    nodes = np.random.default_rng(4).choice(nodes, 5, replace=False)
    chosen = np.zeros((heap.model.max_active_blocks, 64), bool)
    chosen[active_blocks[nodes[:, 0]], nodes[:, 1]] = True
    heap.scratch.blocks.contact_nodes.assign(
        np.packbits(chosen, axis=1, bitorder="little").view(np.int32).reshape(1, -1)
    )
    for found, expected in zip(told_by_scatter(heap), whole, strict=True):
        scale = np.abs(expected).max()
        assert np.abs(expected[chosen]).max() > 0.01 * scale
        np.testing.assert_allclose(found[chosen], expected[chosen], atol=1e-5 * scale)
        assert np.abs(found[active_blocks]).sum() < 0.9 * np.abs(expected[active_blocks]).sum()


@pytest.mark.parametrize("candidates", [True, False])
def test_contact_acts_only_where_fields_have_told(heap, candidates):
    """All nodes have offsets; whether they count as told is what bits say."""
    heap.run(2)
    model, scratch = heap.model, heap.scratch
    marks, contact, sweep = LaunchGraph(model.device), LaunchGraph(model.device), plan_sweep(model)
    record_first_activation(marks, model, heap.state, scratch)
    record_p2g(marks, model, heap.state, scratch)
    marks.run()
    assert (scratch.blocks.contact_nodes.numpy()[0].reshape(-1, 2)[shared_slots(scratch.blocks)] == -1).all()
    if not candidates:
        scratch.blocks.contact_nodes.zero_()
    inputs = [model.grid, model.contact, sweep, scratch.blocks, heap.state.failure]
    outputs = [scratch.accumulators, scratch.velocity, scratch.volume_gradient, scratch.sensors]
    contact.launch(find_volume_gradients, sweep.threads, inputs, outputs, block_dim=THREADS)
    inputs = [
        model.grid,
        model.step,
        model.boundaries,
        model.contact,
        sweep,
        scratch.blocks,
        heap.state.failure,
        scratch.volume_gradient,
    ]
    outputs = [scratch.accumulators, scratch.velocity, scratch.sensors]
    contact.launch(solve_contact, sweep.threads, inputs, outputs, block_dim=THREADS)
    contact.run()
    assert scratch.sensors.touched.numpy()[0][shared_slots(scratch.blocks)].any() == candidates
