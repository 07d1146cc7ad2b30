"""Particle-to-grid (P2G) and grid-to-particle (G2P) transfers.

APIC (Jiang et al., "The Affine Particle-In-Cell Method", 2015) with the MLS form of the stress force (Hu et al., "A
Moving Least Squares Material Point Method", 2018, eq. 16). The physical and the kinematic momentum share one pass.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.colliders import CONTACT_GATE, NEAR_PARTICLE, nearest_boundary, remove_approach
from piavatar_envs.mpm.decouple import advance_deformation
from piavatar_envs.mpm.masks import fields_around
from piavatar_envs.mpm.materials import kirchhoff_stress
from piavatar_envs.mpm.stencil import (
    base_node,
    block_index,
    blocks_touched,
    grid_position,
    node_index,
    spline,
    stencil_inside,
)
from piavatar_envs.mpm.types import (
    FAILURE_CFL,
    FAILURE_NONFINITE,
    FAILURE_OUT_OF_GRID,
    NO_STRESS,
    SPLIT,
    Boundaries,
    Contact,
    Grid,
    Moving,
    Particles,
    Step,
    row,
    vec8,
)

# Warp's own unrolling hides the loops over the stencil from the C++ compiler, which turns them into vector code
wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_NONFINITE = wp.constant(FAILURE_NONFINITE)
_OUT_OF_GRID = wp.constant(FAILURE_OUT_OF_GRID)
_CFL = wp.constant(FAILURE_CFL)


@wp.func
def mark_blocks(grid: Grid, base: wp.vec3i, field: int, e: int, active: wp.array2d(dtype=int)):
    """Mark the blocks that a stencil touches with the field's bit."""
    bit = 1 << field
    blocks = blocks_touched(base)
    for i in range(blocks[0]):
        for j in range(blocks[1]):
            for k in range(blocks[2]):
                block = block_index(grid, base[0] + 2 * i, base[1] + 2 * j, base[2] + 2 * k)
                if (active[e, block] & bit) == 0:
                    wp.atomic_or(active, e, block, bit)


@wp.kernel
def clear_marks(active: wp.array2d(dtype=int)):
    """Forget the fields of all blocks."""
    e, block = wp.tid()
    active[e, block] = 0


@wp.kernel
def mark_particles(
    grid: Grid,
    particles: Particles,
    x: wp.array2d(dtype=wp.vec3),
    # in and out
    active: wp.array2d(dtype=int),
    failure: wp.array(dtype=int),
):
    """Mark the blocks of all particles, wherever they have been put; one outside the grid flags its environment."""
    e, p = wp.tid()
    if failure[e] != 0:
        return
    if not wp.isfinite(wp.length_sq(x[e, p])):
        wp.atomic_or(failure, e, _NONFINITE)
        return
    base = base_node(grid_position(grid, x[e, p]))
    if not stencil_inside(grid, base):
        wp.atomic_or(failure, e, _OUT_OF_GRID)
        return
    mark_blocks(grid, base, particles.field[p], e, active)


@wp.kernel
def particles_to_grid(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    moving: Moving,
    active: wp.array2d(dtype=int),
    # in and out
    failure: wp.array(dtype=int),
    # out
    node_sum: wp.array2d(dtype=vec8),
    node_offset: wp.array2d(dtype=wp.vec3),
):
    """Sum mass, physical momentum with the stress impulse, and kinematic momentum on the nodes of a field.

    A particle that is not finite flags its environment and is left out.
    """
    e, p = wp.tid()
    if failure[e] != 0:
        return
    if not wp.isfinite(wp.length_sq(moving.u[e, p]) + wp.length_sq(moving.vk[e, p])):
        wp.atomic_or(failure, e, _NONFINITE)
        return
    xg = grid_position(grid, moving.x[e, p])
    base = base_node(xg)
    f = xg - wp.vec3(float(base[0]), float(base[1]), float(base[2]))
    r = row(e, particles.mass.shape[0])
    m = particles.mass[r, p]
    affine = m * moving.C[e, p]
    if step.decoupling != NO_STRESS:
        tau = kirchhoff_stress(
            particles.material[row(e, particles.material.shape[0]), p],
            moving.F[e, p],
            particles.mu[row(e, particles.mu.shape[0]), p],
            particles.lam[row(e, particles.lam.shape[0]), p],
        )
        volume = particles.volume[row(e, particles.volume.shape[0]), p]
        affine -= (4.0 * step.dt * grid.inv_dx * grid.inv_dx * volume) * tau
    # momentum is linear over the stencil, m u + affine (x_i - x_p): one vector register a node
    A = grid.dx * affine
    q = m * moving.u[e, p] - A * f
    k = m * moving.vk[e, p]
    at_base = vec8(m, q[0], q[1], q[2], k[0], k[1], k[2], m * particles.seam[p])
    along_x = vec8(0.0, A[0, 0], A[1, 0], A[2, 0], 0.0, 0.0, 0.0, 0.0)
    along_y = vec8(0.0, A[0, 1], A[1, 1], A[2, 1], 0.0, 0.0, 0.0, 0.0)
    along_z = vec8(0.0, A[0, 2], A[1, 2], A[2, 2], 0.0, 0.0, 0.0, 0.0)
    wx = spline(f[0])
    wy = spline(f[1])
    wz = spline(f[2])
    field = particles.field[p]
    of_field = field * grid.num_nodes
    at_i = at_base
    for i in range(3):
        at_j = wx[i] * at_i
        for j in range(3):
            first = of_field + node_index(grid, base[0] + i, base[1] + j, base[2])
            line = wy[j] * at_j
            step_z = (wx[i] * wy[j]) * along_z
            wp.atomic_add(node_sum, e, first, wz[0] * line)
            wp.atomic_add(node_sum, e, first + 1, wz[1] * (line + step_z))
            wp.atomic_add(node_sum, e, first + 2, wz[2] * (line + 2.0 * step_z))
            at_j += wx[i] * along_y
        at_i += along_x
    shared = contact.num_fields > 1 and fields_around(grid, base, e, active) != (1 << field)
    if shared or nearest_boundary(boundaries, e, moving.x[e, p]) < NEAR_PARTICLE * grid.dx:
        for i in range(3):
            for j in range(3):
                first = of_field + node_index(grid, base[0] + i, base[1] + j, base[2])
                for l in range(3):
                    d = grid.dx * (wp.vec3(float(i), float(j), float(l)) - f)
                    wp.atomic_add(node_offset, e, first + l, (wx[i] * wy[j] * wz[l] * m) * d)


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


@wp.kernel
def grid_to_particles(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    node_velocity: wp.array2d(dtype=vec8),
    vk: wp.array2d(dtype=wp.vec3),
    # in and out
    x: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    C: wp.array2d(dtype=wp.mat33),
    F: wp.array2d(dtype=wp.mat33),
    next_active: wp.array2d(dtype=int),
    failure: wp.array(dtype=int),
):
    """Gather velocities and gradients; advance position and deformation; mark blocks for the next substep.

    A particle is carried by its *own* kinematic velocity, not by the grid-smoothed one: this is what makes tracking
    exact (1e-5 m against 1e-2 m). What the grid did not see is projected out of the boundaries.
    """
    e, p = wp.tid()
    if failure[e] != 0:
        return
    xg = grid_position(grid, x[e, p])
    base = base_node(xg)
    f = xg - wp.vec3(float(base[0]), float(base[1]), float(base[2]))
    wx = spline(f[0])
    wy = spline(f[1])
    wz = spline(f[2])
    of_field = particles.field[p] * grid.num_nodes
    mean = vec8()
    moment_x = vec8()
    moment_y = vec8()
    moment_z = vec8()
    for i in range(3):
        plane = vec8()
        for j in range(3):
            first = of_field + node_index(grid, base[0] + i, base[1] + j, base[2])
            w = wx[i] * wy[j]
            second = (w * wz[1]) * node_velocity[e, first + 1]
            third = (w * wz[2]) * node_velocity[e, first + 2]
            line = (w * wz[0]) * node_velocity[e, first] + second + third
            plane += line
            moment_y += float(j) * line
            moment_z += second + 2.0 * third
        mean += plane
        moment_x += float(i) * plane
    # gradient of quadratic-spline APIC: (4 / dx^2) sum w v (x_i - x_p)^T
    scale = 4.0 * grid.inv_dx
    gx = scale * (moment_x - f[0] * mean)
    gy = scale * (moment_y - f[1] * mean)
    gz = scale * (moment_z - f[2] * mean)
    grad_v = wp.mat33(gx[1], gy[1], gz[1], gx[2], gy[2], gz[2], gx[3], gy[3], gz[3])
    grad_vk = wp.mat33(gx[4], gy[4], gz[4], gx[5], gy[5], gz[5], gx[6], gy[6], gz[6])
    velocity = wp.vec3(mean[1], mean[2], mean[3])
    advection = velocity
    if step.decoupling == SPLIT or step.decoupling == NO_STRESS:
        unseen = vk[e, p] - wp.vec3(mean[4], mean[5], mean[6])
        seen = velocity + wp.vec3(mean[4], mean[5], mean[6])
        if mean[7] > 0.0:
            unseen = remove_approach(boundaries, e, x[e, p], unseen, CONTACT_GATE * grid.dx)
        advection = seen + unseen
    F_next = advance_deformation(
        F[e, p], grad_v, grad_vk, step.dt, wp.where(step.decoupling == NO_STRESS, SPLIT, step.decoupling)
    )
    at = x[e, p] + step.dt * advection
    fault = fault_of(grid, step, F_next, advection, at)
    if fault != 0:
        wp.atomic_or(failure, e, fault)
        return
    mark_blocks(grid, base_node(grid_position(grid, at)), particles.field[p], e, next_active)
    x[e, p] = at
    u[e, p] = velocity
    C[e, p] = grad_v
    F[e, p] = F_next
