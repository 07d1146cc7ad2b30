"""The grid pass: momentum to velocity, gravity, contact; clears what it reads."""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.arrays import vec4l, vec8
from piavatar_envs.core.cuda_intrinsics import any_lane, environment_of, lane_of_thread, lanes_of_warp, sync_warp
from piavatar_envs.mpm.bspline import BLOCK_NODES, block_corner, node_of_block, node_position
from piavatar_envs.mpm.colliders import CONTACT_GATE, GATED_SLAB, NEAR_BLOCK, boundary_contact, nearest_boundary
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

# on a GPU, divisions and roots to two units in the last place, in a few instructions instead of calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

#: Threads of a warp.
LANES = 32

#: Slots for which a large GPU has threads at once, and the fewest for which an environment gets them.
BLOCKS_AT_ONCE = 132 * 28

MIN_BLOCKS = 8

#: Nodes of a slab of a block, the unit in which boundaries are looked for.
SLAB_NODES = wp.constant(16)


@wp.func
def total_velocity(step: Step, split: bool, s: vec8):
    """Mass, velocity that contact acts on, and kinematic velocity of a node, from its sums."""
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
    """Total velocity of a field's matter at node ``at`` after contact with the boundaries; their impulse is sensed."""
    if total[0] <= MASS_MIN:
        return total
    offset = offset_at(grid, accumulators, e, f, r)
    matter = at - wp.vec3(offset[0], offset[1], offset[2]) / total[0]
    v = wp.vec3(total[1], total[2], total[3])
    dv = boundary_contact(boundaries, e, f, matter, v, CONTACT_GATE * grid.dx) - v
    if wp.length_sq(dv) > 0.0:
        subject = contact.subject[f]
        add_impulse(sensors, e, boundary_entry(sensors, subject), total[0] * dv)
        add_impulse(sensors, e, moment_entry(sensors, subject), wp.cross(at, total[0] * dv))
    return total + vec8(0.0, dv[0], dv[1], dv[2], 0.0, 0.0, 0.0, 0.0)


@wp.func
def physical_velocity(split: bool, total: vec8):
    """Mass, physical and kinematic velocity from mass, total and kinematic velocity."""
    if total[0] <= MASS_MIN:
        return vec8()
    if split:
        return total - vec8(0.0, total[4], total[5], total[6], 0.0, 0.0, 0.0, 0.0)
    return total


@wp.func
def slab_is_near(grid: Grid, boundaries: Boundaries, e: int, corner: wp.vec3i, local: int, reach: float):
    """Whether a boundary is within ``reach`` [grid spacings] of the slab of 4 x 4 nodes of a block's node ``local``."""
    slab = local // SLAB_NODES
    center = node_position(grid, corner[0] + slab, corner[1], corner[2]) + grid.dx * wp.vec3(0.0, 1.5, 1.5)
    return nearest_boundary(boundaries, e, center) < reach * grid.dx


@wp.func
def block_is_near(grid: Grid, boundaries: Boundaries, e: int, corner: wp.vec3i):
    """Whether particles whose base is in the block at ``corner`` may be near enough to a boundary to tell it."""
    center = node_position(grid, corner[0], corner[1], corner[2]) + wp.vec3(2.5 * grid.dx)
    return nearest_boundary(boundaries, e, center) < NEAR_BLOCK * grid.dx


@wp.func
def node_position_in_block(grid: Grid, corner: wp.vec3i, local: int):
    """Position of node ``local`` of the block with the lowest node ``corner`` [m]."""
    node = node_of_block(corner, local)
    return node_position(grid, node[0], node[1], node[2])


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
    """Velocity of a node that has been told nothing, from the sum that has ``loaded``: it has no kinematic one."""
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
    """Velocities of a node that may have been told where particles are and how they are driven.

    A boundary may be ``near`` the matter there; ``corner`` is the lowest node of its block.
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
    """Sums of a slot's nodes to velocities; it is ``owner`` by a field, for a block, and some may have been ``candidates``.

    The threads of a warp share the nodes; the sums of each one's first two have ``loaded``.
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
            if n == 0 or lanes > 1 or local % SLAB_NODES == 0:  # a thread of a CPU goes from node to node
                near = slab_is_near(grid, boundaries, e, corner, local, GATED_SLAB)
            update_candidate_node(
                grid, step, boundaries, contact, accumulators, e, quanta, owner[0], r + n * lanes, corner, near, node_velocity,
                sensors,
            )  # fmt: skip
    else:  # most have nothing else to do
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
    """Forget the sums of a slot's nodes, of field ``f``; a warp shares them.

    Slots have run out: what has been added up is of some particles only, and nobody goes on from it.
    """
    for n in range(nodes_of_lane()):
        r = BLOCK_NODES * active + lane_of_thread() + n * lanes_of_warp()
        take_accumulator(accumulators, e, f, r)
        clear_offset(accumulators, e, r)


@wp.func
def store_near_field(grid: Grid, blocks: Blocks, e: int, active: int, owner: wp.vec2i):
    """Note whether a stencil that begins in a slot's block, ``owner`` by a field, may lie in a block of another one.

    Nearly no particles of large bodies do, and their gather need not look around. All threads of a warp come here.
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
    """Velocity of every node with mass in blocks of one field; a warp has every ``active_blocks``-th, on a CPU a thread.

    Contact acts on the total velocity ``v = u + vk``; the rest is physical. Blocks with several fields are seen to by
    :mod:`piavatar_envs.mpm.contact`, maybe at the same time.

    Nodes have offsets and kinematic momentum only from particles that tell their place, see
    :func:`piavatar_envs.mpm.p2g.is_contact_candidate`, and who scatters those notes in which slots. (Of the paper's variant
    all have the latter, and groups scatter both.) Matter within the gate of a boundary is of such particles only, so
    elsewhere nobody asks for boundaries.

    Where slots have run out, sums are forgotten: a part of the world may have been scattered that did not know of it.
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
        sync_warp()  # all is asked for before the first has answered, and read before it is written
        if at[1] == 0 and active == 0:
            blocks.num_updated[e] = used
            blocks.frozen[e] = failure[e]  # the scatter has ended
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
                    grid, step, boundaries, contact, accumulators, loaded, loaded_next, e, active, owner, candidates, node_velocity,
                    sensors,
                )  # fmt: skip
        active += active_blocks
        goes_on = active < used


def blocks_at_once(model: Model) -> int:
    """Slots of an environment that a grid pass begins with; who has one comes back for more."""
    if wp.get_device(model.device).is_cuda:
        return min(model.max_active_blocks, max(MIN_BLOCKS, -(-BLOCKS_AT_ONCE // model.num_envs)))
    return model.max_active_blocks


def threads_per_active_block(model: Model) -> int:
    """Threads that a slot has in a grid pass."""
    return LANES if wp.get_device(model.device).is_cuda else 1


@wp.func
def nodes_of_lane():
    """Nodes of a block that each of them has."""
    return BLOCK_NODES // lanes_of_warp()
