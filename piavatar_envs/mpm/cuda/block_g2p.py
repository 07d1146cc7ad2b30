"""Grid update and G2P of a body whose nodes are in the shared memory of its CUDA block."""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.arrays import vec8, vec8i
from piavatar_envs.core.cuda_intrinsics import sync_warp, thread_of_block, threads_of_block
from piavatar_envs.core.shared_memory import float_word, half_word, has_bit, word
from piavatar_envs.mpm.bspline import BLOCK_NODES, Stencil, block_corner, grid_position, stencil_at
from piavatar_envs.mpm.colliders import nearest_boundary
from piavatar_envs.mpm.cuda.block_grid import (
    BLOCK_SUBBLOCKS,
    NO_SUBBLOCK,
    PLACES,
    SPEED,
    block_of,
    in_flagged_plane,
    kinematic_at,
    kinematic_of,
    kinematic_word,
    line_in_subblocks,
    mass_quantum_of,
    node_word,
    physical_at,
    place_of_record,
    record_of_place,
    set_velocities,
    subblocks_around,
    subblocks_of_round,
    sums_at,
)
from piavatar_envs.mpm.g2p import Advanced, Gradients, advance_particle, g2p_particle, needs_kinematic, store_particle
from piavatar_envs.mpm.grid_arrays import write_record
from piavatar_envs.mpm.grid_update import (
    collide_with_boundaries,
    node_position_in_block,
    physical_velocity,
    total_velocity,
)
from piavatar_envs.mpm.sparse_grid import has_field, num_active
from piavatar_envs.mpm.types import (
    NO_STRESS,
    SPLIT,
    Accumulators,
    Arena,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Moving,
    Particles,
    Sensors,
    Step,
)

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def updated_node(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    blocks: Blocks,
    arena: Arena,
    accumulators: Accumulators,
    sensors: Sensors,
    e: int,
    n: int,
    flagged: int,
    quantum: float,
    speed: float,
):
    """Return the velocities of node ``n`` of a round; ``quantum`` and ``speed`` are those of a single field.

    See :func:`piavatar_envs.mpm.grid_update.update_grid`. In contact blocks it returns the sums themselves.
    """
    split = step.decoupling == SPLIT or step.decoupling == NO_STRESS
    several = contact.num_fields > 1
    near = in_flagged_plane(flagged, n)
    place = flagged % PLACES
    r = record_of_place(place, n % 8)
    block = int(0)
    f = int(0)
    m = float(quantum)
    q = quantum * speed
    if near or several:  # the others skip the load
        owner = blocks.owner[e, place // BLOCK_SUBBLOCKS]
        block = block_of(grid, contact, owner)
        if several:
            f = owner // grid.num_blocks
            m = mass_quantum_of(f)
            q = m * float_word(SPEED + f)
    physical = sums_at(node_word(arena, n))
    at = kinematic_word(arena, n)
    s = vec8(
        m * float(physical[0]), q * float(physical[1]), q * float(physical[2]), q * float(physical[3]),
        q * float(word(at)), q * float(word(at + 1)), q * float(word(at + 2)), 0.0,
    )  # fmt: skip
    if not several or blocks.fields[e, block] == (1 << f):
        s = total_velocity(step, split, s)
        if near:
            x = node_position_in_block(grid, block_corner(grid, block), r % BLOCK_NODES)
            s = collide_with_boundaries(grid, boundaries, contact, accumulators, e, f, r, x, s, sensors)
        s = physical_velocity(split, s)
        if near or several:
            accumulators.offset[e, r] = wp.vec4()
    return s


@wp.func
def update_subblocks(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    blocks: Blocks,
    arena: Arena,
    accumulators: Accumulators,
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
    e: int,
    first: int,
    writes: bool,
):
    """Convert the sums of a round's nodes to velocities, in place, or to global memory if it ``writes``.

    All threads must call this.
    """
    quantum = mass_quantum_of(0)
    speed = float_word(SPEED)
    count = 8 * subblocks_of_round(arena, first)
    for n in range(thread_of_block(), count, threads_of_block()):
        flagged = half_word(arena.places, first + n // 8)
        s = updated_node(
            grid, step, boundaries, contact, blocks, arena, accumulators, sensors, e, n, flagged, quantum, speed
        )  # fmt: skip
        if writes:
            write_record(node_velocity, e, record_of_place(flagged % PLACES, n % 8), s)
        else:
            set_velocities(node_word(arena, n), kinematic_word(arena, n), s)


@wp.func
def clear_untouched(
    grid: Grid,
    blocks: Blocks,
    arena: Arena,
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
    e: int,
    partition: wp.vec3i,
):
    """Zero the records of untouched nodes in active blocks of a partition's fields, and ``touched`` flags."""
    for r in range(thread_of_block(), BLOCK_NODES * num_active(blocks, e), threads_of_block()):
        active = r // BLOCK_NODES
        if has_field(partition[2], blocks.owner[e, active] // grid.num_blocks):
            if half_word(arena.numbers, place_of_record(r)) == NO_SUBBLOCK:
                write_record(node_velocity, e, r, vec8())
            if r % BLOCK_NODES == 0:
                sensors.touched[e, active] = 0


@wp.func
def kinematic_from_subblocks(arena: Arena, subblocks: vec8i, stencil: Stencil):
    """Return the kinematic velocity of a stencil in components 1 to 3; compact code, because few particles need it."""
    base = stencil.base
    wz = stencil.wz
    mean = wp.vec4()
    lines = int(9)  # a variable, to keep the loop
    for n in range(lines):
        at = line_in_subblocks(subblocks, base, n // 3, n % 3)
        w = stencil.wx[n // 3] * stencil.wy[n % 3]
        first = wz[0] * kinematic_at(kinematic_of(arena, at[0]))
        second = wz[1] * kinematic_at(kinematic_of(arena, at[1]))
        mean += w * (first + second + wz[2] * kinematic_at(kinematic_of(arena, at[2])))
    return mean


@wp.func
def physical_from_subblocks(subblocks: vec8i, stencil: Stencil):
    """Return the sums over a stencil of :func:`piavatar_envs.mpm.g2p.sum_physical`."""
    base = stencil.base
    wx = stencil.wx
    wy = stencil.wy
    wz = stencil.wz
    g = Gradients()
    planes = int(3)  # a variable, to keep the loop: unrolled, its loads need too many registers
    for i in range(planes):
        wi = wp.where(i == 0, wx[0], wp.where(i == 1, wx[1], wx[2]))
        plane = wp.vec4()
        along_y = wp.vec4()
        along_z = wp.vec4()
        for j in range(3):
            at = line_in_subblocks(subblocks, base, i, j)
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
def g2p_from_subblocks(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    blocks: Blocks,
    arena: Arena,
    moved: Moving,
    failure: wp.array(dtype=int),
    sensors: Sensors,
    e: int,
    p: int,
):
    """Return particle ``p`` after the substep; see :func:`piavatar_envs.mpm.g2p.g2p_particle`."""
    x = moved.x[e, p]
    stencil = stencil_at(grid_position(grid, x))
    subblocks = subblocks_around(grid, blocks, arena, e, particles.field[p], stencil.base, 0)
    kinematic = Gradients()
    needed = bool(False)
    if has_bit(arena.candidates, p):  # only a candidate can be that near a collider
        needed = needs_kinematic(grid, step, nearest_boundary(boundaries, e, x))
    if needed:
        kinematic.mean = kinematic_from_subblocks(arena, subblocks, stencil)
    physical = physical_from_subblocks(subblocks, stencil)
    return advance_particle(
        grid, step, particles, boundaries, blocks, moved, failure, sensors, e, p, physical, kinematic, needed,
        stencil,
    )  # fmt: skip


@wp.func
def g2p_all(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    node_velocity: wp.array2d(dtype=wp.vec4),
    blocks: Blocks,
    arena: Arena,
    moved: Moving,
    failure: wp.array(dtype=int),
    sensors: Sensors,
    e: int,
    fails: bool,
    outside: bool,
):
    """Move all particles unless the environment ``fails``; velocities are in shared memory or ``outside`` of it."""
    t = thread_of_block()
    count = moved.x.shape[1]
    if outside:
        for start in range(0, count, threads_of_block()):
            p = wp.min(start + t, count - 1)
            s = Advanced()
            stays = fails or p < start + t
            if not stays:
                s, _ = g2p_particle(
                    grid, step, particles, boundaries, node_velocity, blocks, moved, failure, sensors, e, p
                )
            sync_warp()
            store_particle(moved, e, p, s, not stays and s.fault == 0)
    else:
        for start in range(0, count, threads_of_block()):
            p = wp.min(start + t, count - 1)
            s = Advanced()
            stays = fails or p < start + t
            if not stays:
                s = g2p_from_subblocks(grid, step, particles, boundaries, blocks, arena, moved, failure, sensors, e, p)
            sync_warp()
            store_particle(moved, e, p, s, not stays and s.fault == 0)
