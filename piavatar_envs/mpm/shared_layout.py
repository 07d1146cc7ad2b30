"""Which bricks of nodes a body touches, and which of its particles tell their places."""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.blocks import fields_beyond, slots_used
from piavatar_envs.mpm.colliders import GATED_SLAB
from piavatar_envs.mpm.grid import SLAB_NODES, block_is_near, slab_is_near
from piavatar_envs.mpm.shared_grid import (
    BLOCK_BRICKS,
    HEAVIEST,
    TOLD,
    TOUCHED,
    number_bricks,
    places_around,
)
from piavatar_envs.mpm.shared_memory import (
    add_word,
    byte,
    clear_words,
    fill_words,
    meet,
    or_word,
    raise_to,
    set_byte,
    set_half_word,
    thread_of_block,
    threads_of_block,
)
from piavatar_envs.mpm.stencil import BLOCK_NODES, base_node, block_corner, grid_position
from piavatar_envs.mpm.transfer import takes_part, tells_place
from piavatar_envs.mpm.types import Blocks, Boundaries, Contact, Grid, Particles, Room, row, vec8i

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Bit of a slot whose particles may tell their places; the bits of its four slabs come before.
MAY_TELL = wp.constant(16)


@wp.func
def block_of(grid: Grid, contact: Contact, held: int):
    """The block that a slot holds, of whatever field; a division, where there are several."""
    block = held
    if contact.num_fields > 1:
        block = held % grid.num_blocks
    return block


@wp.func
def record_of_place(place: int, node: int):
    """Record of node ``node`` of 2 x 2 x 2 of a brick."""
    brick = place % BLOCK_BRICKS
    i = ((brick >> 2) << 1) + (node >> 2)
    j = (((brick >> 1) & 1) << 1) + ((node >> 1) & 1)
    k = ((brick & 1) << 1) + (node & 1)
    return BLOCK_NODES * (place // BLOCK_BRICKS) + 16 * i + 4 * j + k


@wp.func
def place_of_record(r: int):
    """Place of the brick that a record's node is in, see :func:`record_of_place`."""
    return BLOCK_BRICKS * (r // BLOCK_NODES) + ((r >> 5) & 1) * 4 + ((r >> 3) & 1) * 2 + ((r >> 1) & 1)


@wp.func
def end_of_part(blocks: Blocks, failure: wp.array(dtype=int), e: int, part: wp.vec3i):
    """One after the last particle of a part that takes part: where the environment does not, they may be anywhere."""
    end = part[1]
    if not takes_part(blocks, e, failure):
        end = part[0]
    return end


@wp.func
def note_boundaries(grid: Grid, boundaries: Boundaries, contact: Contact, blocks: Blocks, room: Room, e: int):
    """Find the slabs of every slot that a boundary is near, and whether its particles may tell their places."""
    for slot in range(thread_of_block(), slots_used(blocks, e), threads_of_block()):
        held = blocks.held[e, slot]
        corner = block_corner(grid, block_of(grid, contact, held))
        bits = int(0)
        for slab in range(4):
            if slab_is_near(grid, boundaries, e, corner, SLAB_NODES * slab, GATED_SLAB):
                bits = bits | (1 << slab)
        near = block_is_near(grid, boundaries, e, corner)
        if contact.num_fields > 1:
            near = near or fields_beyond(grid, blocks, corner, e) != (1 << (held // grid.num_blocks))
        set_byte(room.near, slot, wp.where(near, bits | MAY_TELL, bits))


@wp.func
def touch_bricks(
    grid: Grid,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    blocks: Blocks,
    room: Room,
    e: int,
    p: int,
    at: wp.vec3,
    mass: float,
    field: int,
    places: vec8i,
):
    """Mark the bricks of a particle's stencil, which are at ``places``, and note whether it tells its place."""
    raise_to(HEAVIEST + field, mass)
    for b in range(8):
        set_half_word(room.numbers, places[b], TOUCHED)
    if (byte(room.near, places[0] // BLOCK_BRICKS) & MAY_TELL) != 0:  # noqa: SIM102 - `and` would ask in any case
        if tells_place(grid, particles, boundaries, contact, blocks, e, p, at, base_node(grid_position(grid, at))):
            or_word(room.told + p // 32, 1 << (p % 32))
            add_word(TOLD, 1)


@wp.func
def touch_with_all(
    grid: Grid,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    blocks: Blocks,
    room: Room,
    e: int,
    begin: int,
    end: int,
    x: wp.array2d(dtype=wp.vec3),
):
    """:func:`touch_bricks` with the particles from ``begin`` to ``end``, three of a thread at a time."""
    r = row(e, particles.mass.shape[0])
    step = threads_of_block()
    for p in range(begin + thread_of_block(), end, 3 * step):
        second = wp.min(p + step, end - 1)
        third = wp.min(p + 2 * step, end - 1)
        at = x[e, p]
        at_second = x[e, second]
        at_third = x[e, third]
        f = wp.vec3i(particles.field[p], particles.field[second], particles.field[third])
        m = wp.vec3(particles.mass[r, p], particles.mass[r, second], particles.mass[r, third])
        n = places_around(grid, blocks, e, f[0], base_node(grid_position(grid, at)))
        n_second = places_around(grid, blocks, e, f[1], base_node(grid_position(grid, at_second)))
        n_third = places_around(grid, blocks, e, f[2], base_node(grid_position(grid, at_third)))
        touch_bricks(grid, particles, boundaries, contact, blocks, room, e, p, at, m[0], f[0], n)
        if p + step < end:
            touch_bricks(grid, particles, boundaries, contact, blocks, room, e, second, at_second, m[1], f[1], n_second)
        if p + 2 * step < end:
            touch_bricks(grid, particles, boundaries, contact, blocks, room, e, third, at_third, m[2], f[2], n_third)


@wp.func
def lay_out(
    grid: Grid,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    blocks: Blocks,
    room: Room,
    failure: wp.array(dtype=int),
    e: int,
    part: wp.vec3i,
    x: wp.array2d(dtype=wp.vec3),
):
    """Number the bricks that particles touch, and find the particles that tell their places.

    Bricks that no boundary is near come first, so that few warps have to do with boundaries at their nodes.
    """
    clear_words(0, room.numbers)
    fill_words(room.numbers, room.told - room.numbers, -1)  # NO_BRICK twice
    clear_words(room.told, room.places - room.told)
    meet()
    note_boundaries(grid, boundaries, contact, blocks, room, e)
    meet()
    end = end_of_part(blocks, failure, e, part)
    touch_with_all(grid, particles, boundaries, contact, blocks, room, e, part[0], end, x)
    meet()
    most = BLOCK_BRICKS * slots_used(blocks, e)
    number_bricks(room.numbers, room.places, room.near, most, False)
    meet()
    number_bricks(room.numbers, room.places, room.near, most, True)
    meet()
