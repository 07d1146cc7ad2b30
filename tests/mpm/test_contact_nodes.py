"""Contact nodes: nodes at which another field had mass in the previous substep."""

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
    """Three boxes that come together on a floor, on the tiled path."""
    if device == "cpu":
        pytest.skip("tiles are a GPU's")
    return meet(three_boxes, num_substeps=5, planes=[((0.0, 0.0, 1.0), -0.11, 0.5)], path="tiled", control_dt=0.005)


def test_contact_nodes_are_where_another_field_has_mass(heap):
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


def in_contact_blocks(blocks) -> np.ndarray:
    """Return the active blocks that lie in contact blocks."""
    count, owner = int(blocks.num_active.numpy()[0]), blocks.owner.numpy()[0]
    fields = blocks.fields.numpy()[0][owner[:count] % blocks.fields.shape[1]]
    return np.flatnonzero(fields & (fields - 1))


def deposited(sim) -> tuple[np.ndarray, np.ndarray]:
    """Run P2G, return offsets and kinematic momentum [quanta] of all nodes, and clear the accumulators."""
    model, sums = sim.model, sim.scratch.accumulators
    graph = LaunchGraph(model.device)
    record_p2g(graph, model, sim.state, sim.scratch)
    graph.run()
    offsets = sums.offset_fixed.numpy()[0].reshape(model.max_active_blocks, 64, -1).astype(float)
    kinematic = sums.fixed.numpy()[0].reshape(model.max_active_blocks, 2, 64, -1)[:, 1].astype(float)
    for array in (sums.fixed, sums.offset_fixed, sums.candidates):
        array.zero_()
    return offsets, kinematic


def test_all_particles_near_a_contact_node_add_to_it(heap):
    """Bits here and there, few enough for a particle to have one at its nodes and most others to have none."""
    heap.set(vk=np.random.default_rng(3).normal(0.0, 0.3, heap.state.vk.numpy().shape))
    activation = LaunchGraph(heap.model.device)
    record_first_activation(activation, heap.model, heap.state, heap.scratch)
    activation.run()
    whole = deposited(heap)  # after an activation all nodes of contact blocks are contact nodes
    active_blocks = in_contact_blocks(heap.scratch.blocks)
    nodes = np.argwhere(whole[0][active_blocks].any(2) & whole[1][active_blocks].any(2))
    nodes = np.random.default_rng(4).choice(nodes, 5, replace=False)
    chosen = np.zeros((heap.model.max_active_blocks, 64), bool)
    chosen[active_blocks[nodes[:, 0]], nodes[:, 1]] = True
    heap.scratch.blocks.contact_nodes.assign(
        np.packbits(chosen, axis=1, bitorder="little").view(np.int32).reshape(1, -1)
    )
    for found, expected in zip(deposited(heap), whole, strict=True):
        scale = np.abs(expected).max()
        assert np.abs(expected[chosen]).max() > 0.01 * scale
        np.testing.assert_allclose(found[chosen], expected[chosen], atol=1e-5 * scale)
        assert np.abs(found[active_blocks]).sum() < 0.9 * np.abs(expected[active_blocks]).sum()


@pytest.mark.parametrize("candidates", [True, False])
def test_contact_acts_only_at_contact_nodes(heap, candidates):
    """All nodes have offsets; the bits decide at which of them contact acts."""
    heap.run(2)
    model, scratch = heap.model, heap.scratch
    activation, contact, sweep = LaunchGraph(model.device), LaunchGraph(model.device), plan_sweep(model)
    record_first_activation(activation, model, heap.state, scratch)
    record_p2g(activation, model, heap.state, scratch)
    activation.run()
    assert (scratch.blocks.contact_nodes.numpy()[0].reshape(-1, 2)[in_contact_blocks(scratch.blocks)] == -1).all()
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
    assert scratch.sensors.touched.numpy()[0][in_contact_blocks(scratch.blocks)].any() == candidates
