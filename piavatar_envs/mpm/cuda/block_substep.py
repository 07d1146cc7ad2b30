"""A substep of small environments on a GPU: each has a CUDA block of its own, and its grid in shared memory.

Where there is one velocity field, one launch is the substep: scatter, grid pass and gather. Where there are several, it
is the scatter and the grid pass of blocks with one field; the nodes of others get their sums, on which contact works.

Integers are added, so the result does not depend on the order of the threads: runs repeat bit for bit, and an
environment does the same in any batch. See :mod:`piavatar_envs.mpm.cuda.block_grid` for units and for how nodes lie.
"""

from __future__ import annotations

from functools import cache

import warp as wp

from piavatar_envs.core.cuda_intrinsics import meet, thread_of_block
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.shared_memory import number, or_word, set_number, word
from piavatar_envs.mpm.cuda.block_g2p import clear_untouched, gather_all, update_bricks
from piavatar_envs.mpm.cuda.block_grid import (
    COUNT,
    FASTEST,
    FAULTS,
    LARGE_ROOM,
    LARGE_THREADS,
    MOST_UNITS,
    SMALL_ROOM,
    SMALL_THREADS,
    SPEED,
    TOLD,
    UNITS,
    lay_out,
    speed_for,
)
from piavatar_envs.mpm.cuda.block_p2g import scatter_places, scatter_round
from piavatar_envs.mpm.sparse_grid import freeze, has_field, slots_used
from piavatar_envs.mpm.types import (
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
)

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


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
    node_velocity: wp.array2d(dtype=wp.vec4),
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
        tells = settles and word(TOLD) != 0
        if tells:
            scatter_places(grid, particles, blocks, room, e, part, first, moved.x, sums)
        scatter_round(grid, step, particles, moved, blocks, room, sums, failure, e, part, first, tells)
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
        node_velocity: wp.array2d(dtype=wp.vec4),
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


def record_in_block(graph: LaunchGraph, model: Model, state: State, scratch: Scratch, moving: Moving) -> None:
    """Append the substep: all of it where there is one field, else up to contact."""
    threads = LARGE_THREADS if scratch.large_room else SMALL_THREADS
    gathers = model.contact.num_fields == 1
    graph.launch(
        substep_kernel(scratch.large_room, gathers),
        (model.num_envs, scratch.room.part.shape[0] * threads),
        [model.grid, model.step, model.particles, model.boundaries, model.contact, scratch.room],
        [scratch.blocks, moving, state.failure, scratch.sums, scratch.velocity, scratch.sensors],
        block_dim=threads,
    )
    if not gathers:
        graph.launch(freeze, model.num_envs, [state.failure], [scratch.blocks])
