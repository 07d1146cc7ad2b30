"""Normals and gaps of two fields: exact where bodies are flat; blocks slide and rest by Coulomb's law."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.bspline import block_corner, node_of_block, node_position
from piavatar_envs.mpm.contact_normals import (
    find_volume_gradients,
    shared_normal,
    surface_gap,
    volume_at,
)
from piavatar_envs.mpm.grid_arrays import mass_of, offset_at
from piavatar_envs.mpm.solver import record_first_activation, record_p2g
from piavatar_envs.mpm.sparse_grid import THREADS, field_and_block, plan_sweep, record_of
from piavatar_envs.mpm.types import Accumulators, Blocks, Contact, Grid

DX = 0.05
#: Two bodies that touch in the plane z = 0: first halves of a cube, then a block on a table.
HALVES = ((-0.2, -0.2, 0.0), (0.2, 0.2, 0.2)), ((-0.2, -0.2, -0.2), (0.2, 0.2, 0.0))
BLOCK, TABLE = ((-0.1, -0.1, 0.0), (0.1, 0.1, 0.2)), ((-0.3, -0.25, -0.15), (0.3, 0.25, 0.0))


@wp.kernel
def look_at_nodes(
    grid: Grid,
    contact: Contact,
    blocks: Blocks,
    sums: Accumulators,
    node_velocity: wp.array2d(dtype=wp.vec4),
    volume_gradient: wp.array2d(dtype=wp.vec4),
    # out
    volume: wp.array2d(dtype=float),
    normal: wp.array(dtype=wp.vec3),
    gap: wp.array(dtype=float),
    position: wp.array(dtype=wp.vec3),
):
    """Evaluate the nodes of contact blocks, by the active blocks of the first field."""
    active, local = wp.tid()
    if active >= blocks.num_active[0]:
        return
    owner = field_and_block(grid, blocks.owner[0, active])
    if owner[0] != 0 or (blocks.fields[0, owner[1]] & 3) != 3:
        return
    node = node_of_block(block_corner(grid, owner[1]), local)
    a = record_of(grid, blocks, 0, 0, node[0], node[1], node[2])
    b = record_of(grid, blocks, 0, 1, node[0], node[1], node[2])
    m_a = mass_of(node_velocity, 0, a)  # not yet velocities
    m_b = mass_of(node_velocity, 0, b)
    if m_a > 0.0 and m_b > 0.0:
        n = 64 * active + local
        volume[0, n] = volume_at(grid, contact, 0, 0, m_a)
        volume[1, n] = volume_at(grid, contact, 0, 1, m_b)
        n_ab = shared_normal(grid, blocks, 0, node, 0, 1, volume_gradient)
        of_a = offset_at(grid, sums, 0, 0, a)
        of_b = offset_at(grid, sums, 0, 1, b)
        apart = of_a / m_a - of_b / m_b
        distance = wp.dot(n_ab, wp.vec3(apart[0], apart[1], apart[2]))
        normal[n] = n_ab
        gap[n] = surface_gap(grid, volume[0, n], volume[1, n], distance)
        position[n] = node_position(grid, node[0], node[1], node[2])


class Look:
    """Normals, gaps [m], reduced volumes and positions of the nodes that two bodies share.

    The path of ``sim`` must not be ``"block"``, whose grid lies in shared memory.
    """

    def __init__(self, sim) -> None:
        model, state, scratch = sim.model, sim.state, sim.scratch
        graph = LaunchGraph(model.device)
        record_first_activation(graph, model, state, scratch)
        record_p2g(graph, model, state, scratch)
        sweep = plan_sweep(model)
        found = [scratch.accumulators, scratch.velocity, scratch.volume_gradient, scratch.sensors]
        graph.launch(
            find_volume_gradients,
            sweep.threads,
            [model.grid, model.contact, sweep, scratch.blocks, state.failure],
            found,
            block_dim=THREADS,
        )
        count = 64 * model.max_active_blocks

        def zeros(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=model.device)

        volume, gap = zeros((2, count), float), zeros(count, float)
        normal, position = (zeros(count, wp.vec3) for _ in range(2))
        inputs = [
            model.grid,
            model.contact,
            scratch.blocks,
            scratch.accumulators,
            scratch.velocity,
            scratch.volume_gradient,
        ]
        graph.launch(look_at_nodes, (model.max_active_blocks, 64), inputs, [volume, normal, gap, position])
        graph.run()
        a, b = volume.numpy()
        shared = self.shared = (a > 1e-4) & (b > 1e-4)
        self.weight = (a * b / np.maximum(a + b, 1e-12))[shared]
        self.normal, self.gap = normal.numpy()[shared], gap.numpy()[shared]
        self.position = position.numpy()[shared]


@pytest.mark.parametrize("apart", [0.0, 0.5, 1.0, 2.0])
def test_a_third_body_turns_no_normal(meet, apart):
    # One beside the other two, on both, ``apart`` [grid spacings]; it shares blocks and nodes with either.
    side = {"box": ((0.2 + apart * DX, -0.1, -0.1), (0.3 + apart * DX, 0.1, 0.1))}
    pair = [{"box": box} for box in HALVES]
    two, three = Look(meet(pair, path="plain")), Look(meet([*pair, side], max_active_blocks=400, path="plain"))
    assert len(two.position) == len(three.position) > 100
    first, second = (np.lexsort(np.round(look.position / DX).T) for look in (two, three))
    np.testing.assert_allclose(three.position[second], two.position[first], atol=1e-6)
    np.testing.assert_allclose(three.normal[second], two.normal[first], atol=1e-5)


@pytest.mark.parametrize("gap", [-0.2, 0.0, 0.3, 0.6])
@pytest.mark.parametrize("density", [1.0, 8.0])
def test_gap_of_flat_faces(meet, gap, density):
    # Every node far from the faces' edges sees the same gap, wherever it lies, whatever the bodies weigh.
    upper = tuple(tuple(np.add(corner, (0.0, 0.0, gap * DX))) for corner in HALVES[0])
    look = Look(meet([{"box": upper, "density": 100.0 * density}, {"box": HALVES[1]}], path="plain"))
    inner = (np.abs(look.position[:, :2]) < 0.06).all(1)
    assert inner.sum() >= 8 and np.ptp(look.position[inner, 2]) > 0.9 * DX
    np.testing.assert_allclose(look.normal[inner], np.tile([0.0, 0.0, -1.0], (inner.sum(), 1)), atol=1e-3)
    heavy = look.weight[inner] > 0.02
    seen = look.gap[inner][heavy] / DX
    if gap < 0.0:
        assert (seen < 0.05).all() and (seen > 1.5 * gap).all()
    else:
        np.testing.assert_allclose(seen, gap, atol=0.1)


@pytest.mark.parametrize(("friction", "pull"), [(0.0, 3.0), (0.2, 4.0)])
def test_a_block_slides_on_a_table(meet, friction, pull):
    # Pulled along x [m/s^2]. With normals of single nodes its front edge ploughs, like an additional friction of 0.15.
    plane = {"planes": [((0.0, 0.0, 1.0), -0.15, 5.0)], "gravity": (0.0, 0.0, -9.81), "control_dt": 0.01}
    sim = meet([{"box": BLOCK}, {"box": TABLE}], friction=friction, stiffness=200.0, pushed=True, **plane)
    sim.push(damping=40.0).run(20)
    sim.push(acceleration=sim.of(0)[:, None] * [pull, 0.0, 0.0]).run(8)
    start, steps = sim.get("u")[sim.of(0), 0].mean(), 16
    acceleration = (sim.run(steps).get("u")[sim.of(0), 0].mean() - start) / (0.01 * steps)
    brake = (pull - acceleration) / 9.81
    assert sim.failures == [0]
    assert friction - 0.01 < brake < friction + 0.04
    assert sim.get("x")[sim.of(0), 2].min() > -0.4 * DX


def test_a_block_rests_on_a_table(meet):
    # Pulled with less than friction can hold, it does not creep.
    plane = {"planes": [((0.0, 0.0, 1.0), -0.15, 5.0)], "gravity": (0.0, 0.0, -9.81), "control_dt": 0.01}
    sim = meet([{"box": BLOCK}, {"box": TABLE}], friction=0.5, stiffness=200.0, pushed=True, **plane)
    sim.push(damping=40.0).run(20)
    sim.push(damping=40.0, acceleration=sim.of(0)[:, None] * [3.0, 0.0, 0.0]).run(20)
    before = sim.get("x")[sim.of(0), 0].mean()
    sim.push(acceleration=sim.of(0)[:, None] * [3.0, 0.0, 0.0]).run(30)
    assert abs(sim.get("x")[sim.of(0), 0].mean() - before) < 0.01 * DX  # a slide without friction would go 0.13 m
