"""G2P of large bodies on a GPU, and what their P2G (:mod:`piavatar_envs.mpm.cuda.tiled_p2g`) adds up and what not."""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.cuda_intrinsics import environment_of
from piavatar_envs.mpm.bspline import grid_position
from piavatar_envs.mpm.contact_sensors import sense_gathered
from piavatar_envs.mpm.g2p import Gathered, gather
from piavatar_envs.mpm.p2g import Scattered, momentum_bounds, placed
from piavatar_envs.mpm.stores import store_particle
from piavatar_envs.mpm.types import (
    FAILURE_CFL,
    FAILURE_NONFINITE,
    Blocks,
    Boundaries,
    Grid,
    Moving,
    Particles,
    Sensors,
    Step,
    row,
    vec8,
)

# divisions and roots to two units in the last place, and logarithms to 4e-7, in a few instructions instead of calls: a
# warp with a few particles waits for its instructions as much as for its numbers
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

_NONFINITE = wp.constant(FAILURE_NONFINITE)
_CFL = wp.constant(FAILURE_CFL)
#: Units of momentum that a particle may have: those of 4,000 full cells that move a grid spacing in a time step.
MOST_COUNTED = wp.constant(float(2**48))
#: What is added up: mass and momentum; kinematic momentum; places and seams.
MOMENTUM, KINEMATIC, PLACE = (wp.constant(n) for n in range(3))
#: Threads of a CUDA block of the gather.
THREADS = 128


@wp.func
def told_by(grid: Grid, particles: Particles, e: int, p: int, x: wp.vec3, vk: wp.vec3, kind: int):
    """How particle ``p`` at ``x`` is driven, or its place ``w m (x_i - x_p) / dx`` and a seam's ``w m``."""
    s = placed(grid, x)
    m = particles.mass[row(e, particles.mass.shape[0]), p]
    if kind == KINEMATIC:
        k = m * vk
        s.at_base = vec8(0.0, k[0], k[1], k[2], 0.0, 0.0, 0.0, 0.0)
    else:
        s.at_base = vec8(particles.seam[p] * m, -m * s.f[0], -m * s.f[1], -m * s.f[2], 0.0, 0.0, 0.0, 0.0)
        s.A = wp.diag(wp.vec3(m))
    return s


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
    return wp.where(most > MOST_COUNTED * unit, _CFL, 0)


@wp.func
def fault_within(s: Scattered, bounds: wp.vec3, unit: float):
    """:func:`fault_of_sums`, asked for only where the ``bounds`` of what a particle has leave that open."""
    fault = int(0)
    if not bounds[0] + bounds[1] + bounds[2] < MOST_COUNTED * unit:  # of what is no number, either
        fault = fault_of_sums(s, unit)
    return fault


@wp.func
def bounded(s: Scattered, unit: float, failure: wp.array(dtype=int), e: int):
    """The most momentum that a particle has anywhere in its stencil [kg m/s]; -1 if it must not be added up."""
    bounds = momentum_bounds(s)
    fault = fault_within(s, bounds, unit)
    if fault != 0:
        wp.atomic_or(failure, e, fault)
        return -1.0
    return wp.max(bounds)


@wp.kernel(launch_bounds=(THREADS, 6))
def grid_to_particles(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    node_velocity: wp.array2d(dtype=wp.vec4),
    senses: int,
    # in and out; vk is read
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
    sensors: Sensors,
):
    """Move every particle with the grid, see :func:`piavatar_envs.mpm.g2p.gather`.

    Unlike the gather of a CPU it has its loops unrolled, and its threads store together. If it ``senses``, it does the
    work of :func:`piavatar_envs.mpm.contact_sensors.sense_contact` first.
    """
    at = environment_of(wp.tid(), particles.field.shape[0])
    e = at[0]
    p = at[1]
    stays = blocks.frozen[e] != 0
    s = Gathered()
    if not stays:
        if senses != 0:
            sense_gathered(grid, particles, blocks, sensors, e, p, grid_position(grid, moved.x[e, p]))
        s, _ = gather(grid, step, particles, boundaries, node_velocity, blocks, moved, failure, e, p)
        stays = s.fault != 0
    store_particle(moved, e, p, s, not stays)
