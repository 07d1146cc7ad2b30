"""One MPM substep: scatter, solve, gather."""

from __future__ import annotations

from piavatar_envs.mpm.grid import threads_per_block, update_grid
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.transfer import grid_to_particles, particles_to_grid
from piavatar_envs.mpm.types import Model, Moving, Scratch, State, group


def record_substep(program: Program, model: Model, state: State, scratch: Scratch, index: int) -> None:
    """Append substep ``index`` of a control step to ``program``.

    The physical velocity, position and deformation in ``state`` advance by ``model.step.dt`` under the kinematic
    velocity ``state.vk``.
    """
    m, s = model, state
    particles = (m.num_envs, m.num_particles)
    active, next_active = scratch.block_active[index % 2], scratch.block_active[(index + 1) % 2]
    program.launch(
        particles_to_grid,
        particles,
        [m.grid, m.step, m.particles, m.boundaries, group(Moving, x=s.x, u=s.u, C=s.C, F=s.F, vk=s.vk)],
        [scratch.node_sum, scratch.node_offset, active, s.failure],
    )
    slabs = threads_per_block(m.device)
    program.launch(
        update_grid,
        (m.num_envs, m.num_blocks, slabs),
        [m.grid, m.step, m.boundaries, slabs, active],
        [scratch.node_sum, scratch.node_offset, scratch.node_velocity, next_active, scratch.boundary_impulse],
    )
    program.launch(
        grid_to_particles,
        particles,
        [m.grid, m.step, m.boundaries, scratch.node_velocity, s.vk],
        [s.x, s.u, s.C, s.F, s.failure],
    )
