"""A gather and a scatter of large bodies, the first of which finds what the second adds up.

Where nothing acts between them, the gather has at hand what a particle will scatter: its stress is that of the
deformation which it has just found. The scatter reads momenta alone then, and the stress is not in a program that
mostly adds; see :mod:`piavatar_envs.mpm.runs` and :mod:`piavatar_envs.mpm.groups`.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm import runs
from piavatar_envs.mpm.gather import Gathered, gather
from piavatar_envs.mpm.group_bricks import WORDS
from piavatar_envs.mpm.group_plan import THREADS
from piavatar_envs.mpm.groups import begin_group, begins_again, scatter_turn
from piavatar_envs.mpm.matrices import matrix_at, store_matrix
from piavatar_envs.mpm.sensing import sense_gathered
from piavatar_envs.mpm.stencil import grid_position
from piavatar_envs.mpm.stores import store_vectors
from piavatar_envs.mpm.threads import environment_of
from piavatar_envs.mpm.transfer import Scattered, affine_momentum, placed, stressed, takes_part, with_momentum
from piavatar_envs.mpm.types import (
    NO_STRESS,
    PAPER,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Moving,
    Particles,
    Sensors,
    Step,
    Sums,
    row,
)

# divisions and roots to two units in the last place, and logarithms to 4e-7, in a few instructions instead of calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})


@wp.kernel(launch_bounds=(runs.THREADS, 6))
def grid_to_momenta(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    node_velocity: wp.array2d(dtype=wp.vec4),
    senses: int,
    those: wp.vec2i,
    # in and out; vk is read
    blocks: Blocks,
    moved: Moving,
    affine: wp.array3d(dtype=float),
    failure: wp.array(dtype=int),
    sensors: Sensors,
):
    """:func:`piavatar_envs.mpm.runs.grid_to_particles` that leaves ``affine`` momenta instead of affine velocities."""
    at = environment_of(wp.tid(), those[1])
    e = at[0]
    p = (those[0] + at[1]) & 0x7FFFFFFF  # tells the compiler that it is not negative
    s = Gathered()
    moves = bool(False)
    if blocks.frozen[e] == 0:
        # as that kernel; a function for both would have a compiler spill twice as many registers
        if senses != 0:
            sense_gathered(grid, particles, blocks, sensors, e, p, grid_position(grid, moved.x[e, p]))
        s = gather(grid, step, particles, boundaries, node_velocity, blocks, moved, failure, e, p)
        moves = s.fault == 0
    store_vectors(moved, e, p, s, moves)
    if moves:  # else its environment has failed, and goes on with what there is until the grid pass
        store_matrix(moved.F, e, p, s.F)
        m = particles.mass[row(e, particles.mass.shape[0]), p]
        stress = wp.mat33()
        if step.decoupling != NO_STRESS:
            stress = stressed(grid, step, particles, e, p, s.F)
        store_matrix(affine, e, p, affine_momentum(grid, m, s.C, stress))


@wp.func
def scatter_momenta(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    affine: wp.array3d(dtype=float),
    boundaries: Boundaries,
    blocks: Blocks,
    failure: wp.array(dtype=int),
    sums: Sums,
    num_fields: int,
    at: wp.vec4i,
    left: bool,
):
    """:func:`scatter_turn` of what the gather has found; as :func:`piavatar_envs.mpm.groups.scatter_left`."""
    e = at[0]
    p = at[1]
    s = Scattered()
    if left:
        m = particles.mass[row(e, particles.mass.shape[0]), p]
        k = wp.vec3()
        if step.decoupling == PAPER:
            k = m * moving.vk[e, p]
        s = with_momentum(placed(grid, moving.x[e, p]), m, moving.u[e, p], k, matrix_at(affine, e, p))
    return scatter_turn(grid, step, particles, moving, boundaries, blocks, failure, sums, num_fields, at, left, s)


@wp.kernel(launch_bounds=(THREADS, 6))
def momenta_to_grid(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    moving: Moving,
    blocks: Blocks,
    affine: wp.array3d(dtype=float),
    those: wp.vec2i,
    # in and out
    failure: wp.array(dtype=int),
    sums: Sums,
):
    """:func:`piavatar_envs.mpm.groups.runs_to_grid` of what :func:`grid_to_momenta` has found."""
    reserved = wp.tile_empty(shape=(WORDS,), dtype=int, storage="shared")  # noqa: F841
    driven = step.decoupling == PAPER
    at = begin_group(particles, sums, those, driven)
    left = bool(False)
    if at[1] < at[3]:
        left = takes_part(blocks, at[0], failure)
    goes_on = bool(True)
    while goes_on:
        left = scatter_momenta(
            grid, step, particles, moving, affine, boundaries, blocks, failure, sums, contact.num_fields, at, left
        )  # fmt: skip
        goes_on = begins_again(driven)
