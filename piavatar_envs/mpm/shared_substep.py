"""A substep of small environments on a GPU: each has a CUDA block of its own, and its grid in shared memory.

Where there is one velocity field, one launch is the substep: scatter, grid pass and gather. Where there are several, it
is the scatter and the grid pass of blocks with one field; the nodes of others get their sums, on which contact works.

Integers are added, so the result does not depend on the order of the threads: runs repeat bit for bit, and an
environment does the same in any batch. See :mod:`piavatar_envs.mpm.shared_grid` for units and for how nodes lie.
"""

from __future__ import annotations

from functools import cache

import warp as wp

from piavatar_envs.mpm.blocks import freeze, has_field, slots_used
from piavatar_envs.mpm.grid import meet_boundaries, physical_velocity, place_of, total_velocity
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.shared_gather import gather_all
from piavatar_envs.mpm.shared_grid import (
    BLOCK_BRICKS,
    COUNT,
    FASTEST,
    FAULTS,
    MOST_UNITS,
    NO_BRICK,
    PLACES,
    SPEED,
    TOLD,
    UNITS,
    bricks_of_round,
    node_word,
    set_node_record,
)
from piavatar_envs.mpm.shared_memory import (
    half_word,
    meet,
    number,
    or_word,
    set_number,
    thread_of_block,
    threads_of_block,
    word,
)
from piavatar_envs.mpm.shared_room import LARGE_ROOM, LARGE_THREADS, SMALL_ROOM, SMALL_THREADS
from piavatar_envs.mpm.shared_scatter import (
    block_of,
    lay_out,
    record_of_place,
    scatter_places,
    scatter_round,
)
from piavatar_envs.mpm.shared_units import speed_for, unit_of_mass
from piavatar_envs.mpm.stencil import BLOCK_NODES, block_corner
from piavatar_envs.mpm.sums import write_record
from piavatar_envs.mpm.types import (
    NO_STRESS,
    SPLIT,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Model,
    Moving,
    Particles,
    Room,
    Scratch,
    Sensors,
    State,
    Step,
    Sums,
    vec8,
)

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def update_bricks(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    blocks: Blocks,
    room: Room,
    sums: Sums,
    node_velocity: wp.array2d(dtype=vec8),
    sensors: Sensors,
    e: int,
    first: int,
    writes: bool,
):
    """Sums of a round's nodes to velocities, see :func:`piavatar_envs.mpm.grid.update_grid`; where ``writes``, outside.

    In blocks with several fields they stay sums.
    """
    split = step.decoupling == SPLIT or step.decoupling == NO_STRESS
    for n in range(thread_of_block(), 8 * bricks_of_round(room, first), threads_of_block()):
        at = node_word(room, n)
        marked = half_word(room.places, first + n // 8)
        place = marked % PLACES
        r = record_of_place(place, n % 8)
        held = blocks.held[e, place // BLOCK_BRICKS]
        block = block_of(grid, contact, held)
        f = int(0)
        if contact.num_fields > 1:
            f = held // grid.num_blocks
        unit = unit_of_mass(f)
        q = unit * number(SPEED + f)
        s = vec8(
            unit * float(word(at)), q * float(word(at + 1)), q * float(word(at + 2)), q * float(word(at + 3)),
            q * float(word(at + 4)), q * float(word(at + 5)), q * float(word(at + 6)), 0.0,
        )  # fmt: skip
        if contact.num_fields == 1 or blocks.fields[e, block] == (1 << f):
            near = (marked & (PLACES << ((n >> 2) & 1))) != 0
            s = total_velocity(step, split, s)
            if near:
                x = place_of(grid, block_corner(grid, block), r % BLOCK_NODES)
                s = meet_boundaries(grid, boundaries, contact, sums, e, f, r, x, s, sensors)
            s = physical_velocity(split, s)
            if near or contact.num_fields > 1:
                sums.offset[e, r] = wp.vec4()
        if writes:
            write_record(node_velocity, e, r, s)
        else:
            set_node_record(at, s)


@wp.func
def clear_untouched(
    grid: Grid,
    blocks: Blocks,
    room: Room,
    node_velocity: wp.array2d(dtype=vec8),
    sensors: Sensors,
    e: int,
    part: wp.vec3i,
):
    """Records of nodes that no particle touches, in slots that the fields use; nothing has touched anything yet."""
    for r in range(thread_of_block(), BLOCK_NODES * slots_used(blocks, e), threads_of_block()):
        slot = r // BLOCK_NODES
        if has_field(part[2], blocks.held[e, slot] // grid.num_blocks):
            brick = ((r >> 5) & 1) * 4 + ((r >> 3) & 1) * 2 + ((r >> 1) & 1)
            if half_word(room.numbers, BLOCK_BRICKS * slot + brick) == NO_BRICK:
                write_record(node_velocity, e, r, vec8())
            if r % BLOCK_NODES == 0:
                sensors.touched[e, slot] = 0


@wp.func
def run_substep(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    room: Room,
    # in and out; vk is read
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
    sums: Sums,
    node_velocity: wp.array2d(dtype=vec8),
    sensors: Sensors,
    e: int,
    part: wp.vec3i,
    gathers: bool,
):
    """Scatter and grid pass of a part of an environment; it ``gathers``, too, if there is one velocity field."""
    t = thread_of_block()
    lay_out(grid, particles, boundaries, contact, blocks, room, failure, e, part, moved.x)
    count = word(COUNT)
    writes = not gathers or count > room.capacity
    if t == 0:
        blocks.swept[e] = slots_used(blocks, e)
        set_number(UNITS, MOST_UNITS)
        if gathers:  # else the bits of other parts come and go
            or_word(FAULTS, failure[e])
    if t < contact.num_fields and has_field(part[2], t):
        set_number(SPEED + t, room.speed[e, t])
    if not gathers:
        clear_untouched(grid, blocks, room, node_velocity, sensors, e, part)
    meet()
    rounds = (count + room.capacity - 1) // room.capacity
    passes = wp.where(rounds > 1, 2 * rounds, rounds)  # the first ones to find units that hold in all
    for n in range(passes):
        first = (n % rounds) * room.capacity
        settles = n >= passes - rounds
        if settles and word(TOLD) != 0:
            scatter_places(grid, particles, blocks, room, e, part, first, moved.x, sums)
        scatter_round(grid, step, particles, moved, blocks, room, sums, failure, e, part, first)
        if settles:
            update_bricks(grid, step, boundaries, contact, blocks, room, sums, node_velocity, sensors, e, first, writes)
        meet()
    fails = word(FAULTS) != 0
    if t == 0 and gathers:
        blocks.frozen[e] = word(FAULTS)
    if t < contact.num_fields and has_field(part[2], t):
        room.speed[e, t] = speed_for(number(FASTEST + t))
    if gathers:
        gather_all(
            grid, step, particles, boundaries, node_velocity, blocks, room, moved, failure, e, fails, writes
        )  # fmt: skip


@cache
def substep_kernel(large: bool, gathers: bool) -> wp.Kernel:
    """:func:`run_substep` in a room, over ``(num_envs, parts threads)``; made when asked for, for compiling takes time.

    Args:
        large: the room takes a multiprocessor; else there are two in one.
        gathers: the launch is the whole substep.
    """
    words, threads, at_once = (LARGE_ROOM, LARGE_THREADS, 1) if large else (SMALL_ROOM, SMALL_THREADS, 2)
    name = f"{'substep' if gathers else 'nodes'}_in_{'large' if large else 'small'}_room"

    @wp.kernel(
        name=name,
        module="unique",
        launch_bounds=(threads, at_once),
        # an eighth faster: divisions and roots to two units in the last place, and logarithms to 4e-7, in a few
        # instructions instead of calls
        module_options={"enable_backward": False, "default_grid_stride": False, "fast_math": True},
    )
    def substep_in_room(
        grid: Grid,
        step: Step,
        particles: Particles,
        boundaries: Boundaries,
        contact: Contact,
        room: Room,
        # in and out; vk is read
        blocks: Blocks,
        moved: Moving,
        failure: wp.array(dtype=int),
        sums: Sums,
        # out
        node_velocity: wp.array2d(dtype=vec8),
        sensors: Sensors,
    ):
        e, t = wp.tid()
        part = room.part[t // threads]
        reserved = wp.tile_empty(shape=(words,), dtype=int, storage="shared")  # noqa: F841
        run_substep(
            grid, step, particles, boundaries, contact, room, blocks, moved, failure, sums, node_velocity, sensors,
            e, part, gathers,
        )  # fmt: skip

    return substep_in_room


@wp.kernel
def forget_speeds(room: Room):
    """The speeds at which momenta are counted are found anew: what comes then depends on the state alone."""
    e, f = wp.tid()
    room.speed[e, f] = 0.0


def record_in_block(program: Program, model: Model, state: State, scratch: Scratch, moving: Moving) -> None:
    """Append the substep: all of it where there is one field, else up to contact."""
    threads = LARGE_THREADS if scratch.large_room else SMALL_THREADS
    gathers = model.contact.num_fields == 1
    program.launch(
        substep_kernel(scratch.large_room, gathers),
        (model.num_envs, scratch.room.part.shape[0] * threads),
        [model.grid, model.step, model.particles, model.boundaries, model.contact, scratch.room],
        [scratch.blocks, moving, state.failure, scratch.sums, scratch.velocity, scratch.sensors],
        block_dim=threads,
    )
    if not gathers:
        program.launch(freeze, model.num_envs, [state.failure], [scratch.blocks])
