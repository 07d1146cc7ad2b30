"""Grid-to-particle (G2P) transfer: APIC (Jiang et al., "The Affine Particle-In-Cell Method", 2015)."""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.blocks import line_of_records, mark_blocks, slab_records
from piavatar_envs.mpm.colliders import CONTACT_GATE, remove_approach
from piavatar_envs.mpm.decouple import advance_deformation
from piavatar_envs.mpm.stencil import base_node, grid_position, spline, stencil_inside
from piavatar_envs.mpm.sums import first_of_records, read_record_from
from piavatar_envs.mpm.types import (
    FAILURE_CFL,
    FAILURE_NONFINITE,
    FAILURE_OUT_OF_GRID,
    NO_STRESS,
    SPLIT,
    Blocks,
    Boundaries,
    Grid,
    Moving,
    Particles,
    Step,
    vec8,
)

# Warp's own unrolling hides the loops over the stencil from the C++ compiler, which turns them into vector code
wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_NONFINITE = wp.constant(FAILURE_NONFINITE)
_OUT_OF_GRID = wp.constant(FAILURE_OUT_OF_GRID)
_CFL = wp.constant(FAILURE_CFL)


@wp.func
def fault_of(grid: Grid, step: Step, F: wp.mat33, advection: wp.vec3, at: wp.vec3):
    """Why a particle cannot go on to ``at`` with deformation ``F``: bits ``FAILURE_*``, 0 if it can."""
    if not wp.isfinite(wp.ddot(F, F)):
        return _NONFINITE
    if step.dt * wp.length(advection) > grid.dx:
        return _CFL
    if not stencil_inside(grid, base_node(grid_position(grid, at))):
        return _OUT_OF_GRID
    return 0


@wp.struct
class Gathered:
    """A particle at the end of a substep; see :class:`piavatar_envs.mpm.types.State`."""

    fault: int  # why it cannot go on: bits FAILURE_*; then it stays as it is
    x: wp.vec3
    u: wp.vec3
    C: wp.mat33
    F: wp.mat33


@wp.func
def advance(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    moved: Moving,
    e: int,
    p: int,
    mean: vec8,
    grad_v: wp.mat33,
    grad_vk: wp.mat33,
):
    """Particle ``p`` a substep later, from the ``mean`` of the nodes' records around it and the velocities' gradients.

    It is carried by its *own* kinematic velocity, not by the grid-smoothed one: this is what makes tracking exact
    (1e-5 m against 1e-2 m). What the grid did not see is projected out of the boundaries.
    """
    velocity = wp.vec3(mean[1], mean[2], mean[3])
    advection = velocity
    if step.decoupling == SPLIT or step.decoupling == NO_STRESS:
        unseen = moved.vk[e, p] - wp.vec3(mean[4], mean[5], mean[6])
        seen = velocity + wp.vec3(mean[4], mean[5], mean[6])
        if mean[7] > 0.0:
            unseen = remove_approach(boundaries, e, moved.x[e, p], unseen, CONTACT_GATE * grid.dx)
        advection = seen + unseen
    s = Gathered()
    s.u = velocity
    s.C = grad_v
    s.F = advance_deformation(
        moved.F[e, p], grad_v, grad_vk, step.dt, wp.where(step.decoupling == NO_STRESS, SPLIT, step.decoupling)
    )
    s.x = moved.x[e, p] + step.dt * advection
    s.fault = fault_of(grid, step, s.F, advection, s.x)
    return s


@wp.struct
class Gradients:
    """Weighted sums of the records of a stencil's nodes, and those times the nodes' places from the lowest."""

    mean: vec8
    along_x: vec8
    along_y: vec8
    along_z: vec8


@wp.func
def finish_gather(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
    e: int,
    p: int,
    g: Gradients,
    base: wp.vec3i,
    f: wp.vec3,
):
    """Particle ``p``, which is ``f`` from node ``base``, a substep later; the blocks that it comes to are marked."""
    # gradient of quadratic-spline APIC: (4 / dx^2) sum w v (x_i - x_p)^T
    scale = 4.0 * grid.inv_dx
    gx = scale * (g.along_x - f[0] * g.mean)
    gy = scale * (g.along_y - f[1] * g.mean)
    gz = scale * (g.along_z - f[2] * g.mean)
    grad_v = wp.mat33(gx[1], gy[1], gz[1], gx[2], gy[2], gz[2], gx[3], gy[3], gz[3])
    grad_vk = wp.mat33(gx[4], gy[4], gz[4], gx[5], gy[5], gz[5], gx[6], gy[6], gz[6])
    s = advance(grid, step, boundaries, moved, e, p, g.mean, grad_v, grad_vk)
    if s.fault != 0:
        wp.atomic_or(failure, e, s.fault)
    else:
        to = base_node(grid_position(grid, s.x))
        if to[0] != base[0] or to[1] != base[1] or to[2] != base[2]:
            mark_blocks(grid, blocks, to, particles.field[p], e, failure)
    return s


@wp.func
def gather(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    node_velocity: wp.array2d(dtype=vec8),
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
    e: int,
    p: int,
):
    """Particle ``p`` from the nodes: velocities and gradients, and with them position and deformation.

    The blocks that it comes to are marked for the next substep.
    """
    xg = grid_position(grid, moved.x[e, p])
    base = base_node(xg)
    f = xg - wp.vec3(float(base[0]), float(base[1]), float(base[2]))
    wx = spline(f[0])
    wy = spline(f[1])
    wz = spline(f[2])
    field = particles.field[p]
    nodes = first_of_records(node_velocity, e)
    g = Gradients()
    slab = wp.vec4i()
    planes = int(3)  # not a constant: a GPU has too few registers for the loads of all three at once
    for i in range(planes):
        wi = wp.where(i == 0, wx[0], wp.where(i == 1, wx[1], wx[2]))
        plane = vec8()
        if i == 0 or ((base[0] + i) & 3) == 0:
            slab = slab_records(grid, blocks, e, field, base, i)
        for j in range(3):
            at_line = line_of_records(slab, base, i, j)
            w = wi * wy[j]
            second = (w * wz[1]) * read_record_from(nodes, at_line[1])
            third = (w * wz[2]) * read_record_from(nodes, at_line[2])
            line = (w * wz[0]) * read_record_from(nodes, at_line[0]) + second + third
            plane += line
            g.along_y += float(j) * line
            g.along_z += second + 2.0 * third
        g.mean += plane
        g.along_x += float(i) * plane
    return finish_gather(grid, step, particles, boundaries, blocks, moved, failure, e, p, g, base, f)


@wp.kernel
def grid_to_particles(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    node_velocity: wp.array2d(dtype=vec8),
    # in and out; vk is read
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
):
    """Move every particle with the grid, see :func:`gather`."""
    e, p = wp.tid()
    if blocks.frozen[e] != 0:
        return
    s = gather(grid, step, particles, boundaries, node_velocity, blocks, moved, failure, e, p)
    if s.fault == 0:
        moved.x[e, p] = s.x
        moved.u[e, p] = s.u
        moved.C[e, p] = s.C
        moved.F[e, p] = s.F
