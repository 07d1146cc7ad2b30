"""Tiled P2G for large bodies on a GPU: tiles of particles are summed in shared memory before they reach the grid.

A tile consists of particles that are neighbours in memory, and should be neighbours in the body: the fewer subblocks
its box has, the less there is to flush. Each tile has its own CUDA block; shared memory and sums are in
:mod:`piavatar_envs.mpm.cuda.tile_grid`. The sums of a tile depend on its own particles only, and are integers: runs
repeat bit for bit, and an environment gives the same result in any batch.

The contact candidates of a tile also add kinematic momentum and offsets. They are few; they are listed, so that the
first threads of the CUDA block process them, and flushed in the same way.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.core.arrays import vec8
from piavatar_envs.core.cuda_intrinsics import block_of_launch, environment_of, sync_block, thread_of_block
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.shared_memory import APPEND, native, set_float_word, word
from piavatar_envs.mpm.bspline import spline
from piavatar_envs.mpm.cuda.block_grid import subblock_native
from piavatar_envs.mpm.cuda.block_p2g import adding
from piavatar_envs.mpm.cuda.tile_grid import (
    CANDIDATES,
    CAPACITY,
    FASTEST,
    FASTEST_KINEMATIC,
    HEAVIEST,
    KINEMATIC,
    MASS_QUANTUM,
    MAX_PARTICLE_QUANTA,
    MOMENTUM,
    MOMENTUM_QUANTUM,
    NUM_CANDIDATES,
    PLACE,
    REMAINING,
    SIZE,
    THREADS,
    WORDS,
    begin_pass,
    clear_nodes,
    fetch_active,
    flush_nodes,
    has_contact_nodes,
    in_pass,
    inverse_quantum,
    raise_quanta,
    store_records,
    subblocks_around,
    tile_native,
    widen_box,
)
from piavatar_envs.mpm.p2g import Deposit, deposit_of, deposits, empty_deposit, near_boundary
from piavatar_envs.mpm.types import (
    PAPER,
    Accumulators,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Model,
    Moving,
    Particles,
    Step,
    row,
)

# fast_math: divisions and roots to two units in the last place, logarithms to 4e-7, without function calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

#: Particles of a tile by particles of an environment: smaller worlds fill a GPU with small tiles only. They must not
#: depend on the batch, because the tile's quanta depend on its particles.
TILE_SIZES = ((16384, 32), (65536, 64), (2**31, THREADS))
#: Orientations of a body in each of which a tile's box should be small enough.
_ROTATIONS = Rotation.random(8, random_state=0).as_matrix()


@wp.struct
class TilePass:
    """A particle in a pass of its tile."""

    takes: bool  # whether it takes part
    included: bool  # whether it is in this pass
    base: wp.vec3i  # lowest node of its stencil
    box: wp.vec3i  # where the subblocks around that are, see :func:`subblocks_around`


def tile_size(per_env: int) -> int:
    """Return the most particles of a tile in an environment of ``per_env`` particles."""
    return next(share for most, share in TILE_SIZES if per_env <= most)


def plan_tiles(field: np.ndarray, rest: np.ndarray | None, dx: float) -> np.ndarray:
    """Return first particle and velocity field of every tile, ``(T + 1, 2)`` int32; the last row is the end.

    A tile has one field, and is halved while the box around it is too large: it would need passes, and a substep would
    wait for it.

    Args:
        field: velocity fields of the particles of an environment, shape ``(P,)``.
        rest: positions at rest [m], shape ``(P, 3)``; if not given, no tile is halved.
        dx: grid spacing [m].
    """
    share, changes = tile_size(len(field)), np.flatnonzero(np.diff(field)) + 1
    bounds = np.concatenate([[0], changes, [len(field)]])
    begins = np.concatenate([*(np.arange(*ends, share) for ends in pairwise(bounds)), [len(field)]])
    while rest is not None and (too_large := _too_large(rest, begins, dx)).any():
        middle = (begins[:-1] + begins[1:] + 1) // 2
        begins = np.sort(np.concatenate([begins, middle[too_large]]))
    return np.column_stack([begins, np.append(field[begins[:-1]], 0)]).astype(np.int32)


def _too_large(rest: np.ndarray, begins: np.ndarray, dx: float) -> np.ndarray:
    """Return which tiles of several particles have too many subblocks in one of ``_ROTATIONS``, shape ``(T,)``."""
    most = np.zeros(len(begins) - 1)
    for tile_pass in _ROTATIONS:
        places = rest @ tile_pass.T / dx
        edges = np.maximum.reduceat(places, begins[:-1]) - np.minimum.reduceat(places, begins[:-1])
        most = np.maximum(most, np.prod((edges + 3.0) / 2.0 + 1.0, axis=1))  # a stencil spans three nodes
    return (most > int(CAPACITY)) & (np.diff(begins) > 1)


@wp.func_native(
    adding(
        scale=4,
        before="for (int n = 0; n < 3; ++n) place_z[n] += upper_z[n] ? UNIT * SUBBLOCK : 0;",
        plane="const int first = UNIT * (box[0] + (far ? box[1] : 0));",
        line="const int first_of_line = first + line + UNIT * (upper ? box[2] : 0);",
        node="first_of_line + place_z[l]",
        unrolled=3,
    )
)
def add_to_box(
    box: wp.vec3i,
    p: int,
    s: Deposit,
    wx: wp.vec3,
    wy: wp.vec3,
    wz: wp.vec3,
    per_mass: float,
    per_momentum: float,
):
    """Add mass and physical momentum of a particle to its nodes, in subblocks that lie in a row.

    ``box`` is from :func:`piavatar_envs.mpm.cuda.tile_grid.subblocks_around`.
    """
    ...


@wp.func_native(
    subblock_native("""
const int px = base[0] & 1, py = base[1] & 1, pz = base[2] & 1;
const float k[3] = {driven[0], driven[1], driven[2]};
#pragma unroll 1
for (int m = 0; m < 9; ++m) {
    int n = m + t % 9;  // neighbouring threads start at different nodes
    n -= n > 8 ? 9 : 0;
    const int i = n * 11 >> 5, j = n - 3 * i;
    int* const line = arena + box[0] + (px + i > 1 ? box[1] : 0) + (py + j > 1 ? box[2] : 0)
        + ((px + i) & 1) * ALONG_X + ((py + j) & 1) * ALONG_Y;
    const float w = (i == 0 ? wx[0] : i == 1 ? wx[1] : wx[2]) * (j == 0 ? wy[0] : j == 1 ? wy[1] : wy[2]);
    const float way_x = place[1] + (float)i * change, way_y = place[2] + (float)j * change;
#pragma unroll
    for (int l = 0; l < 3; ++l) {
        int* const node = line + (pz + l > 1 ? SUBBLOCK : 0) + ((pz + l) & 1) * ALONG_Z;
        const float wl = w * wz[l];
        if (drives)
            for (int c = 0; c < 3; ++c) atomicAdd(node + 1 + c, __float2int_rn(wl * k[c]));
        if (to_place < 0) continue;
        if (place[0] != 0.0f) atomicAdd(node + to_place, __float2int_rn(wl * place[0]));
        atomicAdd(node + to_place + 1, __float2int_rn(wl * way_x));
        atomicAdd(node + to_place + 2, __float2int_rn(wl * way_y));
        atomicAdd(node + to_place + 3, __float2int_rn(wl * (place[3] + (float)l * change)));
    }
}
""")
)
def add_candidate_to_box(
    box: wp.vec3i,
    t: int,
    base: wp.vec3i,
    wx: wp.vec3,
    wy: wp.vec3,
    wz: wp.vec3,
    driven: wp.vec3,
    place: wp.vec4,
    change: float,
    drives: bool,
    to_place: int,
):
    """Add kinematic momentum, if it ``drives``, and offsets of a contact candidate to its nodes.

    Offsets go to words ``to_place`` further on, or nowhere if that is negative: a scalar and a vector, ``place`` at the
    lowest node, whose components change by ``change`` from node to node along their own axes. All is in quanta. Threads
    ``t`` start at different lines of nodes, to avoid conflicts. Compact code, because few particles are candidates.
    """
    ...


@wp.func
def candidate_deposit(grid: Grid, particles: Particles, e: int, p: int, x: wp.vec3, vk: wp.vec3, kind: int):
    """Return the kinematic momentum of particle ``p`` at ``x``, or its offset and seam mass, by ``kind``."""
    s = empty_deposit(grid, x)
    m = particles.mass[row(e, particles.mass.shape[0]), p]
    if kind == KINEMATIC:
        k = m * vk
        s.at_base = vec8(0.0, k[0], k[1], k[2], 0.0, 0.0, 0.0, 0.0)
    else:
        s.at_base = vec8(particles.seam[p] * m, -m * s.f[0], -m * s.f[1], -m * s.f[2], 0.0, 0.0, 0.0, 0.0)
        s.A = wp.diag(wp.vec3(m))
    return s


@wp.func_native(
    tile_native(
        APPEND
        + """
const int place = append(arena + NUM_CANDIDATES, __ballot_sync(ALL, candidate), threadIdx.x & 31);
if (candidate) arena[CANDIDATES + place] = threadIdx.x;
"""
    )
)
def list_candidate(candidate: bool):
    """List the thread if its particle is a contact candidate, in any order; all threads must call this."""
    ...


@wp.func_native(
    tile_native(
        SIZE
        + """
const int subblocks = size[0] * size[1] * size[2];
return 2 * subblocks <= CAPACITY ? SUBBLOCK_WORDS * subblocks : 0;
""",
        "return 0;",
    )
)
def spare_words() -> int:
    """Return the distance to a second set of sums for each node, beyond those of the box; 0 if it does not fit."""
    ...


@wp.func
def add_candidate(t: int, driven: Deposit, place: Deposit, drives: bool, to_place: int):
    """Add kinematic momentum and offset of a contact candidate in quanta of the tile."""
    per_mass = inverse_quantum(HEAVIEST)
    per_way = 0.5 * per_mass  # offsets reach 1.5 grid spacings
    k = inverse_quantum(FASTEST_KINEMATIC) * wp.vec3(driven.at_base[1], driven.at_base[2], driven.at_base[3])
    at_base = wp.vec4(
        per_mass * place.at_base[0], per_way * place.at_base[1], per_way * place.at_base[2], per_way * place.at_base[3]
    )
    add_candidate_to_box(
        subblocks_around(place.base), t, place.base, spline(place.f[0]), spline(place.f[1]), spline(place.f[2]), k,
        at_base, per_way * place.A[0, 0], drives, to_place,
    )  # fmt: skip


@wp.func
def deposit_candidates(
    grid: Grid,
    particles: Particles,
    moving: Moving,
    failure: wp.array(dtype=int),
    accumulators: Accumulators,
    at: wp.vec4i,
):
    """Add and flush kinematic momentum and offsets of the contact candidates; all threads must call this.

    The first threads process them. Both kinds are added at once if both fit.
    """
    e = at[0]
    t = thread_of_block()
    candidate = t < word(NUM_CANDIDATES)
    p = at[1] - t + word(CANDIDATES + wp.where(candidate, t, 0))
    driven = candidate_deposit(grid, particles, e, p, moving.x[e, p], moving.vk[e, p], KINEMATIC)
    place = candidate_deposit(grid, particles, e, p, moving.x[e, p], moving.vk[e, p], PLACE)
    beyond = spare_words()
    kinds = int(2)
    rounds = wp.where(beyond > 0, 1, kinds)
    for n in range(rounds):
        clear_nodes()
        if n == 0:  # offsets need no check of their own: their masses have passed
            candidate = raise_quanta(driven, candidate, KINEMATIC, failure, e)
        sync_block()
        if candidate:
            add_candidate(t, driven, place, n == 0, wp.where(n == rounds - 1, beyond, -1))
        sync_block()
        for k in range(kinds):
            if rounds == 1 or k == n:
                flush_nodes(grid, accumulators, failure, e, KINEMATIC + k, k * beyond)
        sync_block()


@wp.func_native(native("return (first + (int)threadIdx.x) & 0x7fffffff;", "return first;"))
def particle_of_thread(first: int) -> int:
    """Return the particle of a thread; the mask lets the compiler assume that it is not negative."""
    ...


@wp.func
def begin_tile(particles: Particles, accumulators: Accumulators):
    """Return environment, particle of the thread, field, and end of the tile of this CUDA block; resets its memory.

    Quanta are not smaller than those of the accumulators. A barrier must follow.
    """
    at_group = environment_of(block_of_launch(), particles.tiles.shape[0] - 1)
    e = at_group[0]
    begins = particles.tiles[at_group[1]]
    field = begins[1]
    if thread_of_block() == 0:
        mass = accumulators.mass_quantum[row(e, accumulators.mass_quantum.shape[0]), field]
        momentum = accumulators.momentum_quantum[row(e, accumulators.momentum_quantum.shape[0]), field]
        set_float_word(MASS_QUANTUM, mass)
        set_float_word(MOMENTUM_QUANTUM, momentum)
        set_float_word(HEAVIEST, MAX_PARTICLE_QUANTA * mass)
        set_float_word(FASTEST, MAX_PARTICLE_QUANTA * momentum)
        set_float_word(FASTEST_KINEMATIC, MAX_PARTICLE_QUANTA * momentum)
    begin_pass()
    clear_nodes()
    return wp.vec4i(e, particle_of_thread(begins[0]), field, particles.tiles[at_group[1] + 1][0])


@wp.func
def next_pass():
    """Return whether particles remain for another pass, and begin it; all threads must call this."""
    goes_on = word(REMAINING) != 0
    if goes_on:
        sync_block()
        begin_pass()
        clear_nodes()
    return goes_on


@wp.func
def add_momentum(box: wp.vec3i, s: Deposit):
    """Add mass and momentum of a particle to the tile's nodes."""
    add_to_box(
        box, thread_of_block(), s, spline(s.f[0]), spline(s.f[1]), spline(s.f[2]), inverse_quantum(HEAVIEST),
        inverse_quantum(FASTEST),
    )  # fmt: skip


@wp.func
def add_pass(
    grid: Grid,
    blocks: Blocks,
    failure: wp.array(dtype=int),
    num_fields: int,
    at: wp.vec4i,
    remaining: bool,
    s: Deposit,
):
    """Add the ``remaining`` particles of this pass; ``s`` is the deposit of one that remains.

    All threads must call this, and :func:`flush_pass` then.
    """
    e = at[0]
    sync_block()  # after the loads of the particles were issued; the pass has begun then
    takes = raise_quanta(s, remaining, MOMENTUM, failure, e)
    widen_box(takes, s.base)
    sync_block()
    included = in_pass(grid, takes, s.base)
    box = subblocks_around(s.base)
    fetch_active(grid, blocks, num_fields, e, at[2])
    if included:
        add_momentum(box, s)
    store_records(blocks, e)
    return TilePass(takes, included, s.base, box)


@wp.func
def flush_pass(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    failure: wp.array(dtype=int),
    accumulators: Accumulators,
    num_fields: int,
    at: wp.vec4i,
    tile_pass: TilePass,
    near: bool,
):
    """Flush the sums of a pass, then those of its contact candidates; returns whether this particle remains.

    A collider may be ``near`` it. A barrier must precede.
    """
    candidate = near or step.decoupling == PAPER  # "paper" needs the gradient of kinematic momentum everywhere
    # only particles of this pass have a box
    list_candidate(
        tile_pass.included and (candidate or (num_fields > 1 and has_contact_nodes(tile_pass.box, tile_pass.base)))
    )
    flush_nodes(grid, accumulators, failure, at[0], MOMENTUM, 0)
    sync_block()
    if word(NUM_CANDIDATES) != 0:
        deposit_candidates(grid, particles, moving, failure, accumulators, at)
    return tile_pass.takes and not tile_pass.included


@wp.func
def add_remaining(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    boundaries: Boundaries,
    blocks: Blocks,
    failure: wp.array(dtype=int),
    accumulators: Accumulators,
    num_fields: int,
    at: wp.vec4i,
    remaining: bool,
):
    """Run one pass over the ``remaining`` particles; returns whether this one remains then.

    A function of its own, because ``s`` would otherwise live across passes and spill registers.
    """
    e = at[0]
    s = Deposit()
    if remaining:
        s = deposit_of(grid, step, particles, moving, e, at[1], False)
    tile_pass = add_pass(grid, blocks, failure, num_fields, at, remaining, s)
    sync_block()
    # only now, because registers live across the loads of the particles are scarce
    near = near_boundary(grid, boundaries, e, moving.x[e, wp.min(at[1], moving.x.shape[1] - 1)])
    return flush_pass(grid, step, particles, moving, failure, accumulators, num_fields, at, tile_pass, near)


# the launch bounds leave a thread 80 registers, nearly all that it uses
@wp.kernel(launch_bounds=(THREADS, 6))
def tiled_p2g(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    moving: Moving,
    blocks: Blocks,
    # in and out
    failure: wp.array(dtype=int),
    accumulators: Accumulators,
):
    """Add the same sums as :func:`piavatar_envs.mpm.p2g.p2g`, a CUDA block a tile, a thread a particle."""
    reserved = wp.tile_empty(shape=(WORDS,), dtype=int, storage="shared")  # noqa: F841
    at = begin_tile(particles, accumulators)
    remaining = bool(False)
    if at[1] < at[3]:
        remaining = deposits(blocks, moving, at[0], at[1], failure)
    goes_on = bool(True)
    while goes_on:
        remaining = add_remaining(
            grid, step, particles, moving, boundaries, blocks, failure, accumulators, contact.num_fields, at, remaining
        )  # fmt: skip
        goes_on = next_pass()


def record_tiled_p2g(graph: LaunchGraph, model: Model, inputs: list[Any], outputs: list[Any]) -> None:
    """Append P2G of all tiles of all environments, a CUDA block each."""
    share = tile_size(model.num_particles)
    threads = model.num_envs * (model.particles.tiles.shape[0] - 1) * share
    graph.launch(tiled_p2g, threads, inputs, outputs, block_dim=share)
