"""Which particles the P2G of large bodies takes together, see :mod:`piavatar_envs.mpm.cuda.tiled_p2g`.

What few particles of a group tell their nodes besides momentum: how they are driven, and where they are.

Contact asks for that, see :func:`piavatar_envs.mpm.p2g.is_contact_candidate`. These particles are listed, so that the first
threads of the group's CUDA block have them, and what they tell is added up and put down as momenta are, see
:mod:`piavatar_envs.mpm.cuda.tiled_p2g`.

The scatter of a GPU for large, dense bodies: particles are added up by the group before the nodes are touched.

A group is of neighbours in memory, which should be neighbours in the body: the fewer subblocks of nodes there are in the
box around them, the less there is to put down. It has a CUDA block of its own, see
:mod:`piavatar_envs.mpm.cuda.tile_grid` and :mod:`piavatar_envs.mpm.cuda.tile_grid`. What it adds up depends on its own
particles only, and integers are added: runs repeat bit for bit, and an environment does the same in any batch. What few
particles have besides is in :mod:`piavatar_envs.mpm.cuda.tiled_p2g`.
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

# divisions and roots to two units in the last place, and logarithms to 4e-7, in a few instructions instead of calls: a
# warp with a few particles waits for its instructions as much as for its numbers
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})


#: Up to how many particles of an environment a group has so many: smaller worlds fill a GPU with small groups only. The
#: numbers must not depend on the batch: units do on the group.
TILE_SIZES = ((16384, 32), (65536, 64), (2**31, THREADS))
#: Ways in which a body may be turned, of which a group's box should be small enough in each.
_ROTATIONS = Rotation.random(8, random_state=0).as_matrix()


def tile_size(per_env: int) -> int:
    """Particles of a group, at most, where an environment has ``per_env``."""
    return next(share for most, share in TILE_SIZES if per_env <= most)


def plan_tiles(field: np.ndarray, rest: np.ndarray | None, dx: float) -> np.ndarray:
    """First particles and velocity fields of groups, ``(G + 1, 2)`` int32; the last row says where the others end.

    A group is of one field, and is halved where the box around it would be too large: then it would go in turns, and a
    substep would wait for it.

    Args:
        field: velocity fields of the particles of an environment, shape ``(P,)``.
        rest: where they are at rest [m], shape ``(P, 3)``; if not given, nothing is halved.
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
    """Of which groups, of more than one particle, the box has too many subblocks in one of ``_ROTATIONS``, shape ``(G,)``."""
    most = np.zeros(len(begins) - 1)
    for tile_pass in _ROTATIONS:
        places = rest @ tile_pass.T / dx
        edges = np.maximum.reduceat(places, begins[:-1]) - np.minimum.reduceat(places, begins[:-1])
        most = np.maximum(most, np.prod((edges + 3.0) / 2.0 + 1.0, axis=1))  # a stencil is three nodes long
    return (most > int(CAPACITY)) & (np.diff(begins) > 1)


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
    """List the thread, if its particle ``candidate`` its nodes more than momentum, in any order; all threads come here."""
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
    """Words from a node's to as many more for it, beyond those of the box; 0 where there is no room for these."""
    ...


@wp.func
def add_candidate(t: int, driven: Deposit, place: Deposit, drives: bool, to_place: int):
    """:func:`add_candidate_to_box` of how a particle is ``driven`` and of its ``place``."""
    per_mass = inverse_quantum(HEAVIEST)
    per_way = 0.5 * per_mass  # up to 1.5 masses
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
    """Scatter what particles that tell their nodes have besides momentum; all threads come here, few groups do.

    The first threads have those particles. How they are driven and where they are is added up at once, if there is room
    for both.
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
        if n == 0:  # what is added of places is no momentum, and as sound as the masses were
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
    """The particle of a thread, of a group's ``first``; the mask tells the compiler that it is not negative."""
    ...


@wp.func
def begin_tile(particles: Particles, accumulators: Accumulators):
    """The group of a CUDA block: environment, particle of the thread, field, particle after the last.

    Nothing has been added yet; units are not smaller than those of the sums. All threads meet later.
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
    """Whether particles are left for another turn, which begins then; all threads come here."""
    goes_on = word(REMAINING) != 0
    if goes_on:
        sync_block()
        begin_pass()
        clear_nodes()
    return goes_on


@wp.func
def add_momentum(box: wp.vec3i, s: Deposit):
    """Add mass and momentum of a particle to the group's nodes."""
    add_to_box(
        box, thread_of_block(), s, spline(s.f[0]), spline(s.f[1]), spline(s.f[2]), inverse_quantum(HEAVIEST),
        inverse_quantum(FASTEST),
    )  # fmt: skip


@wp.struct
class TilePass:
    """A particle while its group scatters."""

    takes: bool  # whether it takes part
    ours: bool  # whether it has its turn
    base: wp.vec3i  # lowest node of its stencil
    box: wp.vec3i  # where the subblocks around that are, see :func:`subblocks_around`


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
    """Add up those of the particles that are ``remaining`` whose turn it is; ``s`` is what one scatters that is left.

    All threads come here, and to :func:`flush_pass` then.
    """
    e = at[0]
    sync_block()  # not before memory has been asked for what particles have; a turn has begun then
    takes = raise_quanta(s, remaining, MOMENTUM, failure, e)
    widen_box(takes, s.base)
    sync_block()
    ours = in_pass(grid, takes, s.base)
    box = subblocks_around(s.base)
    fetch_active(grid, blocks, num_fields, e, at[2])
    if ours:
        add_momentum(box, s)
    store_records(blocks, e)  # nobody needs them before
    return TilePass(takes, ours, s.base, box)


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
    """Put down what has been added up; returns whether this particle is left then.

    A boundary may be ``near`` it. All threads have met since they added.
    """
    candidate = near or step.decoupling == PAPER  # which needs the gradient of kinematic momentum everywhere
    # others are asked for only of who has a box
    list_candidate(
        tile_pass.ours and (candidate or (num_fields > 1 and has_contact_nodes(tile_pass.box, tile_pass.base)))
    )
    flush_nodes(grid, accumulators, failure, at[0], MOMENTUM, 0)
    sync_block()
    if word(NUM_CANDIDATES) != 0:
        deposit_candidates(grid, particles, moving, failure, accumulators, at)
    return tile_pass.takes and not tile_pass.ours


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
    """Scatter those of the particles that are ``remaining`` whose turn it is; returns whether this one is left then.

    Written into a kernel's loop, ``s`` would be kept from turn to turn, and four times as many registers be spilled.
    """
    e = at[0]
    s = Deposit()
    if remaining:
        s = deposit_of(grid, step, particles, moving, e, at[1], False)
    tile_pass = add_pass(grid, blocks, failure, num_fields, at, remaining, s)
    sync_block()
    # not before: the less a thread keeps while it waits for what particles have, the earlier it asks for it
    near = near_boundary(grid, boundaries, e, moving.x[e, wp.min(at[1], moving.x.shape[1] - 1)])
    return flush_pass(grid, step, particles, moving, failure, accumulators, num_fields, at, tile_pass, near)


# that leaves a thread 80 registers, all but a few of those that it asks for
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
    """The same sums as :func:`piavatar_envs.mpm.p2g.p2g`.

    A CUDA block takes one group of an environment, a thread a particle; all of its threads come to what they do
    together.
    """
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
    """Append the P2G of all groups of all environments; no CUDA block has two."""
    share = tile_size(model.num_particles)
    threads = model.num_envs * (model.particles.tiles.shape[0] - 1) * share
    graph.launch(tiled_p2g, threads, inputs, outputs, block_dim=share)


@wp.func
def candidate_deposit(grid: Grid, particles: Particles, e: int, p: int, x: wp.vec3, vk: wp.vec3, kind: int):
    """How particle ``p`` at ``x`` is driven, or its place ``w m (x_i - x_p) / dx`` and a seam's ``w m``."""
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
    """:func:`add_to_subblocks`, in subblocks that lie in a row.

    ``box`` has the word at which the first subblock begins, and how far on the next ones along x and along y do.
    """
    ...


@wp.func_native(
    subblock_native("""
const int px = base[0] & 1, py = base[1] & 1, pz = base[2] & 1;
const float k[3] = {driven[0], driven[1], driven[2]};
#pragma unroll 1
for (int m = 0; m < 9; ++m) {
    int n = m + t % 9;  // who has the same nodes adds to contact_nodes of them meanwhile
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
    """Add a vector, how a particle is ``driven``, to its nodes in a ``box``, if it ``drives`` them, and where it is.

    The latter goes to words ``to_place`` further on, nowhere if that is negative: a scalar and a vector, ``place`` at
    the lowest node. The vector's components change by ``change`` from node to node, each along its own axis. All is in
    units; ``box`` is as for :func:`add_to_box`. Thread ``t`` begins with another line of nodes than those beside it.
    Few particles come here, so it is short.
    """
    ...
