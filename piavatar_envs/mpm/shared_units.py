"""What the words of nodes in shared memory count: units of mass, and speeds that momenta are counted at."""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.blocks import has_field
from piavatar_envs.mpm.shared_grid import (
    FASTEST,
    HEAVIEST,
    LOST,
    SPEED,
    UNITS,
    bricks_of_round,
    node_word,
)
from piavatar_envs.mpm.shared_memory import (
    add_word,
    meet,
    number,
    power_of_two,
    set_number,
    thread_of_block,
    threads_of_block,
    word,
)
from piavatar_envs.mpm.transfer import Scattered
from piavatar_envs.mpm.types import (
    Room,
)

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Slowest speed that momenta are counted at [m/s].
SLOWEST = wp.constant(2.0**-20)
#: Units of mass in a field's heaviest particle where places are told.
PLACE_UNITS = wp.constant(2.0**20)
#: Units of mass in which is counted what particles have given and nodes have not got. Where a word has run over, 2^20
#: are missing at least; what is rounded is far less than half of that.
LOST_UNITS, MOST_LOST = wp.constant(2**12), wp.constant(2**19)


@wp.func
def unit_of_mass(field: int):
    """Mass that a word counts [kg], a power of two."""
    return power_of_two(number(HEAVIEST + field)) / number(UNITS)


@wp.func
def unit_of_place(field: int):
    """Mass that a word of places counts [kg]: more than it does of masses, for they are seen to after these."""
    return power_of_two(number(HEAVIEST + field)) / PLACE_UNITS


@wp.func
def speed_of(s: Scattered, physical: float):
    """A bound of the momenta that a particle adds, by its mass [m/s]; of the ``physical`` ones it is known [kg m/s]."""
    most = physical
    for c in range(3):
        most = wp.max(most, wp.abs(s.at_base[4 + c]))
    return most / s.at_base[0]


@wp.func
def speed_for(fastest: float):
    """A power of two that the fastest particle will not exceed, if it does not gain a quarter at once."""
    return wp.max(SLOWEST, power_of_two(1.25 * fastest))


@wp.func
def speeds_known(room: Room, part: wp.vec3i):
    """Whether there is a speed at which to count the momenta of every field."""
    known = bool(True)
    for f in range(room.speed.shape[1]):
        known = known and (number(SPEED + f) > 0.0 or not has_field(part[2], f))
    return known


@wp.func
def sums_hold(room: Room, part: wp.vec3i, first: int, given: int):
    """Whether momenta have been counted at speeds that no particle exceeds, and no word counts more than it can.

    All threads come here; their particles have ``given`` so much mass [LOST_UNITS].
    """
    known = speeds_known(room, part)
    if known:
        lost = int(given)
        for n in range(thread_of_block(), 8 * bricks_of_round(room, first), threads_of_block()):
            lost -= word(node_word(room, n)) // LOST_UNITS
        add_word(LOST, lost)
    meet()
    hold = known and word(LOST) < MOST_LOST
    for f in range(room.speed.shape[1]):
        hold = hold and (number(FASTEST + f) <= number(SPEED + f) or not has_field(part[2], f))
    return hold


@wp.func
def correct_units(room: Room, part: wp.vec3i):
    """Count the momenta of fields that were too fast at higher speeds, and in larger units if words were too small.

    All threads come here.
    """
    f = thread_of_block()
    meet()
    if f == 0 and word(LOST) >= MOST_LOST:
        set_number(UNITS, number(UNITS) / 8.0)
    if f < room.speed.shape[1]:
        slow = number(SPEED + f) == 0.0 or number(FASTEST + f) > number(SPEED + f)
        if slow and has_field(part[2], f):
            set_number(SPEED + f, speed_for(number(FASTEST + f)))
    meet()
