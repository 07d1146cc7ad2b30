"""Block-per-environment path: a substep of small bodies with their grids in shared memory.

With a single velocity field one launch is the substep: P2G, grid update and G2P. With several it covers P2G and the
grid update of blocks with one field; nodes of contact blocks get their sums, from which contact continues.

Sums are integers, so the result does not depend on the order of the threads: runs repeat bit for bit, and an
environment gives the same result in any batch. Quanta and layout are in :mod:`piavatar_envs.mpm.cuda.block_grid`.
"""

from __future__ import annotations

from functools import cache

import warp as wp

from piavatar_envs.core.cuda_intrinsics import sync_block, thread_of_block
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.shared_memory import float_word, or_word, set_float_word, word
from piavatar_envs.mpm.cuda.block_g2p import clear_untouched, g2p_all, update_subblocks
from piavatar_envs.mpm.cuda.block_grid import (
    COUNT,
    FASTEST,
    FAULTS,
    LARGE_ARENA,
    LARGE_THREADS,
    MAX_MASS_QUANTA,
    NUM_CANDIDATES,
    QUANTA,
    SMALL_ARENA,
    SMALL_THREADS,
    SPEED,
    lay_out_arena,
    speed_for,
)
from piavatar_envs.mpm.cuda.block_p2g import add_offsets, p2g_round
from piavatar_envs.mpm.sparse_grid import freeze, has_field, num_active
from piavatar_envs.mpm.types import (
    Accumulators,
    Arena,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Model,
    Moving,
    Particles,
    Scratch,
    Sensors,
    State,
    Step,
)

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def run_substep(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    arena: Arena,
    # in and out; vk is read
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
    accumulators: Accumulators,
    node_velocity: wp.array2d(dtype=wp.vec4),
    sensors: Sensors,
    e: int,
    partition: wp.vec3i,
    with_g2p: bool,
):
    """Run P2G and the grid update of a partition of an environment, and G2P if ``with_g2p``, for a single field."""
    t = thread_of_block()
    lay_out_arena(grid, particles, boundaries, contact, blocks, arena, failure, e, partition, moved.x)
    count = word(COUNT)
    writes = not with_g2p or count > arena.capacity
    if t == 0:
        blocks.num_updated[e] = num_active(blocks, e)
        set_float_word(QUANTA, MAX_MASS_QUANTA)
        if with_g2p:  # else other partitions may set bits meanwhile
            or_word(FAULTS, failure[e])
    if t < contact.num_fields and has_field(partition[2], t):
        set_float_word(SPEED + t, arena.speed[e, t])
    if not with_g2p:
        clear_untouched(grid, blocks, arena, node_velocity, sensors, e, partition)
    sync_block()
    rounds = (count + arena.capacity - 1) // arena.capacity
    passes = wp.where(rounds > 1, 2 * rounds, rounds)  # the first ones find quanta that suffice in all rounds
    for n in range(passes):
        first = (n % rounds) * arena.capacity
        settles = n >= passes - rounds
        candidate = settles and word(NUM_CANDIDATES) != 0
        if candidate:
            add_offsets(grid, particles, blocks, arena, e, partition, first, moved.x, accumulators)
        p2g_round(grid, step, particles, moved, blocks, arena, accumulators, failure, e, partition, first, candidate)
        if settles:
            update_subblocks(
                grid, step, boundaries, contact, blocks, arena, accumulators, node_velocity, sensors, e, first, writes
            )
        sync_block()
    fails = word(FAULTS) != 0
    if t == 0 and with_g2p:
        blocks.frozen[e] = word(FAULTS)
    if t < contact.num_fields and has_field(partition[2], t):
        arena.speed[e, t] = speed_for(float_word(FASTEST + t))
    if with_g2p:
        g2p_all(
            grid, step, particles, boundaries, node_velocity, blocks, arena, moved, failure, sensors, e, fails, writes
        )  # fmt: skip


@cache
def substep_kernel(large: bool, with_g2p: bool) -> wp.Kernel:
    """Return :func:`run_substep` as a kernel over ``(num_envs, partitions * threads)``, created on first use.

    Args:
        large: whether the arena fills a multiprocessor; else two share one.
        with_g2p: whether the launch is the whole substep.
    """
    words, threads, at_once = (LARGE_ARENA, LARGE_THREADS, 1) if large else (SMALL_ARENA, SMALL_THREADS, 2)
    name = f"{'substep' if with_g2p else 'nodes'}_in_{'large' if large else 'small'}_arena"

    @wp.kernel(
        name=name,
        module="unique",
        launch_bounds=(threads, at_once),
        # fast_math: divisions and roots to two units in the last place, logarithms to 4e-7, without function calls
        module_options={"enable_backward": False, "default_grid_stride": False, "fast_math": True},
    )
    def substep_in_arena(
        grid: Grid,
        step: Step,
        particles: Particles,
        boundaries: Boundaries,
        contact: Contact,
        arena: Arena,
        # in and out; vk is read
        blocks: Blocks,
        moved: Moving,
        failure: wp.array(dtype=int),
        accumulators: Accumulators,
        # out
        node_velocity: wp.array2d(dtype=wp.vec4),
        sensors: Sensors,
    ):
        e, t = wp.tid()
        partition = arena.partition[t // threads]
        reserved = wp.tile_empty(shape=(words,), dtype=int, storage="shared")  # noqa: F841
        run_substep(
            grid, step, particles, boundaries, contact, arena, blocks, moved, failure, accumulators, node_velocity,
            sensors,
            e, partition, with_g2p,
        )  # fmt: skip

    return substep_in_arena


@wp.kernel
def reset_speeds(arena: Arena):
    """Reset the speeds that scale momentum quanta, so that results depend on the state alone."""
    e, f = wp.tid()
    arena.speed[e, f] = 0.0


def record_in_block(
    graph: LaunchGraph, model: Model, state: State, scratch: Scratch, moving: Moving, with_g2p: bool
) -> None:
    """Append the substep: all of it if ``with_g2p``, which takes a single field, else up to contact."""
    threads = LARGE_THREADS if scratch.large_arena else SMALL_THREADS
    graph.launch(
        substep_kernel(scratch.large_arena, with_g2p),
        (model.num_envs, scratch.arena.partition.shape[0] * threads),
        [model.grid, model.step, model.particles, model.boundaries, model.contact, scratch.arena],
        [scratch.blocks, moving, state.failure, scratch.accumulators, scratch.velocity, scratch.sensors],
        block_dim=threads,
    )
    if not with_g2p:
        graph.launch(freeze, model.num_envs, [state.failure], [scratch.blocks])
