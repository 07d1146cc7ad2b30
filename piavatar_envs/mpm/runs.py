"""The transfers of a GPU. The scatter takes up to 32 particles at a time and adds them up before the nodes are touched.

What a warp does with them is in :mod:`piavatar_envs.mpm.warp_scatter`. Particles are taken as they lie in memory, where
neighbours in the body should be neighbours: the fewer cells and blocks the particles of a warp are in, the faster.
Sorting them by cell would halve the cells, and costs more than that: their state would have to be gathered.

A warp adds up in an order that depends on the positions of its particles only. With the nodes' sums in fixed point
(:mod:`piavatar_envs.mpm.sums`) the result does not depend on the schedule of the warps either: runs repeat bit for bit,
and an environment does the same in any batch.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from piavatar_envs.mpm.gather import Gathered, gather
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.sensing import sense_gathered
from piavatar_envs.mpm.stencil import grid_position, spline
from piavatar_envs.mpm.stores import store_particle
from piavatar_envs.mpm.threads import environment_of
from piavatar_envs.mpm.transfer import Scattered, near_boundary, prepare, scatters
from piavatar_envs.mpm.types import (
    FAILURE_CFL,
    FAILURE_NONFINITE,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Moving,
    Particles,
    Sensors,
    Step,
    Sums,
    row,
    vec8,
)
from piavatar_envs.mpm.warp_scatter import scatter_runs

# divisions and roots to two units in the last place, and logarithms to 4e-7, in a few instructions instead of calls: a
# warp with a few particles waits for its instructions as much as for its numbers
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

_NONFINITE = wp.constant(FAILURE_NONFINITE)
_CFL = wp.constant(FAILURE_CFL)
#: Units of momentum that a particle may have: those of 4,000 full cells that move a grid spacing in a time step.
MOST_UNITS = wp.constant(float(2**48))
#: Threads of a CUDA block: four warps, whose stages and bricks fit the shared memory of a block.
THREADS = 128
#: Up to how many particles of an environment a warp takes so many in a round, and in how many rounds. Small worlds come
#: in batches, which fill a GPU anyway; of a single larger one, many warps with few particles each do. The numbers must
#: not depend on the batch: in which order particles are added up does on them.
SHARES = ((8192, 32, 2), (16384, 4, 1), (65536, 16, 1), (262144, 32, 1), (2**31, 32, 2))


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


@wp.kernel(launch_bounds=(128, 5))
def runs_to_grid(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    moving: Moving,
    blocks: Blocks,
    threads: int,
    share: int,
    rounds: int,
    # in and out
    failure: wp.array(dtype=int),
    sums: Sums,
):
    """The same sums as :func:`piavatar_envs.mpm.transfer.particles_to_grid`.

    An environment has so many ``threads``. A warp takes ``share`` particles in each of its rounds; all of its threads
    come to what they do together.
    """
    at = environment_of(wp.tid(), threads)
    e = at[0]
    t = at[1]
    for n in range(rounds):
        p = (t // 32 * rounds + n) * share + t % 32
        takes = bool(False)
        near = bool(False)
        field = int(0)
        seam = float(0.0)
        s = Scattered()
        if t % 32 < share and p < moving.x.shape[1]:
            takes = scatters(blocks, moving, e, p, failure)
        if takes:
            field = particles.field[p]
            seam = particles.seam[p]
            near = near_boundary(grid, boundaries, e, moving.x[e, p])
            # which blocks have other fields comes to light later
            s = prepare(grid, step, particles, moving, e, p, near or contact.num_fields > 1)
            fault = fault_of_sums(s, sums.momentum_unit[row(e, sums.momentum_unit.shape[0]), field])
            if fault != 0:
                wp.atomic_or(failure, e, fault)
                takes = False
        scatter_runs(
            grid, blocks, sums, contact.num_fields, e, n == 0, n == rounds - 1, takes, near, field, seam,
            s, spline(s.f[0]), spline(s.f[1]), spline(s.f[2]),
        )  # fmt: skip


@wp.kernel(launch_bounds=(128, 5))
def grid_to_particles(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    node_velocity: wp.array2d(dtype=vec8),
    senses: int,
    # in and out; vk is read
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
    sensors: Sensors,
):
    """Move every particle with the grid, see :func:`piavatar_envs.mpm.gather.gather`.

    Unlike the gather of a CPU it has its loops unrolled, and its threads store together. If it ``senses``, it does the
    work of :func:`piavatar_envs.mpm.sensing.sense_contact` first, for the same particles.
    """
    at = environment_of(wp.tid(), moved.x.shape[1])
    e = at[0]
    p = at[1]
    stays = blocks.frozen[e] != 0
    s = Gathered()
    if not stays:
        if senses != 0:
            sense_gathered(grid, particles, blocks, sensors, e, p, grid_position(grid, moved.x[e, p]))
        s = gather(grid, step, particles, boundaries, node_velocity, blocks, moved, failure, e, p)
        stays = s.fault != 0
    store_particle(moved, e, p, s, not stays)


def record_runs(program: Program, inputs: list[Any], shape: tuple[int, int], failure: wp.array, sums: Sums) -> None:
    """Append :func:`runs_to_grid` for particles of ``shape``: CUDA blocks are whole, and none has two environments."""
    num_envs, per_env = shape
    share, rounds = next(rest for most, *rest in SHARES if per_env <= most)
    threads = -(-per_env * 32 // (THREADS * share * rounds)) * THREADS
    inputs = [*inputs, threads, share, rounds]
    program.launch(runs_to_grid, num_envs * threads, inputs, [failure, sums], block_dim=THREADS)
