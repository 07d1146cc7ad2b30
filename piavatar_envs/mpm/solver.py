"""One MPM substep in four stages: activate blocks, P2G, grid update and contact, G2P.

The split-velocity scheme of PIAvatar (Han et al., arXiv 2606.21162) with APIC transfers (Jiang et al., 2015) on
quadratic B-splines: particles carry a physical velocity ``u`` and a kinematic velocity ``vk``; contact acts on the
nodes' total velocity. Where a collider is thin, a fifth stage stops particles at it
(:mod:`piavatar_envs.mpm.thin_colliders`).

``model.path`` names the path of P2G and G2P. ``"plain"`` runs on CPUs, and on GPUs below compute capability 7.0.
``"tiled"`` sums tiles of particles of large bodies in shared memory before they reach the grid. ``"block"`` keeps the
grid of an environment in the shared memory of CUDA blocks, so that P2G, the grid update and, with a single velocity
field, G2P are one launch (:func:`record_block_substep`).
"""

from __future__ import annotations

from collections.abc import Sequence

from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import make_struct
from piavatar_envs.mpm.colliders import move_colliders
from piavatar_envs.mpm.contact import solve_contact
from piavatar_envs.mpm.contact_normals import find_volume_gradients
from piavatar_envs.mpm.contact_sensors import (
    check_limited,
    clear_sensors,
    read_impulses,
    sense_contact,
    sense_penetration,
    senses_in_g2p,
)
from piavatar_envs.mpm.cuda.block_substep import record_in_block, reset_speeds
from piavatar_envs.mpm.cuda.tiled_g2p import THREADS as G2P_THREADS
from piavatar_envs.mpm.cuda.tiled_g2p import tiled_g2p
from piavatar_envs.mpm.cuda.tiled_p2g import record_tiled_p2g
from piavatar_envs.mpm.g2p import g2p
from piavatar_envs.mpm.grid_update import blocks_at_once, threads_per_active_block, update_grid
from piavatar_envs.mpm.p2g import p2g
from piavatar_envs.mpm.retention import record_add, record_free_velocities, record_store
from piavatar_envs.mpm.sparse_grid import (
    THREADS,
    activate_particle_blocks,
    deactivate_blocks,
    freeze,
    plan_sweep,
    reset_active_blocks,
    reset_contact_nodes,
    tracks_contact_nodes,
)
from piavatar_envs.mpm.thin_colliders import stop_at_thin_colliders, store_positions
from piavatar_envs.mpm.types import Model, Moving, Scratch, State


def record_substep(graph: LaunchGraph, model: Model, state: State, scratch: Scratch, index: int) -> None:
    """Append substep ``index`` of a control step to ``graph``.

    The physical velocity, position and deformation in ``state`` advance by ``model.step.dt`` under the kinematic
    velocity ``state.vk``; contact is added to the sensors.
    """
    simulated = (model, state, scratch)
    if index > 0 and index % model.activation_interval == 0:
        record_activation(graph, *simulated)
    if model.thin_colliders is not None:
        graph.launch(store_positions, state.x.shape, [state.x], [scratch.positions])
    if model.path == "block" and index == 0:
        graph.launch(reset_speeds, scratch.arena.speed.shape, [scratch.arena])
    if scratch.retained is not None:
        record_retained(graph, *simulated)
    if model.path == "block":
        record_block_substep(graph, *simulated)
    else:
        record_p2g(graph, *simulated)
        record_grid_update(graph, *simulated)
        record_g2p(graph, *simulated)
    if scratch.retained is not None:
        record_add(graph, *simulated, _moving(state))
    if model.thin_colliders is not None:
        m = model
        graph.launch(
            stop_at_thin_colliders,
            state.x.shape,
            [m.grid, m.step, m.particles, m.boundaries, m.contact, m.thin_colliders, scratch.positions],
            [scratch.blocks, _moving(state), state.failure, scratch.sensors],
        )
    if model.moving_boundaries:
        graph.launch(move_colliders, model.boundaries.position.shape, [model.step.dt], [model.boundaries])


def record_activation(graph: LaunchGraph, model: Model, state: State, scratch: Scratch) -> None:
    """Append: deactivate all blocks, and activate those that particles touch.

    Between activations G2P adds the blocks that particles enter. A block that stays active without need costs time.
    """
    blocks = scratch.blocks
    graph.launch(deactivate_blocks, (model.num_envs, model.max_active_blocks), [model.grid], [blocks])
    graph.launch(reset_active_blocks, model.num_envs, [state.failure], [blocks])
    graph.launch(
        activate_particle_blocks, state.x.shape, [model.grid, model.particles, state.x], [blocks, state.failure]
    )
    if tracks_contact_nodes(model):
        graph.launch(reset_contact_nodes, (model.num_envs, model.max_active_blocks), [], [blocks])


def record_retained(graph: LaunchGraph, model: Model, state: State, scratch: Scratch) -> None:
    """Append what particles retain in the substep, from P2G without forces; see :mod:`piavatar_envs.mpm.retention`."""
    unforced, moving = scratch.unforced, _moving(state)
    assert unforced is not None
    if model.path == "block":
        record_in_block(graph, unforced, state, scratch, moving, with_g2p=False)
    else:
        record_p2g(graph, unforced, state, scratch)
    record_free_velocities(graph, unforced, scratch)
    record_store(graph, model, state, scratch, moving)


def record_p2g(graph: LaunchGraph, model: Model, state: State, scratch: Scratch) -> None:
    """Append P2G: particles add mass, physical and kinematic momentum to the nodes around them."""
    m = model
    inputs = [m.grid, m.step, m.particles, m.boundaries, m.contact, _moving(state), scratch.blocks]
    outputs = [state.failure, scratch.accumulators]
    if m.path == "plain":
        graph.launch(p2g, state.x.shape, inputs, outputs)
    else:
        record_tiled_p2g(graph, m, inputs, outputs)


def record_grid_update(graph: LaunchGraph, model: Model, state: State, scratch: Scratch) -> None:
    """Append the grid update: momentum becomes velocity, gravity and contact act, sensors accumulate impulses.

    Contact blocks are few, and contact is bound by memory latency: all other blocks are updated in parallel.
    """
    m = model
    contact, update = LaunchGraph(graph.device), LaunchGraph(graph.device)
    if m.contact.num_fields > 1:
        _record_contact(contact, model, state, scratch)
    active_blocks = blocks_at_once(m)
    update.launch(
        update_grid,
        m.num_envs * active_blocks * threads_per_active_block(m),
        [m.grid, m.step, m.boundaries, m.contact, active_blocks, state.failure],
        [scratch.blocks, scratch.accumulators, scratch.velocity, scratch.sensors],
        block_dim=THREADS,
    )
    graph.parallel(contact, update)
    _record_contact_sensors(graph, model, state, scratch)


def _record_contact_sensors(graph: LaunchGraph, model: Model, state: State, scratch: Scratch) -> None:
    """Append the impulses and penetration of body parts, unless G2P reads them."""
    m = model
    if m.contact.num_fields > 1 and m.num_sensors > 0 and not senses_in_g2p(m):
        graph.launch(
            sense_contact,
            state.x.shape,
            [m.grid, m.particles, state.x, scratch.blocks, state.failure],
            [scratch.sensors],
            block_dim=THREADS,
        )


def _record_contact(graph: LaunchGraph, model: Model, state: State, scratch: Scratch) -> None:
    """Append contact in contact blocks: first the normals, then the impulses."""
    m, blocks, accumulators = model, scratch.blocks, scratch.accumulators
    sweep = plan_sweep(m)
    graph.launch(
        find_volume_gradients,
        m.num_envs * sweep.threads,
        [m.grid, m.contact, sweep, blocks, state.failure],
        [accumulators, scratch.velocity, scratch.volume_gradient, scratch.sensors],
        block_dim=THREADS,
    )
    graph.launch(
        solve_contact,
        m.num_envs * sweep.threads,
        [m.grid, m.step, m.boundaries, m.contact, sweep, blocks, state.failure, scratch.volume_gradient],
        [accumulators, scratch.velocity, scratch.sensors],
        block_dim=THREADS,
    )


def record_g2p(graph: LaunchGraph, model: Model, state: State, scratch: Scratch) -> None:
    """Append G2P: particles take velocity and its gradient from the nodes, move, and update ``F``."""
    m = model
    inputs = [m.grid, m.step, m.particles, m.boundaries, scratch.velocity]
    outputs = [scratch.blocks, _moving(state), state.failure, scratch.sensors]
    if m.path == "plain":
        graph.launch(g2p, state.x.shape, inputs, outputs, block_dim=G2P_THREADS)
    else:
        graph.launch(
            tiled_g2p,
            m.num_envs * m.num_particles,
            [*inputs, int(senses_in_g2p(m))],
            outputs,
            block_dim=G2P_THREADS,
        )


def record_block_substep(graph: LaunchGraph, model: Model, state: State, scratch: Scratch) -> None:
    """Append the three stages on the path ``"block"``.

    One launch has P2G, the grid update and, with a single velocity field, G2P. Contact between fields needs all of
    them, so with several fields it follows, and G2P after it.
    """
    several = model.contact.num_fields > 1
    record_in_block(graph, model, state, scratch, _moving(state), with_g2p=not several)
    if several:
        _record_contact(graph, model, state, scratch)
        _record_contact_sensors(graph, model, state, scratch)
        record_g2p(graph, model, state, scratch)


def _moving(state: State) -> Moving:
    s = state
    return make_struct(Moving, x=s.x, u=s.u, C=s.C, F=s.F, vk=s.vk, spin=s.spin)


def record_begin(
    graph: LaunchGraph, model: Model, state: State, scratch: Scratch, branches: Sequence[LaunchGraph] = ()
) -> None:
    """Append what precedes the first substep of a control step: clear the sensors, activate blocks.

    Args:
        graph: the launch graph to append to.
        model: the constants.
        state: the particles.
        scratch: the grid.
        branches: parallel branches to add: they use neither sensors nor blocks, move no particles, and do not read
            failures, which activation sets.
    """
    sensors, activation = LaunchGraph(graph.device), LaunchGraph(graph.device)
    sensors.launch(clear_sensors, model.num_envs, [], [scratch.sensors])
    record_first_activation(activation, model, state, scratch)
    graph.parallel(sensors, activation, *branches)


def record_first_activation(graph: LaunchGraph, model: Model, state: State, scratch: Scratch) -> None:
    """Append the activation of the blocks of all particles, and freeze the environments that have failed.

    Required at the start of a control step, because a reset may have moved the particles.
    """
    record_activation(graph, model, state, scratch)
    graph.launch(freeze, model.num_envs, [state.failure], [scratch.blocks])


def record_end(
    graph: LaunchGraph, model: Model, state: State, scratch: Scratch, branches: Sequence[LaunchGraph] = ()
) -> None:
    """Append what follows the last substep of a control step: sensors that are read once a control step.

    Args:
        graph: the launch graph to append to.
        model: the constants.
        state: the particles.
        scratch: the grid.
        branches: parallel branches to add: they use no sensors, move no particles, and set no failure.
    """
    m, impulses, depths = model, LaunchGraph(graph.device), LaunchGraph(graph.device)
    entries = scratch.sensors.accumulators.shape[1] // 3
    impulses.launch(read_impulses, (m.num_envs, entries), [], [scratch.sensors])
    if m.contact.num_subjects > 1:
        depths.launch(
            sense_penetration,
            state.x.shape,
            [m.grid, m.particles, m.contact, state.x, scratch.blocks, scratch.velocity, state.failure],
            [scratch.sensors.penetration],
        )
    graph.parallel(impulses, depths, *branches)
    graph.launch(check_limited, m.num_envs, [m.num_substeps], [scratch.sensors, state.failure])
