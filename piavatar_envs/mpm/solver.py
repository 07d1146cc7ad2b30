"""One MPM substep: scatter, solve, gather."""

from __future__ import annotations

from piavatar_envs.mpm.colliders import move_colliders
from piavatar_envs.mpm.grid import threads_per_block, update_grid
from piavatar_envs.mpm.normals import find_facing
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.sensing import clear_sensors, sense_contact, sense_penetration
from piavatar_envs.mpm.transfer import clear_marks, grid_to_particles, mark_particles, particles_to_grid
from piavatar_envs.mpm.types import Model, Moving, Scratch, State, group


def record_substep(program: Program, model: Model, state: State, scratch: Scratch, index: int) -> None:
    """Append substep ``index`` of a control step to ``program``.

    The physical velocity, position and deformation in ``state`` advance by ``model.step.dt`` under the kinematic
    velocity ``state.vk``; contact is added to the sensors.
    """
    m, s, nodes = model, state, scratch.nodes
    particles = (m.num_envs, m.num_particles)
    active, next_active = scratch.block_fields[index % 2], scratch.block_fields[(index + 1) % 2]
    moving = group(Moving, x=s.x, u=s.u, C=s.C, F=s.F, vk=s.vk)
    program.launch(
        particles_to_grid,
        particles,
        [m.grid, m.step, m.particles, m.boundaries, m.contact, moving, active, s.failure],
        [nodes.sum, nodes.offset],
    )
    slabs = threads_per_block(m.device)
    blocks = (m.num_envs, m.num_blocks, slabs)
    if m.contact.num_fields > 1:
        program.launch(find_facing, blocks, [m.grid, m.contact, slabs, active], [nodes.sum, nodes.offset, nodes.facing])
    program.launch(
        update_grid,
        blocks,
        [m.grid, m.step, m.boundaries, m.contact, slabs, active, nodes.facing],
        [nodes.sum, nodes.offset, nodes.velocity, next_active, scratch.sensors],
    )
    if m.contact.num_fields > 1:
        program.launch(
            sense_contact,
            particles,
            [m.grid, m.particles, m.contact, s.x, active, scratch.sensors.node, s.failure],
            [scratch.sensors.part_impulse],
        )
    program.launch(
        grid_to_particles,
        particles,
        [m.grid, m.step, m.particles, m.boundaries, nodes.velocity, s.vk],
        [s.x, s.u, s.C, s.F, next_active, s.failure],
    )
    if m.moving_boundaries:
        program.launch(move_colliders, m.boundaries.position.shape, [m.step.dt], [m.boundaries])


def record_begin(program: Program, model: Model, state: State, scratch: Scratch) -> None:
    """Append what comes before the first substep of a control step: sensors forget, blocks with matter are marked."""
    program.launch(clear_sensors, model.num_envs, [], [scratch.sensors])
    record_marks(program, model, state, scratch)


def record_marks(program: Program, model: Model, state: State, scratch: Scratch) -> None:
    """Append: mark the blocks of all particles for the first substep; every substep marks those of the next.

    What the last control step left is forgotten first: a reset may have put the particles elsewhere, and a block that
    is marked for nothing costs time and, in its rounding, the equality of runs.
    """
    program.launch(clear_marks, (model.num_envs, model.num_blocks), [], [scratch.block_fields[0]])
    program.launch(
        mark_particles,
        state.x.shape,
        [model.grid, model.particles, state.x],
        [scratch.block_fields[0], state.failure],
    )


def record_end(program: Program, model: Model, state: State, scratch: Scratch) -> None:
    """Append what comes after the last substep of a control step: what is sensed once a step."""
    if model.contact.num_subjects > 1:
        last = scratch.block_fields[(model.num_substeps - 1) % 2]
        program.launch(
            sense_penetration,
            state.x.shape,
            [model.grid, model.particles, model.contact, state.x, last, scratch.nodes.velocity, state.failure],
            [scratch.sensors.penetration],
        )
