"""The scatter of a body into the shared memory of its CUDA block: integers are added up.

Where they lie is in :mod:`piavatar_envs.mpm.shared_grid`. The result does not depend on the order of the threads, and
not on how many bricks there is room for.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.runs import fault_within
from piavatar_envs.mpm.shared_add import add_kinematic, add_place, add_to_bricks, share_of_round
from piavatar_envs.mpm.shared_grid import (
    BLOCK_BRICKS,
    BRICK_WORDS,
    COUNT,
    FASTEST,
    FAULTS,
    LISTED,
    LOST,
    PLACES,
    SPEED,
    TOLD,
    bricks_around,
    bricks_of_round,
    clear_bricks,
    in_marked_plane,
    node_word,
    sums_at,
)
from piavatar_envs.mpm.shared_layout import end_of_part, record_of_place
from piavatar_envs.mpm.shared_memory import (
    half_word,
    has_bit,
    list_bits,
    meet,
    number,
    or_word,
    raise_to,
    set_word,
    thread_of_block,
    threads_of_block,
    word,
)
from piavatar_envs.mpm.shared_units import (
    LOST_UNITS,
    correct_units,
    speed_of,
    speeds_known,
    sums_hold,
    unit_of_mass,
    unit_of_place,
)
from piavatar_envs.mpm.stencil import spline
from piavatar_envs.mpm.transfer import momentum_bounds, moves_finitely, placed, prepare
from piavatar_envs.mpm.types import (
    FAILURE_CFL,
    FAILURE_NONFINITE,
    Blocks,
    Grid,
    Moving,
    Particles,
    Room,
    Step,
    Sums,
    row,
)

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

_CFL = wp.constant(FAILURE_CFL)
_NONFINITE = wp.constant(FAILURE_NONFINITE)
#: A particle that goes or is driven further than this in a substep [grid spacings] has failed, and is not added up.
MOST_CELLS = wp.constant(8.0)


@wp.func
def scatter_place(
    grid: Grid,
    particles: Particles,
    blocks: Blocks,
    room: Room,
    e: int,
    p: int,
    plane: int,
    first: int,
    x: wp.array2d(dtype=wp.vec3),
):
    """Where a particle is, to the bricks that a plane of its stencil is in."""
    field = particles.field[p]
    s = placed(grid, x[e, p])
    m = particles.mass[row(e, particles.mass.shape[0]), p] / unit_of_place(field)
    n = bricks_around(grid, blocks, room, e, field, s.base, first)
    add_place(n, s.base, spline(s.f[0]), spline(s.f[1]), spline(s.f[2]), plane, m, particles.seam[p])


@wp.func
def scatter_places(
    grid: Grid,
    particles: Particles,
    blocks: Blocks,
    room: Room,
    e: int,
    part: wp.vec3i,
    first: int,
    x: wp.array2d(dtype=wp.vec3),
    # out
    sums: Sums,
):
    """Where particles are, to the nodes' offsets, from those that tell it; the bricks are left clear.

    Where there is one field, only nodes near a boundary are told; the grid pass forgets what they have been told.
    """
    t = thread_of_block()
    several = room.speed.shape[1] > 1
    clear_bricks(room, first)
    meet()
    # they are few, and would leave most threads of many warps idle: where there is room behind the bricks, they are
    # listed, which is in one round only, for all but the last are full
    listed = room.bricks + BRICK_WORDS * bricks_of_round(room, first)
    if word(TOLD) <= 2 * (room.bricks + BRICK_WORDS * room.capacity - listed):
        list_bits(room.told, room.near - room.told, listed, LISTED)
        meet()
        for n in range(t, 3 * word(TOLD), threads_of_block()):
            scatter_place(grid, particles, blocks, room, e, half_word(listed, n // 3), n % 3, first, x)
    else:
        for n in range(3 * part[0] + t, 3 * part[1], threads_of_block()):
            if has_bit(room.told, n // 3):
                scatter_place(grid, particles, blocks, room, e, n // 3, n % 3, first, x)
    meet()
    for n in range(t, 8 * bricks_of_round(room, first), threads_of_block()):
        at = node_word(room, n)
        told = sums_at(at)
        if told[0] != 0 or told[1] != 0 or told[2] != 0 or told[3] != 0:
            marked = half_word(room.places, first + n // 8)
            place = marked % PLACES
            if several or in_marked_plane(marked, n):
                f = int(0)
                if several:
                    f = blocks.held[e, place // BLOCK_BRICKS] // grid.num_blocks
                unit = unit_of_place(f)
                o = (grid.dx * unit) * wp.vec3(float(told[0]), float(told[1]), float(told[2]))
                sums.offset[e, record_of_place(place, n % 8)] = wp.vec4(o[0], o[1], o[2], unit * float(told[3]))
            for c in range(4):
                set_word(at + c, 0)
    meet()


@wp.func
def scatter_momenta(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    blocks: Blocks,
    room: Room,
    sums: Sums,
    failure: wp.array(dtype=int),
    e: int,
    part: wp.vec3i,
    first: int,
    adds: bool,
    clears: bool,
):
    """Find the fastest particle of every field, and where it ``adds``, add masses and momenta of all to the bricks.

    Returns the mass that the particles of a thread give [LOST_UNITS].
    """
    t = thread_of_block()
    given = int(0)
    if t == 0:
        set_word(LOST, 0)
    if t < room.speed.shape[1]:
        set_word(FASTEST + t, 0)
    if clears:
        clear_bricks(room, first)
    meet()
    for p in range(part[0] + t, end_of_part(blocks, failure, e, part), threads_of_block()):
        field = particles.field[p]
        s = prepare(grid, step, particles, moving, e, p, has_bit(room.told, p))  # asks for all that it needs at once
        if moves_finitely(moving, e, p):
            bounds = momentum_bounds(s)
            unit = sums.momentum_unit[row(e, sums.momentum_unit.shape[0]), field]
            fault = fault_within(s, bounds, unit)
            speed = speed_of(s, wp.max(bounds))
            if fault != 0:
                wp.atomic_or(failure, e, fault)
                or_word(FAULTS, fault)
            elif speed * step.dt > MOST_CELLS * grid.dx:  # it would blur the sums of the others
                wp.atomic_or(failure, e, _CFL)
            else:
                raise_to(FASTEST + field, speed)
                if adds:
                    n = bricks_around(grid, blocks, room, e, field, s.base, first)
                    per_mass = 1.0 / unit_of_mass(field)
                    per_momentum = per_mass / number(SPEED + field)
                    wx = spline(s.f[0])
                    wy = spline(s.f[1])
                    wz = spline(s.f[2])
                    if s.at_base[4] != 0.0 or s.at_base[5] != 0.0 or s.at_base[6] != 0.0:
                        add_kinematic(room, n, s, wx, wy, wz, per_momentum)
                    units = s.at_base[0] * per_mass
                    if word(COUNT) > room.capacity:
                        units *= share_of_round(room, n, s.base, wx, wy, wz)
                    given += int(units) // LOST_UNITS
                    add_to_bricks(n, p, s, wx, wy, wz, per_mass, per_momentum)
        else:
            wp.atomic_or(failure, e, _NONFINITE)
            or_word(FAULTS, _NONFINITE)
    meet()
    return given


@wp.func
def scatter_round(
    grid: Grid,
    step: Step,
    particles: Particles,
    moving: Moving,
    blocks: Blocks,
    room: Room,
    sums: Sums,
    failure: wp.array(dtype=int),
    e: int,
    part: wp.vec3i,
    first: int,
    clear: bool,
):
    """Sums of the bricks from the ``first`` on, in units that hold. The bricks may be ``clear``."""
    hold = bool(False)
    unused = bool(clear)
    while not hold:
        adds = speeds_known(room, part)
        clears = adds and not unused
        given = scatter_momenta(
            grid, step, particles, moving, blocks, room, sums, failure, e, part, first, adds, clears
        )
        unused = unused and not adds
        hold = sums_hold(room, part, first, given)
        if not hold:
            correct_units(room, part)
