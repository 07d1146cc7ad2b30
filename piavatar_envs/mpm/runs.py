"""The transfers of a GPU. The scatter takes 32 particles at a time and adds them up before the nodes are touched.

What a warp does with them is in :mod:`piavatar_envs.mpm.warp_scatter`. Particles are sorted by cell once a control
step, so that those of the same cell come together; those that have changed cells since are still found, because equal
cells are matched anywhere in the warp.

In which order a warp adds up depends on the particles' positions and on where they lie in the batch. With the nodes'
sums in fixed point (:mod:`piavatar_envs.mpm.sums`) the result does not depend on the schedule of the warps: the same
batch repeats bit for bit.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.stencil import base_node, block_index, grid_position, node_in_block, spline, stencil_inside
from piavatar_envs.mpm.stores import store_matrix, store_vector
from piavatar_envs.mpm.transfer import Gathered, Scattered, gather, prepare, scatters, tells_place
from piavatar_envs.mpm.types import (
    FAILURE_CFL,
    FAILURE_NONFINITE,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Model,
    Moving,
    Particles,
    Scratch,
    State,
    Step,
    Sums,
    row,
    vec8,
)
from piavatar_envs.mpm.warp_scatter import scatter_runs

wp.set_module_options({"enable_backward": False})

_NONFINITE = wp.constant(FAILURE_NONFINITE)
_CFL = wp.constant(FAILURE_CFL)
#: Units of momentum that a particle may have: those of 4,000 full cells that move a grid spacing in a time step.
MOST_UNITS = wp.constant(float(2**48))
#: Threads of a CUDA block: four warps, whose stages and bricks fit the shared memory of a block.
THREADS = 128
#: Particles of a block among the 32 of a round that are worth a change of the brick; fewer go to the nodes directly.
WORTH_A_BRICK = wp.constant(6)
#: Particles for which the warps of a large GPU have one round of 32.
PARTICLES_A_ROUND = 132 * 16 * 32


@wp.func
def cell_key(grid: Grid, e: int, field: int, num_fields: int, base: wp.vec3i):
    """Number of a field's cell in an environment; the 64 cells of a block are next to each other."""
    block = block_index(grid, base[0], base[1], base[2])
    of_block = (wp.int64(e) * wp.int64(num_fields) + wp.int64(field)) * wp.int64(grid.num_blocks) + wp.int64(block)
    return of_block * wp.int64(64) + wp.int64(node_in_block(base[0], base[1], base[2]))


@wp.func
def fault_of_sums(s: Scattered, unit: float):
    """Why a particle must not be added up, bits ``FAILURE_*``: an integer would hide what is no number or too large."""
    columns = s.A * wp.vec3(1.0, 1.0, 1.0)
    momentum = wp.vec3(s.at_base[1], s.at_base[2], s.at_base[3])
    kinematic = wp.vec3(s.at_base[4], s.at_base[5], s.at_base[6])
    if not wp.isfinite(wp.dot(momentum + kinematic + columns, wp.vec3(1.0, 1.0, 1.0))):
        return _NONFINITE
    most = wp.max(wp.max(wp.abs(momentum)), wp.max(wp.abs(kinematic)))
    for i in range(3):
        for j in range(3):
            most = wp.max(most, wp.abs(s.A[i, j]))
    return wp.where(most > MOST_UNITS * unit, _CFL, 0)


@wp.kernel
def runs_to_grid(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    moving: Moving,
    blocks: Blocks,
    order: wp.array(dtype=int),
    rounds: int,
    # in and out
    failure: wp.array(dtype=int),
    sums: Sums,
):
    """The same sums as :func:`piavatar_envs.mpm.transfer.particles_to_grid`.

    A warp takes 32 particles in each of its rounds; all of its threads take part in all of them.
    """
    t = wp.tid()
    per_env = moving.x.shape[1]
    for n in range(rounds):
        at = (t // 32 * rounds + n) * 32 + t % 32
        key = wp.int64(-1)
        tells = bool(False)
        e = int(0)
        p = int(0)
        s = Scattered()
        if at < moving.x.shape[0] * per_env:
            e = order[at] // per_env
            p = order[at] % per_env
            if scatters(blocks, moving, e, p, failure):
                s = prepare(grid, step, particles, moving, e, p)
                fault = fault_of_sums(s, sums.momentum_unit[row(e, sums.momentum_unit.shape[0]), particles.field[p]])
                if fault == 0:
                    key = cell_key(grid, e, particles.field[p], contact.num_fields, s.base)
                    tells = tells_place(grid, particles, boundaries, contact, blocks, e, p, moving.x[e, p], s.base)
                else:
                    wp.atomic_or(failure, e, fault)
        scatter_runs(
            grid, blocks, sums, contact.num_fields, WORTH_A_BRICK, n == 0, n == rounds - 1, key, tells,
            particles.seam[p], s, spline(s.f[0]), spline(s.f[1]), spline(s.f[2]),
        )  # fmt: skip


@wp.kernel
def grid_to_particles(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    node_velocity: wp.array2d(dtype=vec8),
    # in and out; vk is read
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
):
    """Move every particle with the grid, see :func:`piavatar_envs.mpm.transfer.gather`.

    Unlike the gather of a CPU it has its loops unrolled, and its threads store together.
    """
    e, p = wp.tid()
    stays = blocks.frozen[e] != 0
    s = Gathered()
    if not stays:
        s = gather(grid, step, particles, boundaries, node_velocity, blocks, moved, failure, e, p)
        stays = s.fault != 0
    store_vector(moved.x, e, p, s.x, not stays)
    store_vector(moved.u, e, p, s.u, not stays)
    store_matrix(moved.C, e, p, s.C, not stays)
    store_matrix(moved.F, e, p, s.F, not stays)


@wp.kernel
def number_cells(
    grid: Grid,
    particles: Particles,
    contact: Contact,
    x: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # out
    keys: wp.array(dtype=wp.int64),
    order: wp.array(dtype=int),
):
    """What particles are sorted by; those of an environment that has failed stay where they are."""
    e, p = wp.tid()
    n = e * x.shape[1] + p
    base = wp.vec3i(0, 0, 0)
    if failure[e] == 0:
        found = base_node(grid_position(grid, x[e, p]))
        if stencil_inside(grid, found):
            base = found
    keys[n] = cell_key(grid, e, particles.field[p], contact.num_fields, base)
    order[n] = n


def record_order(program: Program, model: Model, state: State, scratch: Scratch) -> None:
    """Append: sort the particles by cell, those of the same cell in the order that they have in memory."""
    m, count = model, model.num_envs * model.num_particles
    inputs = [m.grid, m.particles, m.contact, state.x, state.failure]
    program.launch(number_cells, state.x.shape, inputs, [scratch.keys, scratch.order])
    bits = (64 * m.num_envs * m.contact.num_fields * m.num_blocks).bit_length()
    program.call(
        "radix_sort_pairs", lambda: wp.utils.radix_sort_pairs(scratch.keys, scratch.order, count, end_bit=bits)
    )


def record_runs(program: Program, inputs: list[Any], order: wp.array, failure: wp.array, sums: Sums) -> None:
    """Append :func:`runs_to_grid`: few rounds where there are few particles, and all CUDA blocks whole."""
    count = order.size // 2
    rounds = next((n for n in (4, 2) if count >= n * PARTICLES_A_ROUND), 1)
    threads = -(-count // (THREADS * rounds)) * THREADS
    program.launch(runs_to_grid, threads, [*inputs, order, rounds], [failure, sums], block_dim=THREADS)
