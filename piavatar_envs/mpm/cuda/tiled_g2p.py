"""G2P of large bodies on a GPU."""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.cuda_intrinsics import environment_of
from piavatar_envs.mpm.bspline import grid_position
from piavatar_envs.mpm.contact_sensors import sense_near_field
from piavatar_envs.mpm.g2p import Advanced, g2p_particle, store_particle
from piavatar_envs.mpm.types import Blocks, Boundaries, Grid, Moving, Particles, Sensors, Step

# fast_math: divisions and roots to two units in the last place, logarithms to 4e-7, without function calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

#: Threads of a CUDA block of G2P.
THREADS = 128


@wp.kernel(launch_bounds=(THREADS, 6))
def tiled_g2p(
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
    """Move every particle with the grid; see :func:`piavatar_envs.mpm.g2p.g2p_particle`.

    Unlike G2P on a CPU its loops are unrolled, and the threads of a warp store together. If ``senses`` is not 0, it
    first does the work of :func:`piavatar_envs.mpm.contact_sensors.sense_contact`.
    """
    at = environment_of(wp.tid(), particles.field.shape[0])
    e = at[0]
    p = at[1]
    stays = blocks.frozen[e] != 0
    s = Advanced()
    if not stays:
        if senses != 0:
            sense_near_field(grid, particles, blocks, sensors, e, p, grid_position(grid, moved.x[e, p]))
        s, _ = g2p_particle(grid, step, particles, boundaries, node_velocity, blocks, moved, failure, sensors, e, p)
        stays = s.fault != 0
    store_particle(moved, e, p, s, not stays)
