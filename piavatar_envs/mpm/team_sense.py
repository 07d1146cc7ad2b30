"""What contact has done to a particle, found by its threads; see :mod:`piavatar_envs.mpm.sensing`."""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.impulses import read_change
from piavatar_envs.mpm.sensing import give, take_share
from piavatar_envs.mpm.stencil import BLOCK_NODES, Stencil
from piavatar_envs.mpm.sweep import any_lane, lane_of_thread, vector_sum_of_team
from piavatar_envs.mpm.team_gather import weight_of
from piavatar_envs.mpm.team_nodes import node_of_thread, record_in_team
from piavatar_envs.mpm.types import Particles, Sensors

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})


@wp.func
def slots_touched(several: bool, sensors: Sensors, e: int, slot: wp.vec2i, mark: int):
    """Which of the blocks that a thread has looked up contact has given a ``mark``: 0 if it has not.

    It has not where there are not ``several`` fields.
    """
    touched = wp.vec2i()
    if several:
        first = sensors.touched[e, slot[0]]
        second = sensors.touched[e, slot[1]]
        touched = wp.vec2i(int(first == mark), int(second == mark))
    return touched


@wp.func
def sense_by_team(
    team: int,
    particles: Particles,
    sensors: Sensors,
    e: int,
    p: int,
    m: float,
    stencil: Stencil,
    slot: wp.vec2i,
    touched: wp.vec2i,
):
    """Add a particle's share of what contact has done at its nodes to its sensor; ``m`` is its mass, 0 if it has none.

    ``slot`` are of the blocks that the thread has looked up, not 0 where they were ``touched``. All threads of a warp
    come here; few of those have anything to do.
    """
    if not any_lane((touched[0] | touched[1]) != 0):
        return
    # none of a block that was not touched: its changes are of the past
    record = wp.vec2i(
        wp.where(touched[0] != 0, BLOCK_NODES * slot[0], -BLOCK_NODES),
        wp.where(touched[1] != 0, BLOCK_NODES * slot[1], -BLOCK_NODES),
    )
    taken = wp.vec4()
    sensor = particles.sensor[p]
    nodes = (26 + team) // team  # not a constant: what few particles come to is as short as can be
    for n in range(nodes):
        node = node_of_thread(team, stencil.base, n)
        r = record_in_team(team, stencil.base, node, record)
        if sensor >= 0 and node[0] >= 0 and r >= 0:
            taken = take_share(sensors, e, sensor, taken, read_change(sensors.node, e, r), m * weight_of(stencil, node))
    # from one subject to all threads, as nearly always, what they have is added up first
    impulse = wp.vec3(taken[0], taken[1], taken[2])
    by = wp.where(wp.length_sq(impulse) > 0.0, taken[3] + 1.0, 0.0)
    has = wp.where(by > 0.0, 1.0, 0.0)
    count = vector_sum_of_team(team, wp.vec3(has, by, by * by))
    alike = count[0] * count[2] == count[1] * count[1]
    total = vector_sum_of_team(team, impulse)
    if not alike:
        give(sensors, e, sensor, taken)
    elif count[0] > 0.0 and (lane_of_thread() & (team - 1)) == 0:
        give(sensors, e, sensor, wp.vec4(total[0], total[1], total[2], count[1] / count[0] - 1.0))
