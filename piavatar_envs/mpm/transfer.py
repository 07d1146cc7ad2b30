"""Particle-to-grid (P2G) transfer; the way back is in :mod:`piavatar_envs.mpm.gather`.

APIC (Jiang et al., "The Affine Particle-In-Cell Method", 2015) with the MLS form of the stress force (Hu et al., "A
Moving Least Squares Material Point Method", 2018, eq. 16). The physical and the kinematic momentum share one pass.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.blocks import fields_around, note_around
from piavatar_envs.mpm.colliders import NEAR_PARTICLE, nearest_boundary
from piavatar_envs.mpm.materials import kirchhoff_stress
from piavatar_envs.mpm.matrices import matrix_at
from piavatar_envs.mpm.stencil import grid_position, stencil_at
from piavatar_envs.mpm.stencil_lines import lines_of, note_told, scatter_lines, scatter_places
from piavatar_envs.mpm.stencil_records import HALVES, VECTORS
from piavatar_envs.mpm.types import (
    FAILURE_BLOCKS,
    FAILURE_NONFINITE,
    NO_STRESS,
    PAPER,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Moving,
    Particles,
    Step,
    Sums,
    row,
    vec8,
)

# Warp's own unrolling hides the loops over the stencil from the C++ compiler, which turns them into vector code
wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_NONFINITE = wp.constant(FAILURE_NONFINITE)
_BLOCKS = wp.constant(FAILURE_BLOCKS)


@wp.struct
class Scattered:
    """What a particle adds to the nodes around it; momentum ``m u + affine (x_i - x_p)`` is linear over the stencil."""

    base: wp.vec3i  # lowest node of the stencil
    f: wp.vec3  # position from there, in grid spacings
    at_base: vec8  # mass, physical and kinematic momentum, at the lowest node
    A: wp.mat33  # change of physical momentum from node to node, along the columns


@wp.func
def placed(grid: Grid, x: wp.vec3):
    """A particle at ``x`` that scatters nothing."""
    s = Scattered()
    stencil = stencil_at(grid_position(grid, x))
    s.base = stencil.base
    s.f = stencil.f
    return s


@wp.func
def impulse_of_stress(grid: Grid, step: Step, volume: float, tau: wp.mat33):
    """What a particle's Kirchhoff stress takes from its affine momentum in a substep [kg/s]."""
    return (4.0 * step.dt * grid.inv_dx * grid.inv_dx * volume) * tau


@wp.func
def affine_momentum(grid: Grid, m: float, C: wp.mat33, stress: wp.mat33):
    """Change of a particle's momentum from node to node, that of its affine velocity less the impulse of ``stress``."""
    return grid.dx * (m * C - stress)


@wp.func
def with_momentum(s: Scattered, m: float, u: wp.vec3, k: wp.vec3, A: wp.mat33):
    """``s`` with mass, physical momentum, which changes by ``A`` from node to node, and kinematic momentum."""
    s.A = A
    q = m * u - A * s.f
    s.at_base = vec8(m, q[0], q[1], q[2], k[0], k[1], k[2], 0.0)
    return s


@wp.func
def stressed(grid: Grid, step: Step, particles: Particles, e: int, p: int, F: wp.mat33):
    """:func:`impulse_of_stress` of particle ``p`` with deformation ``F``."""
    tau = kirchhoff_stress(
        particles.material[row(e, particles.material.shape[0]), p],
        F,
        particles.mu[row(e, particles.mu.shape[0]), p],
        particles.lam[row(e, particles.lam.shape[0]), p],
    )
    return impulse_of_stress(grid, step, particles.volume[row(e, particles.volume.shape[0]), p], tau)


@wp.func
def prepare(grid: Grid, step: Step, particles: Particles, moving: Moving, e: int, p: int, tells: bool):
    """What particle ``p`` of environment ``e`` scatters.

    Kinematic momentum is for contact, which acts on the total velocity; elsewhere it would be added and taken off
    again. So only particles add it that ``tell`` the nodes how they are driven. (The paper's variant needs its gradient
    everywhere.)
    """
    s = placed(grid, moving.x[e, p])
    m = particles.mass[row(e, particles.mass.shape[0]), p]
    C = matrix_at(moving.C, e, p)  # first used after the stress: its parameters are asked for before this has come
    stress = wp.mat33()
    if step.decoupling != NO_STRESS:
        stress = stressed(grid, step, particles, e, p, matrix_at(moving.F, e, p))
    k = wp.vec3()
    if tells or step.decoupling == PAPER:
        k = m * moving.vk[e, p]
    return with_momentum(s, m, moving.u[e, p], k, affine_momentum(grid, m, C, stress))


@wp.func
def momentum_bounds(s: Scattered):
    """Bounds of the components of physical momentum that a particle has anywhere in its stencil [kg m/s]."""
    bounds = wp.vec3()
    for c in range(3):
        reach = wp.abs(s.A[c, 0]) + wp.abs(s.A[c, 1]) + wp.abs(s.A[c, 2])
        center = s.at_base[1 + c] + s.A[c, 0] + s.A[c, 1] + s.A[c, 2]
        bounds[c] = wp.abs(center) + reach
    return bounds


@wp.func
def takes_part(blocks: Blocks, e: int, failure: wp.array(dtype=int)):
    """Whether an environment goes on. Where slots have run out, some particles have none.

    No scatter sets that flag, but a gather beside it may, of another part of the world: some go on then who have not
    seen it, and the grid pass forgets what they add.
    """
    return (blocks.frozen[e] | (failure[e] & _BLOCKS)) == 0


@wp.func
def moves_finitely(moving: Moving, e: int, p: int):
    """Whether a particle's velocities are finite."""
    return wp.isfinite(wp.length_sq(moving.u[e, p]) + wp.length_sq(moving.vk[e, p]))


@wp.func
def admitted(takes: bool, moves: bool, e: int, failure: wp.array(dtype=int)):
    """Whether a particle that ``takes`` part is added up; one that does not move finitely flags its environment."""
    if takes and not moves:
        wp.atomic_or(failure, e, _NONFINITE)
    return takes and moves


@wp.func
def scatters(blocks: Blocks, moving: Moving, e: int, p: int, failure: wp.array(dtype=int)):
    """Whether a particle takes part; one that is not finite flags its environment and does not."""
    moves = moves_finitely(moving, e, p)  # asked for before it is known who takes part
    return admitted(takes_part(blocks, e, failure), moves, e, failure)


@wp.func
def near_boundary(grid: Grid, boundaries: Boundaries, e: int, x: wp.vec3):
    """Whether a particle at ``x`` is so near a boundary that its nodes must know where it is."""
    return nearest_boundary(boundaries, e, x) < NEAR_PARTICLE * grid.dx


@wp.func
def is_beside(grid: Grid, particles: Particles, contact: Contact, blocks: Blocks, e: int, p: int, base: wp.vec3i):
    """Whether another field is in a block of a particle's stencil."""
    return contact.num_fields > 1 and fields_around(grid, blocks, base, e) != (1 << particles.field[p])


@wp.func
def tells_place(
    grid: Grid,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    blocks: Blocks,
    e: int,
    p: int,
    x: wp.vec3,
    base: wp.vec3i,
):
    """Whether nodes must know where this particle is and how it is driven: another field or a boundary is near."""
    if is_beside(grid, particles, contact, blocks, e, p, base):
        return True
    return near_boundary(grid, boundaries, e, x)


@wp.kernel
def particles_to_grid(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    moving: Moving,
    blocks: Blocks,
    # in and out
    failure: wp.array(dtype=int),
    sums: Sums,
):
    """Sum mass, physical momentum with the stress impulse, and kinematic momentum on the nodes of a field.

    The plain scatter: a thread a particle, which adds to one node after the other.
    """
    e, p = wp.tid()
    if not scatters(blocks, moving, e, p, failure):
        return
    x = moving.x[e, p]
    stencil = stencil_at(grid_position(grid, x))
    beside = is_beside(grid, particles, contact, blocks, e, p, stencil.base)
    tells = beside or near_boundary(grid, boundaries, e, x)
    note_around(blocks, e, p, tells, beside)
    s = prepare(grid, step, particles, moving, e, p, tells)
    field = particles.field[p]
    driven = tells or step.decoupling == PAPER
    scatter_lines(sums, e, lines_of(grid, blocks, e, field, stencil, HALVES), s.at_base, s.A, driven)
    if tells:
        lines = lines_of(grid, blocks, e, field, stencil, VECTORS)
        scatter_places(sums, e, lines, s.at_base[0], particles.seam[p], grid.dx)
        note_told(sums, e, lines)
