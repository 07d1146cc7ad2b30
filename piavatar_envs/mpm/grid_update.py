"""Grid update: momentum becomes velocity, gravity and colliders act, accumulators are cleared.

It covers the active blocks of one field; contact blocks are updated by :mod:`piavatar_envs.mpm.contact`.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.arrays import vec4l, vec8
from piavatar_envs.core.cuda_intrinsics import any_lane, environment_of, lane_of_thread, lanes_of_warp, sync_warp
from piavatar_envs.mpm.bspline import BLOCK_NODES, block_corner, node_of_block, node_position
from piavatar_envs.mpm.colliders import (
    COLLIDER_CONTACT_GATE,
    GATED_SLAB,
    NEAR_BLOCK,
    boundary_contact,
    nearest_boundary,
)
from piavatar_envs.mpm.contact_sensors import add_impulse, boundary_entry, moment_entry
from piavatar_envs.mpm.grid_arrays import (
    MASS_MIN,
    clear_offset,
    finish_take,
    load_accumulator,
    offset_at,
    quanta_of,
    take_accumulator,
    write_physical,
    write_record,
)
from piavatar_envs.mpm.sparse_grid import THREADS, exceeds_active_blocks, field_and_block, fields_next, num_active
from piavatar_envs.mpm.types import (
    NO_STRESS,
    PAPER,
    SPLIT,
    Accumulators,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Model,
    Sensors,
    Step,
)

# fast_math: divisions and roots to two units in the last place, without function calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

#: Threads of a warp.
LANES = 32
#: Active blocks for which a large GPU has threads at once.
BLOCKS_AT_ONCE = 132 * 28
#: Fewest active blocks for which an environment gets threads.
MIN_BLOCKS = 8
#: Nodes of a slab of a block, the unit for which distances from colliders are evaluated.
SLAB_NODES = wp.constant(16)


@wp.func
def total_velocity(step: Step, split: bool, s: vec8):
    """Return mass, total velocity (on which contact acts) and kinematic velocity of a node from its sums ``s``."""
    m = s[0]
    if m <= MASS_MIN:
        return vec8(m, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    vk = wp.vec3(s[4], s[5], s[6]) / m
    v = wp.vec3(s[1], s[2], s[3]) / m + step.dt * step.gravity
    if split:
        v += vk
    return vec8(m, v[0], v[1], v[2], vk[0], vk[1], vk[2], 0.0)


@wp.func
def collide_with_boundaries(
    grid: Grid,
    boundaries: Boundaries,
    contact: Contact,
    accumulators: Accumulators,
    e: int,
    f: int,
    r: int,
    at: wp.vec3,
    total: vec8,
    sensors: Sensors,
):
    """Return the total velocity of a field at node ``at`` after contact with colliders, and sense their impulse."""
    if total[0] <= MASS_MIN:
        return total
    offset = offset_at(grid, accumulators, e, f, r)
    matter = at - wp.vec3(offset[0], offset[1], offset[2]) / total[0]
    v = wp.vec3(total[1], total[2], total[3])
    dv = boundary_contact(boundaries, e, f, matter, v, COLLIDER_CONTACT_GATE * grid.dx) - v
    if wp.length_sq(dv) > 0.0:
        subject = contact.subject[f]
        add_impulse(sensors, e, boundary_entry(sensors, subject), total[0] * dv)
        add_impulse(sensors, e, moment_entry(sensors, subject), wp.cross(at, total[0] * dv))
    return total + vec8(0.0, dv[0], dv[1], dv[2], 0.0, 0.0, 0.0, 0.0)


@wp.func
def physical_velocity(split: bool, total: vec8):
    """Return mass, physical and kinematic velocity from mass, total and kinematic velocity."""
    if total[0] <= MASS_MIN:
        return vec8()
    if split:
        return total - vec8(0.0, total[4], total[5], total[6], 0.0, 0.0, 0.0, 0.0)
    return total


@wp.func
def slab_is_near(grid: Grid, boundaries: Boundaries, e: int, corner: wp.vec3i, local: int, reach: float):
    """Return whether a collider is within ``reach`` [grid spacings] of the slab of 4 x 4 nodes with node ``local``."""
    slab = local // SLAB_NODES
    center = node_position(grid, corner[0] + slab, corner[1], corner[2]) + grid.dx * wp.vec3(0.0, 1.5, 1.5)
    return nearest_boundary(boundaries, e, center) < reach * grid.dx


@wp.func
def block_is_near(grid: Grid, boundaries: Boundaries, e: int, corner: wp.vec3i):
    """Return whether particles based in the block at ``corner`` may be contact candidates because of a collider."""
    center = node_position(grid, corner[0], corner[1], corner[2]) + wp.vec3(2.5 * grid.dx)
    return nearest_boundary(boundaries, e, center) < NEAR_BLOCK * grid.dx


@wp.func
def node_position_in_block(grid: Grid, corner: wp.vec3i, local: int):
    """Return the position of node ``local`` of the block with the lowest node ``corner`` [m]."""
    node = node_of_block(corner, local)
    return node_position(grid, node[0], node[1], node[2])


def blocks_at_once(model: Model) -> int:
    """Return how many active blocks of an environment are updated at once; their warps then update further ones."""
    if wp.get_device(model.device).is_cuda:
        return min(model.max_active_blocks, max(MIN_BLOCKS, -(-BLOCKS_AT_ONCE // model.num_envs)))
    return model.max_active_blocks


def threads_per_active_block(model: Model) -> int:
    """Return how many threads update an active block."""
    return LANES if wp.get_device(model.device).is_cuda else 1


@wp.func
def nodes_of_lane():
    """Return how many nodes of a block each of those threads updates."""
    return BLOCK_NODES // lanes_of_warp()


@wp.func
def update_free_node(
    step: Step,
    accumulators: Accumulators,
    e: int,
    quanta: wp.vec2,
    r: int,
    loaded: vec4l,
    node_velocity: wp.array2d(dtype=wp.vec4),
):
    """Write the velocity of a node without contact candidates, whose sum is ``loaded``; only the physical one."""
    total = total_velocity(step, False, finish_take(accumulators, e, quanta, r, loaded, False))
    write_physical(node_velocity, e, r, physical_velocity(False, total))


@wp.func
def update_candidate_node(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    accumulators: Accumulators,
    e: int,
    quanta: wp.vec2,
    f: int,
    r: int,
    corner: wp.vec3i,
    near: bool,
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
):
    """Write the velocities of a node that contact candidates may have added to.

    A collider may be ``near`` it; ``corner`` is the lowest node of its block.
    """
    split = step.decoupling == SPLIT or step.decoupling == NO_STRESS
    total = total_velocity(
        step, split, finish_take(accumulators, e, quanta, r, load_accumulator(accumulators, e, r), True)
    )
    if near:
        at = node_position_in_block(grid, corner, r % BLOCK_NODES)
        total = collide_with_boundaries(grid, boundaries, contact, accumulators, e, f, r, at, total, sensors)
    write_record(node_velocity, e, r, physical_velocity(split, total))
    clear_offset(accumulators, e, r)


@wp.func
def update_block(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    accumulators: Accumulators,
    loaded: vec4l,
    loaded_next: vec4l,
    e: int,
    active: int,
    owner: wp.vec2i,
    candidates: bool,
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
):
    """Write the velocities of an active block of field and block ``owner``, from its sums; a warp shares the nodes.

    ``candidates``: contact candidates have added to it. The sums of each thread's first two nodes are loaded already.
    """
    driven = candidates or step.decoupling == PAPER
    quanta = quanta_of(accumulators, e, owner[0])
    lanes = lanes_of_warp()
    r = BLOCK_NODES * active + lane_of_thread()
    if driven:
        corner = block_corner(grid, owner[1])
        near = bool(False)
        for n in range(nodes_of_lane()):
            local = (r + n * lanes) % BLOCK_NODES
            if n == 0 or lanes > 1 or local % SLAB_NODES == 0:  # a CPU thread visits the nodes in order
                near = slab_is_near(grid, boundaries, e, corner, local, GATED_SLAB)
            update_candidate_node(
                grid, step, boundaries, contact, accumulators, e, quanta, owner[0], r + n * lanes, corner, near,
                node_velocity, sensors,
            )  # fmt: skip
    else:  # the usual case
        update_free_node(step, accumulators, e, quanta, r, loaded, node_velocity)
        update_free_node(step, accumulators, e, quanta, r + lanes, loaded_next, node_velocity)
        for n in range(2, nodes_of_lane()):  # on a CPU
            update_free_node(
                step,
                accumulators,
                e,
                quanta,
                r + n * lanes,
                load_accumulator(accumulators, e, r + n * lanes),
                node_velocity,
            )


@wp.func
def discard_nodes(accumulators: Accumulators, e: int, f: int, active: int):
    """Clear the accumulators of an active block of field ``f``; a warp shares the nodes.

    Active blocks are exhausted: the sums are incomplete, and the environment has failed.
    """
    for n in range(nodes_of_lane()):
        r = BLOCK_NODES * active + lane_of_thread() + n * lanes_of_warp()
        take_accumulator(accumulators, e, f, r)
        clear_offset(accumulators, e, r)


@wp.func
def store_near_field(grid: Grid, blocks: Blocks, e: int, active: int, owner: wp.vec2i):
    """Store whether a stencil based in an active block may overlap a block of another field.

    Nearly no particles of large bodies do, and their G2P skips the lookup. All threads of a warp must call this.
    """
    if blocks.near_field.shape[1] == 1:
        return
    around = fields_next(grid, blocks, owner[1], e, lane_of_thread() & 7)
    contact_nodes = any_lane((around & ~(1 << owner[0])) != 0)
    if lane_of_thread() == 0:
        blocks.near_field[e, active] = int(contact_nodes)


@wp.kernel(launch_bounds=(THREADS, 7))
def update_grid(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    active_blocks: int,
    failure: wp.array(dtype=int),
    # in and out: sums are read, then cleared
    blocks: Blocks,
    accumulators: Accumulators,
    # out
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
):
    """Write the velocity of every node with mass in blocks of one field; a warp has every ``active_blocks``-th of them.

    Contact acts on the total velocity ``v = u + vk``; the result is physical. Contact blocks are updated by
    :mod:`piavatar_envs.mpm.contact`, possibly in parallel.

    Nodes have offsets and kinematic momentum only from contact candidates (the latter from all particles with
    ``"paper"``), which flag the active blocks that they add to. Matter within the gate of a collider consists of
    candidates only, so colliders are skipped elsewhere.

    Where active blocks are exhausted, sums are discarded: parallel P2G of another part may not have seen it.
    """
    at = environment_of(wp.tid(), active_blocks * lanes_of_warp())
    e = at[0]
    active = at[1] // lanes_of_warp()
    used = num_active(blocks, e)
    stops = exceeds_active_blocks(failure, e)
    goes_on = bool(True)
    while goes_on:
        first = BLOCK_NODES * active + lane_of_thread()
        loaded = load_accumulator(accumulators, e, first)
        loaded_next = load_accumulator(accumulators, e, first + lanes_of_warp())
        n = blocks.owner[e, active]
        candidates = accumulators.candidates[e, active] != 0
        sync_warp()  # every thread has read its flags before one of them clears them
        if at[1] == 0 and active == 0:
            blocks.num_updated[e] = used
            blocks.frozen[e] = failure[e]  # P2G has ended
        if active < used:
            if candidates:
                accumulators.candidates[e, active] = 0
            owner = wp.vec2i(0, n)
            alone = bool(True)
            if stops:
                alone = bool(False)
                discard_nodes(accumulators, e, field_and_block(grid, n)[0], active)
            elif contact.num_fields > 1:
                owner = field_and_block(grid, n)
                alone = blocks.fields[e, owner[1]] == (1 << owner[0])
                store_near_field(grid, blocks, e, active, owner)
                if alone:
                    sensors.touched[e, active] = 0
            if alone:
                update_block(
                    grid, step, boundaries, contact, accumulators, loaded, loaded_next, e, active, owner, candidates,
                    node_velocity, sensors,
                )  # fmt: skip
        active += active_blocks
        goes_on = active < used
