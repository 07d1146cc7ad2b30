"""A gather and a scatter of large bodies, the first of which finds what the second adds up.

Where nothing acts between them, the gather has at hand what a particle will scatter: its stress is that of the
deformation which it has just found. It also knows how far a particle is from any boundary. The scatter reads momenta
and that alone, and the rest is not in a program that mostly adds; see :mod:`piavatar_envs.mpm.runs` and
:mod:`piavatar_envs.mpm.groups`.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm import runs
from piavatar_envs.mpm.colliders import NEAR_PARTICLE
from piavatar_envs.mpm.gather import Gathered, gather
from piavatar_envs.mpm.group_bricks import WORDS
from piavatar_envs.mpm.group_plan import THREADS
from piavatar_envs.mpm.groups import add_turn, begin_group, begins_again, put_turn
from piavatar_envs.mpm.matrices import allocate_matrices, matrix_at, store_matrix
from piavatar_envs.mpm.sensing import sense_gathered
from piavatar_envs.mpm.shared_memory import meet
from piavatar_envs.mpm.stencil import grid_position
from piavatar_envs.mpm.stores import store_vectors
from piavatar_envs.mpm.threads import environment_of
from piavatar_envs.mpm.transfer import (
    Scattered,
    affine_momentum,
    near_boundary,
    placed,
    stressed,
    takes_part,
    with_momentum,
)
from piavatar_envs.mpm.types import (
    NO_STRESS,
    PAPER,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Model,
    Moving,
    Particles,
    Sensors,
    Step,
    Sums,
    group,
    row,
)

# divisions and roots to two units in the last place, and logarithms to 4e-7, in a few instructions instead of calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

#: Who is further from a boundary [grid spacings], by how far it was before it moved, is not near it: distances that are
#: measured from up to 10^4 grid spacings away are rounded by less.
SURELY_FAR = wp.constant(1.001 * float(NEAR_PARTICLE))


@wp.struct
class Ahead:
    """What a gather leaves for the scatter that comes next."""

    affine: wp.array3d(dtype=float)  # what momenta change by from node to node [kg m/s]
    # (num_envs, num_particles) whether a boundary is so near that nodes must know: scatters would wait for that
    near: wp.array2d(dtype=wp.uint8)


@wp.kernel
def forget_ahead(ahead: Ahead):
    """Nothing has been found: who fails in the first gather is scattered once more, whatever has been before."""
    e, p = wp.tid()
    store_matrix(ahead.affine, e, p, wp.mat33())
    ahead.near[e, p] = wp.uint8(0)


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
    ahead: Ahead,
    failure: wp.array(dtype=int),
    sensors: Sensors,
):
    """:func:`piavatar_envs.mpm.runs.grid_to_particles` that leaves what is ``ahead`` instead of affine velocities."""
    at = environment_of(wp.tid(), those[1])
    e = at[0]
    p = (those[0] + at[1]) & 0x7FFFFFFF  # tells the compiler that it is not negative
    s = Gathered()
    moves = bool(False)
    distance = float(0.0)
    if blocks.frozen[e] == 0:
        # as that kernel; a function for both would have a compiler spill twice as many registers
        if senses != 0:
            sense_gathered(grid, particles, blocks, sensors, e, p, grid_position(grid, moved.x[e, p]))
        s, distance = gather(grid, step, particles, boundaries, node_velocity, blocks, moved, failure, e, p)
        moves = s.fault == 0
    near = bool(False)
    if moves and distance - wp.length(s.x - moved.x[e, p]) < SURELY_FAR * grid.dx:
        near = near_boundary(grid, boundaries, e, s.x)
    store_vectors(moved, e, p, s, moves)
    if moves:  # else its environment has failed, and goes on with what there is until the grid pass
        store_matrix(moved.F, e, p, s.F)
        m = particles.mass[row(e, particles.mass.shape[0]), p]
        stress = wp.mat33()
        if step.decoupling != NO_STRESS:
            stress = stressed(grid, step, particles, e, p, s.F)
        store_matrix(ahead.affine, e, p, affine_momentum(grid, m, s.C, stress))
        ahead.near[e, p] = wp.uint8(near)


@wp.func
def scatter_momenta(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    ahead: Ahead,
    blocks: Blocks,
    failure: wp.array(dtype=int),
    sums: Sums,
    num_fields: int,
    at: wp.vec4i,
    left: bool,
):
    """:func:`piavatar_envs.mpm.groups.scatter_left` of what the gather has found."""
    e = at[0]
    p = at[1]
    s = Scattered()
    near = bool(False)
    if left:
        near = ahead.near[e, p] != wp.uint8(0)
        m = particles.mass[row(e, particles.mass.shape[0]), p]
        k = wp.vec3()
        if step.decoupling == PAPER:
            k = m * moving.vk[e, p]
        s = with_momentum(placed(grid, moving.x[e, p]), m, moving.u[e, p], k, matrix_at(ahead.affine, e, p))
    turn = add_turn(grid, blocks, failure, num_fields, at, left, s)
    meet()
    return put_turn(grid, step, particles, moving, failure, sums, num_fields, at, turn, near)


# it has less to keep than the kernel for what particles have, so that there is room for another CUDA block
@wp.kernel(launch_bounds=(THREADS, 7))
def momenta_to_grid(
    grid: Grid,
    step: Step,
    particles: Particles,
    contact: Contact,
    moving: Moving,
    blocks: Blocks,
    ahead: Ahead,
    those: wp.vec2i,
    # in and out
    failure: wp.array(dtype=int),
    sums: Sums,
):
    """:func:`piavatar_envs.mpm.groups.runs_to_grid` of what :func:`grid_to_momenta` has found."""
    reserved = wp.tile_empty(shape=(WORDS,), dtype=int, storage="shared")  # noqa: F841
    at = begin_group(particles, sums, those)
    left = bool(False)
    if at[1] < at[3]:
        left = takes_part(blocks, at[0], failure)
    goes_on = bool(True)
    while goes_on:
        left = scatter_momenta(
            grid, step, particles, moving, ahead, blocks, failure, sums, contact.num_fields, at, left
        )  # fmt: skip
        goes_on = begins_again()


def allocate_ahead(model: Model) -> Ahead:
    """Room for what particles of all environments are left."""
    affine = allocate_matrices(model.num_envs, model.num_particles, model.device)
    near = wp.zeros((model.num_envs, model.num_particles), dtype=wp.uint8, device=model.device)
    return group(Ahead, affine=affine, near=near)
