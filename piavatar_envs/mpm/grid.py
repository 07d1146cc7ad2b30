"""The grid pass: momentum to velocity, gravity, contact; clears what it reads."""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.colliders import CONTACT_GATE, NEAR_SLAB, boundary_contact, plane_distance
from piavatar_envs.mpm.stencil import BLOCK, block_corner, node_index, node_position
from piavatar_envs.mpm.types import NO_STRESS, SPLIT, Boundaries, Grid, Step, vec8

wp.set_module_options({"enable_backward": False})

#: Nodes lighter than this [kg] carry nothing but round-off.
_MASS_MIN = wp.constant(1.0e-15)


@wp.func
def slab_is_near(boundaries: Boundaries, grid: Grid, i: int, j: int, k: int):
    """Whether a slab of nodes may touch a boundary; most do not, and skip all contact work."""
    center = node_position(grid, i, j, k) + grid.dx * wp.vec3(0.0, 1.5, 1.5)
    for b in range(boundaries.count):
        if plane_distance(boundaries.plane[b], center) < NEAR_SLAB * grid.dx:
            return True
    return False


def threads_per_block(device: str) -> int:
    """Threads that share the four slabs of a block: on a CPU an idle thread costs as much as a slab of nodes."""
    return BLOCK if wp.get_device(device).is_cuda else 1


@wp.kernel
def update_grid(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    slabs: int,
    active: wp.array2d(dtype=wp.int8),
    # in and out: read, then cleared
    node_sum: wp.array2d(dtype=vec8),
    node_offset: wp.array2d(dtype=wp.vec3),
    # out
    node_velocity: wp.array2d(dtype=vec8),
    next_active: wp.array2d(dtype=wp.int8),
    boundary_impulse: wp.array(dtype=wp.vec3),
):
    """Velocity of every node with mass. Contact acts on the total velocity ``v = u + vk``; the rest is physical.

    ``boundary_impulse`` gathers the impulse [N s] that the boundaries gave the bodies of an environment. ``slabs``
    threads share a block; each takes every ``slabs``-th slab of 4 x 4 nodes.
    """
    e, block, slab = wp.tid()
    if slab == 0:
        next_active[e, block] = wp.int8(0)
    if active[e, block] == wp.int8(0):
        return
    corner = block_corner(grid, block)
    split = step.decoupling == SPLIT or step.decoupling == NO_STRESS
    for i in range(corner[0] + slab, wp.min(corner[0] + 4, grid.nodes[0]), slabs):
        near = slab_is_near(boundaries, grid, i, corner[1], corner[2])
        for j in range(corner[1], wp.min(corner[1] + 4, grid.nodes[1])):
            for k in range(corner[2], wp.min(corner[2] + 4, grid.nodes[2])):
                n = node_index(grid, i, j, k)
                s = node_sum[e, n]
                m = s[0]
                out = vec8()
                if m > _MASS_MIN:
                    vk = wp.vec3(s[4], s[5], s[6]) / m
                    v = wp.vec3(s[1], s[2], s[3]) / m + step.dt * step.gravity
                    if split:
                        v += vk
                    if near:
                        matter = node_position(grid, i, j, k) - node_offset[e, n] / m
                        after = boundary_contact(boundaries, matter, v, CONTACT_GATE * grid.dx)
                        if wp.length_sq(after - v) > 0.0:
                            wp.atomic_add(boundary_impulse, e, m * (after - v))
                        v = after
                    if split:
                        v -= vk
                    out = vec8(0.0, v[0], v[1], v[2], vk[0], vk[1], vk[2], 0.0)
                node_velocity[e, n] = out
                node_sum[e, n] = vec8()
                if near:
                    node_offset[e, n] = wp.vec3(0.0)
