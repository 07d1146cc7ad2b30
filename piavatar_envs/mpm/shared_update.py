"""The grid pass of a body whose nodes are in the shared memory of its CUDA block."""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.blocks import has_field, slots_used
from piavatar_envs.mpm.grid import meet_boundaries, physical_velocity, place_of, total_velocity
from piavatar_envs.mpm.records import write_record
from piavatar_envs.mpm.shared_grid import (
    BLOCK_BRICKS,
    NO_BRICK,
    PLACES,
    SPEED,
    bricks_of_round,
    in_marked_plane,
    kinematic_word,
    node_word,
    set_velocities,
    sums_at,
)
from piavatar_envs.mpm.shared_layout import block_of, place_of_record, record_of_place
from piavatar_envs.mpm.shared_memory import half_word, number, thread_of_block, threads_of_block, word
from piavatar_envs.mpm.shared_units import unit_of_mass
from piavatar_envs.mpm.stencil import BLOCK_NODES, block_corner
from piavatar_envs.mpm.types import (
    NO_STRESS,
    SPLIT,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Room,
    Sensors,
    Step,
    Sums,
    vec8,
)

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def updated_node(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    blocks: Blocks,
    room: Room,
    sums: Sums,
    sensors: Sensors,
    e: int,
    n: int,
    marked: int,
    unit: float,
    speed: float,
):
    """Velocity of node ``n`` of a round, from its sums; the units are those of one field, if it is the only.

    See :func:`piavatar_envs.mpm.grid.update_grid`. In a block with several fields they stay sums.
    """
    split = step.decoupling == SPLIT or step.decoupling == NO_STRESS
    several = contact.num_fields > 1
    near = in_marked_plane(marked, n)
    place = marked % PLACES
    r = record_of_place(place, n % 8)
    block = int(0)
    f = int(0)
    m = float(unit)
    q = unit * speed
    if near or several:  # others need not wait to know
        held = blocks.held[e, place // BLOCK_BRICKS]
        block = block_of(grid, contact, held)
        if several:
            f = held // grid.num_blocks
            m = unit_of_mass(f)
            q = m * number(SPEED + f)
    physical = sums_at(node_word(room, n))
    at = kinematic_word(room, n)
    s = vec8(
        m * float(physical[0]), q * float(physical[1]), q * float(physical[2]), q * float(physical[3]),
        q * float(word(at)), q * float(word(at + 1)), q * float(word(at + 2)), 0.0,
    )  # fmt: skip
    if not several or blocks.fields[e, block] == (1 << f):
        s = total_velocity(step, split, s)
        if near:
            x = place_of(grid, block_corner(grid, block), r % BLOCK_NODES)
            s = meet_boundaries(grid, boundaries, contact, sums, e, f, r, x, s, sensors)
        s = physical_velocity(split, s)
        if near or several:
            sums.offset[e, r] = wp.vec4()
    return s


@wp.func
def update_bricks(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    blocks: Blocks,
    room: Room,
    sums: Sums,
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
    e: int,
    first: int,
    writes: bool,
):
    """Sums of a round's nodes to velocities; where it ``writes``, outside. All threads come here."""
    unit = unit_of_mass(0)
    speed = number(SPEED)
    count = 8 * bricks_of_round(room, first)
    for n in range(thread_of_block(), count, threads_of_block()):
        marked = half_word(room.places, first + n // 8)
        s = updated_node(
            grid, step, boundaries, contact, blocks, room, sums, sensors, e, n, marked, unit, speed
        )  # fmt: skip
        if writes:
            write_record(node_velocity, e, record_of_place(marked % PLACES, n % 8), s)
        else:
            set_velocities(node_word(room, n), kinematic_word(room, n), s)


@wp.func
def clear_untouched(
    grid: Grid,
    blocks: Blocks,
    room: Room,
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
    e: int,
    part: wp.vec3i,
):
    """Records of nodes that no particle touches, in slots that the fields use; nothing has touched anything yet."""
    for r in range(thread_of_block(), BLOCK_NODES * slots_used(blocks, e), threads_of_block()):
        slot = r // BLOCK_NODES
        if has_field(part[2], blocks.held[e, slot] // grid.num_blocks):
            if half_word(room.numbers, place_of_record(r)) == NO_BRICK:
                write_record(node_velocity, e, r, vec8())
            if r % BLOCK_NODES == 0:
                sensors.touched[e, slot] = 0
