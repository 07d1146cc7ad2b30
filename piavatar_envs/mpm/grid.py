"""The grid pass: momentum to velocity, gravity, contact; clears what it reads."""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.blocks import beside_others, held_by, slots_used
from piavatar_envs.mpm.colliders import CONTACT_GATE, NEAR_BLOCK, NEAR_SLAB, boundary_contact, nearest_boundary
from piavatar_envs.mpm.impulses import add_impulse, boundary_entry, moment_entry
from piavatar_envs.mpm.normals import MASS_MIN, face_shared
from piavatar_envs.mpm.records import write_kinematic, write_physical
from piavatar_envs.mpm.stencil import BLOCK_NODES, block_corner, node_of_block, node_position
from piavatar_envs.mpm.sums import begin_sum, clear_offset, end_sum, offset_at
from piavatar_envs.mpm.sweep import THREADS, Sweep, any_lane, first_node, from_lane, lane_of_thread, lanes_of_warp
from piavatar_envs.mpm.threads import environment_of
from piavatar_envs.mpm.types import (
    NO_STRESS,
    PAPER,
    SPLIT,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Sensors,
    Step,
    Sums,
    vec4l,
    vec8,
)

# on a GPU, divisions and roots to two units in the last place, in a few instructions instead of calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

#: Nodes of a slab of a block, the unit in which boundaries are looked for.
SLAB_NODES = wp.constant(16)
#: One more than the bits of all slabs of a block.
ALL_SLABS = wp.constant(16)


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
def meet_boundaries(
    grid: Grid,
    boundaries: Boundaries,
    contact: Contact,
    sums: Sums,
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
    offset = offset_at(grid, sums, e, f, r)
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
def with_near(grid: Grid, sweep: Sweep, boundaries: Boundaries, e: int, held: wp.vec2i, begin: int):
    """Field and block of a slot, with the field a bit for each slab that a boundary is near; -1 and 0 stay.

    A slab has 4 x 4 nodes; the bits are right for those of a turn from record ``begin``.
    """
    if held[0] < 0:
        return held
    corner = block_corner(grid, held[1])
    first = (begin % BLOCK_NODES) // SLAB_NODES
    about = held[0] * ALL_SLABS
    for slab in range(first, first + wp.max(sweep.share // SLAB_NODES, 2)):  # a warp's turn is two slabs
        if slab_is_near(grid, boundaries, e, corner, slab * SLAB_NODES, NEAR_SLAB):
            about = about | (1 << slab)
    return wp.vec2i(about, held[1])


@wp.func
def near_node(about: int, local: int):
    """Whether a boundary is near the slab of node ``local``, from what :func:`with_near` says."""
    return ((about >> (local // SLAB_NODES)) & 1) != 0


@wp.func
def place_of(grid: Grid, corner: wp.vec3i, local: int):
    """Position of node ``local`` of the block with the lowest node ``corner`` [m]."""
    node = node_of_block(corner, local)
    return node_position(grid, node[0], node[1], node[2])


@wp.func
def alone_in(grid: Grid, contact: Contact, blocks: Blocks, sensors: Sensors, e: int, r: int):
    """Field and block of record ``r`` if the block has no other field, else -1 and 0; nothing has touched it yet."""
    held = held_by(grid, blocks, e, r // BLOCK_NODES)
    if held[0] >= 0 and contact.num_fields > 1:
        sensors.touched[e, r // BLOCK_NODES] = 0
        if blocks.fields[e, held[1]] != (1 << held[0]):
            held = wp.vec2i(-1, 0)
    return held


@wp.func
def told_by_neighbours(grid: Grid, contact: Contact, blocks: Blocks, e: int, f: int, corner: wp.vec3i):
    """Whether particles next to another field may have left their offsets in the block of field ``f`` at ``corner``."""
    told = bool(False)
    if contact.num_fields > 1 and blocks.num_shared[e] > 0:
        for n in range(lane_of_thread(), 27, lanes_of_warp()):
            told = told or beside_others(grid, blocks, e, f, corner, n)
        told = any_lane(told)
    return told


@wp.func
def update_node(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    sums: Sums,
    begun: vec4l,
    e: int,
    f: int,
    r: int,
    corner: wp.vec3i,
    is_near: bool,
    is_told: bool,
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
):
    """Sums of a node to velocities; kinematic ones where somebody has told them, or the variant asks everybody."""
    split = step.decoupling == SPLIT or step.decoupling == NO_STRESS
    driven = is_told or step.decoupling == PAPER
    total = total_velocity(step, split, end_sum(sums, e, f, r, begun, driven))
    if is_near:  # most skip all of that work
        x = place_of(grid, corner, r % BLOCK_NODES)
        total = meet_boundaries(grid, boundaries, contact, sums, e, f, r, x, total, sensors)
    v = physical_velocity(split, total)
    write_physical(node_velocity, e, r, v)
    if driven:
        write_kinematic(node_velocity, e, r, v)
    if is_told:
        clear_offset(sums, e, r)


@wp.kernel(launch_bounds=(THREADS, 7))
def update_grid(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    sweep: Sweep,
    of_shared: Sweep,
    failure: wp.array(dtype=int),
    # in and out: sums are read, then cleared
    blocks: Blocks,
    sums: Sums,
    # out
    node_velocity: wp.array2d(dtype=wp.vec4),
    node_facing: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
):
    """Velocity of every node with mass in blocks of one field.

    Contact acts on the total velocity ``v = u + vk``; the rest is physical. Where there are several fields, the first
    threads prepare contact, see :func:`piavatar_envs.mpm.normals.face_shared`: they are few, and have the longest to
    wait.

    Nodes have offsets and, but for the paper's variant, kinematic momentum only from particles that tell their place,
    see :func:`piavatar_envs.mpm.transfer.tells_place`. Such a particle is at most ``NEAR_PARTICLE`` from a boundary,
    and then every node of its stencil is in a slab within ``NEAR_SLAB``; or a block of its stencil has another field
    besides its own, and then every block of its stencil is that one or one of its neighbours, and told.
    """
    at = environment_of(wp.tid(), of_shared.threads + sweep.threads)
    e = at[0]
    place = at[1]
    if place < of_shared.threads:
        face_shared(grid, contact, of_shared, blocks, sums, e, place, node_velocity, node_facing)
        return
    thread = place - of_shared.threads
    lane = lane_of_thread()
    used = slots_used(blocks, e)
    if thread == 0:
        blocks.swept[e] = used
        blocks.frozen[e] = failure[e]  # the scatter has ended
    end = BLOCK_NODES * used
    begin = first_node(sweep, thread)
    # asked for early: who waits for one answer after the other waits for most of the pass
    next_sum = begin_sum(sums, e, begin + lane)
    held = alone_in(grid, contact, blocks, sensors, e, begin + lane * sweep.stride)
    if begin >= end:
        return
    known = with_near(grid, sweep, boundaries, e, held, begin)
    for turn in range(sweep.turns):
        first = begin + turn * sweep.stride
        if first >= end:
            break
        sum = next_sum
        if first + sweep.stride < end and turn + 1 < sweep.turns:
            next_sum = begin_sum(sums, e, first + sweep.stride + lane)
        about = from_lane(known[0], turn)
        if about < 0:
            continue
        f = about // ALL_SLABS
        block = from_lane(known[1], turn)
        corner = wp.vec3i()
        if contact.num_fields > 1 or about % ALL_SLABS != 0:
            corner = block_corner(grid, block)
        told = told_by_neighbours(grid, contact, blocks, e, f, corner)
        for r in range(first + lane, first + lane + sweep.share):
            is_near = near_node(about, r % BLOCK_NODES)
            if r > first + lane:  # on a CPU, where a thread takes a block
                sum = begin_sum(sums, e, r)
            update_node(
                grid, step, boundaries, contact, sums, sum, e, f, r, corner, is_near, is_near or told, node_velocity,
                sensors,
            )  # fmt: skip
