"""The scatter of a body into the shared memory of its CUDA block: bricks are numbered, and integers added up.

Where they lie is in :mod:`piavatar_envs.mpm.shared_grid`. The result does not depend on the order of the threads, and
not on how many bricks there is room for.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.blocks import fields_beyond, slots_used
from piavatar_envs.mpm.grid import SLAB_NODES, block_is_near, slab_is_near
from piavatar_envs.mpm.runs import fault_of_sums
from piavatar_envs.mpm.shared_grid import (
    BLOCK_BRICKS,
    BRICK_WORDS,
    COUNT,
    FASTEST,
    FAULTS,
    HEAVIEST,
    PLACES,
    SPEED,
    TOLD,
    add_place,
    add_to_bricks,
    bricks_around,
    bricks_of_round,
    node_word,
    number_bricks,
    places_around,
)
from piavatar_envs.mpm.shared_memory import (
    clear_words,
    half_word,
    has_bit,
    meet,
    number,
    or_word,
    raise_to,
    set_half_word,
    set_word,
    thread_of_block,
    threads_of_block,
    word,
)
from piavatar_envs.mpm.shared_units import correct_units, speed_of, speeds_known, sums_hold, unit_of_mass, unit_of_place
from piavatar_envs.mpm.stencil import BLOCK_NODES, base_node, block_corner, grid_position, spline
from piavatar_envs.mpm.transfer import (
    prepare,
    scatters,
    tells_place,
)
from piavatar_envs.mpm.types import (
    FAILURE_BLOCKS,
    FAILURE_CFL,
    FAILURE_NONFINITE,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Moving,
    Particles,
    Room,
    Step,
    Sums,
    row,
)

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

_BLOCKS = wp.constant(FAILURE_BLOCKS)
_CFL = wp.constant(FAILURE_CFL)
_NONFINITE = wp.constant(FAILURE_NONFINITE)
#: A particle that goes or is driven further than this in a substep [grid spacings] has failed, and is not added up.
MOST_CELLS = wp.constant(8.0)


@wp.func
def block_of(grid: Grid, contact: Contact, held: int):
    """The block that a slot holds, of whatever field; a division, where there are several."""
    block = held
    if contact.num_fields > 1:
        block = held % grid.num_blocks
    return block


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

    Planes of a brick that a boundary is near have their bits in its place.
    """
    t = thread_of_block()
    most = BLOCK_BRICKS * slots_used(blocks, e)
    clear_words(0, room.places)
    meet()
    for slot in range(t, slots_used(blocks, e), threads_of_block()):
        block = block_of(grid, contact, blocks.held[e, slot])
        corner = block_corner(grid, block)
        near = block_is_near(grid, boundaries, e, corner)
        if contact.num_fields > 1:
            near = near or fields_beyond(grid, blocks, corner, e) != (1 << (blocks.held[e, slot] // grid.num_blocks))
        if near:
            or_word(room.near + slot // 32, 1 << (slot % 32))
    meet()
    end = part[1]
    if blocks.frozen[e] != 0 or (failure[e] & _BLOCKS) != 0:
        end = part[0]  # they may be anywhere
    for p in range(part[0] + t, end, threads_of_block()):
        at = x[e, p]
        field = particles.field[p]
        raise_to(HEAVIEST + field, particles.mass[row(e, particles.mass.shape[0]), p])
        base = base_node(grid_position(grid, at))
        n = places_around(grid, blocks, e, field, base)
        for b in range(8):
            set_half_word(room.numbers, n[b], 1)
        if has_bit(room.near, n[0] // BLOCK_BRICKS):  # noqa: SIM102 - `and` would ask in any case
            if tells_place(grid, particles, boundaries, contact, blocks, e, p, at, base):
                or_word(room.told + p // 32, 1 << (p % 32))
                set_word(TOLD, 1)
    meet()
    number_bricks(room.numbers, room.places, most)
    meet()
    for n in range(t, word(COUNT), threads_of_block()):
        place = half_word(room.places, n)
        corner = block_corner(grid, block_of(grid, contact, blocks.held[e, place // BLOCK_BRICKS]))
        first = record_of_place(place, 0) % BLOCK_NODES
        for plane in range(2):
            if slab_is_near(grid, boundaries, e, corner, first + SLAB_NODES * plane):
                place += PLACES << plane
        set_half_word(room.places, n, place)
    meet()


@wp.func
def scatter_places(
    grid: Grid,
    particles: Particles,
    blocks: Blocks,
    room: Room,
    e: int,
    part: wp.vec3i,
    first: int,
    x: wp.array2d(dtype=wp.vec3),
    # out
    sums: Sums,
):
    """Where particles are, to the nodes' offsets, from those that tell it."""
    t = thread_of_block()
    clear_words(room.bricks, BRICK_WORDS * bricks_of_round(room, first))
    meet()
    for p in range(part[0] + t, part[1], threads_of_block()):
        if has_bit(room.told, p):
            field = particles.field[p]
            xg = grid_position(grid, x[e, p])
            base = base_node(xg)
            f = xg - wp.vec3(float(base[0]), float(base[1]), float(base[2]))
            m = particles.mass[row(e, particles.mass.shape[0]), p] / unit_of_place(field)
            n = bricks_around(grid, blocks, room, e, field, base, first)
            add_place(n, base, spline(f[0]), spline(f[1]), spline(f[2]), m, particles.seam[p])
    meet()
    for n in range(t, 8 * bricks_of_round(room, first), threads_of_block()):
        at = node_word(room, n)
        place = half_word(room.places, first + n // 8) % PLACES
        if word(at) != 0 or word(at + 1) != 0 or word(at + 2) != 0 or word(at + 3) != 0:
            unit = unit_of_place(blocks.held[e, place // BLOCK_BRICKS] // grid.num_blocks)
            o = (grid.dx * unit) * wp.vec3(float(word(at)), float(word(at + 1)), float(word(at + 2)))
            sums.offset[e, record_of_place(place, n % 8)] = wp.vec4(o[0], o[1], o[2], unit * float(word(at + 3)))
    meet()


@wp.func
def record_of_place(place: int, node: int):
    """Record of node ``node`` of 2 x 2 x 2 of a brick."""
    brick = place % BLOCK_BRICKS
    i = ((brick >> 2) << 1) + (node >> 2)
    j = (((brick >> 1) & 1) << 1) + ((node >> 1) & 1)
    k = ((brick & 1) << 1) + (node & 1)
    return BLOCK_NODES * (place // BLOCK_BRICKS) + 16 * i + 4 * j + k


@wp.func
def scatter_momenta(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    blocks: Blocks,
    room: Room,
    sums: Sums,
    failure: wp.array(dtype=int),
    e: int,
    part: wp.vec3i,
    first: int,
    adds: bool,
):
    """Find the fastest particle of every field, and where it ``adds``, add masses and momenta of all to the bricks."""
    t = thread_of_block()
    if t < room.speed.shape[1]:
        set_word(FASTEST + t, 0)
    if adds:
        clear_words(room.bricks, BRICK_WORDS * bricks_of_round(room, first))
    meet()
    for p in range(part[0] + t, part[1], threads_of_block()):
        if scatters(blocks, moving, e, p, failure):
            field = particles.field[p]
            s = prepare(grid, step, particles, moving, e, p, has_bit(room.told, p))
            fault = fault_of_sums(s, sums.momentum_unit[row(e, sums.momentum_unit.shape[0]), field])
            speed = speed_of(s)
            if fault != 0:
                wp.atomic_or(failure, e, fault)
                or_word(FAULTS, fault)
            elif speed * step.dt > MOST_CELLS * grid.dx:  # it would blur the sums of the others
                wp.atomic_or(failure, e, _CFL)
            else:
                raise_to(FASTEST + field, speed)
                if adds:
                    n = bricks_around(grid, blocks, room, e, field, s.base, first)
                    per_mass = 1.0 / unit_of_mass(field)
                    per_momentum = per_mass / number(SPEED + field)
                    trash = room.bricks + BRICK_WORDS * room.capacity
                    add_to_bricks(n, trash, s, spline(s.f[0]), spline(s.f[1]), spline(s.f[2]), per_mass, per_momentum)
        else:
            or_word(FAULTS, _NONFINITE)
    meet()


@wp.func
def scatter_round(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    blocks: Blocks,
    room: Room,
    sums: Sums,
    failure: wp.array(dtype=int),
    e: int,
    part: wp.vec3i,
    first: int,
):
    """Sums of the bricks from the ``first`` on, in units that hold."""
    hold = bool(False)
    while not hold:
        adds = speeds_known(room, part)
        scatter_momenta(grid, step, particles, moving, blocks, room, sums, failure, e, part, first, adds)
        hold = sums_hold(room, part, first)
        if not hold:
            correct_units(room, part)
