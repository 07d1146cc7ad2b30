"""The gather of a body from the velocities in the shared memory of its CUDA block."""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.colliders import nearest_boundary
from piavatar_envs.mpm.gather import Gathered, Gradients, asks_kinematic, finish_gather, gather
from piavatar_envs.mpm.shared_grid import (
    bricks_around,
    kinematic_at,
    kinematic_of,
    line_in_bricks,
    physical_at,
)
from piavatar_envs.mpm.shared_memory import has_bit, meet_warp, thread_of_block, threads_of_block
from piavatar_envs.mpm.stencil import Stencil, grid_position, stencil_at
from piavatar_envs.mpm.stores import store_particle
from piavatar_envs.mpm.types import (
    Blocks,
    Boundaries,
    Grid,
    Moving,
    Particles,
    Room,
    Step,
    vec8i,
)

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def kinematic_from_bricks(room: Room, bricks: vec8i, stencil: Stencil):
    """Kinematic velocity of a stencil's nodes, in components 1 to 3; few particles ask for it."""
    base = stencil.base
    wz = stencil.wz
    mean = wp.vec4()
    lines = int(9)  # not a constant: it is as short as can be
    for n in range(lines):
        at = line_in_bricks(bricks, base, n // 3, n % 3)
        w = stencil.wx[n // 3] * stencil.wy[n % 3]
        first = wz[0] * kinematic_at(kinematic_of(room, at[0]))
        second = wz[1] * kinematic_at(kinematic_of(room, at[1]))
        mean += w * (first + second + wz[2] * kinematic_at(kinematic_of(room, at[2])))
    return mean


@wp.func
def physical_from_bricks(bricks: vec8i, stencil: Stencil):
    """Sums over a stencil, see :func:`piavatar_envs.mpm.gather.gather_physical`."""
    base = stencil.base
    wx = stencil.wx
    wy = stencil.wy
    wz = stencil.wz
    g = Gradients()
    planes = int(3)  # not a constant: too few registers for the loads of all three at once
    for i in range(planes):
        wi = wp.where(i == 0, wx[0], wp.where(i == 1, wx[1], wx[2]))
        plane = wp.vec4()
        along_y = wp.vec4()
        along_z = wp.vec4()
        for j in range(3):
            at = line_in_bricks(bricks, base, i, j)
            second = physical_at(at[1])
            third = physical_at(at[2])
            line = wz[0] * physical_at(at[0]) + wz[1] * second + wz[2] * third
            plane += wy[j] * line
            along_y += (float(j) * wy[j]) * line
            along_z += (wy[j] * wz[1]) * second + (2.0 * wy[j] * wz[2]) * third
        g.mean += wi * plane
        g.along_x += (float(i) * wi) * plane
        g.along_y += wi * along_y
        g.along_z += wi * along_z
    return g


@wp.func
def gather_from_bricks(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    blocks: Blocks,
    room: Room,
    moved: Moving,
    failure: wp.array(dtype=int),
    e: int,
    p: int,
):
    """Particle ``p`` from the nodes, see :func:`piavatar_envs.mpm.gather.gather`."""
    x = moved.x[e, p]
    stencil = stencil_at(grid_position(grid, x))
    bricks = bricks_around(grid, blocks, room, e, particles.field[p], stencil.base, 0)
    kinematic = Gradients()
    asked = bool(False)
    if has_bit(room.told, p):  # who is that near a boundary tells its place
        asked = asks_kinematic(grid, step, nearest_boundary(boundaries, e, x))
    if asked:
        kinematic.mean = kinematic_from_bricks(room, bricks, stencil)
    physical = physical_from_bricks(bricks, stencil)
    return finish_gather(
        grid, step, particles, boundaries, blocks, moved, failure, e, p, physical, kinematic, asked, stencil
    )  # fmt: skip


@wp.func
def gather_all(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    node_velocity: wp.array2d(dtype=wp.vec4),
    blocks: Blocks,
    room: Room,
    moved: Moving,
    failure: wp.array(dtype=int),
    e: int,
    fails: bool,
    outside: bool,
):
    """Move all particles, unless the environment ``fails``; velocities are in the room or ``outside``."""
    t = thread_of_block()
    count = moved.x.shape[1]
    if outside:
        for start in range(0, count, threads_of_block()):
            p = wp.min(start + t, count - 1)
            s = Gathered()
            stays = fails or p < start + t
            if not stays:
                s, _ = gather(grid, step, particles, boundaries, node_velocity, blocks, moved, failure, e, p)
            meet_warp()
            store_particle(moved, e, p, s, not stays and s.fault == 0)
    else:
        for start in range(0, count, threads_of_block()):
            p = wp.min(start + t, count - 1)
            s = Gathered()
            stays = fails or p < start + t
            if not stays:
                s = gather_from_bricks(grid, step, particles, boundaries, blocks, room, moved, failure, e, p)
            meet_warp()
            store_particle(moved, e, p, s, not stays and s.fault == 0)
