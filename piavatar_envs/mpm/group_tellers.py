"""What few particles of a group tell their nodes besides momentum: how they are driven, and where they are.

Contact asks for that, see :func:`piavatar_envs.mpm.transfer.tells_place`. These particles are listed, so that the first
threads of the group's CUDA block have them, and what they tell is added up and put down as momenta are, see
:mod:`piavatar_envs.mpm.groups`.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.group_bricks import (
    DRIVEN,
    HEAVIEST,
    MORE,
    SIZE,
    TELLERS,
    bricks_around,
    clear_nodes,
    in_group,
    per_unit_of,
)
from piavatar_envs.mpm.group_sums import put_down, raised
from piavatar_envs.mpm.runs import KINEMATIC, PLACE, told_by
from piavatar_envs.mpm.shared_add import tell_box
from piavatar_envs.mpm.shared_memory import APPEND, meet, thread_of_block, word
from piavatar_envs.mpm.stencil import spline
from piavatar_envs.mpm.transfer import Scattered
from piavatar_envs.mpm.types import Grid, Moving, Particles, Sums

wp.set_module_options({"enable_backward": False})


@wp.func_native(
    in_group(
        APPEND
        + """
const int place = append(room + MORE, __ballot_sync(ALL, tells), threadIdx.x & 31);
if (tells) room[TELLERS + place] = threadIdx.x;
"""
    )
)
def note_teller(tells: bool):
    """List the thread, if its particle ``tells`` its nodes more than momentum, in any order; all threads come here."""
    ...


@wp.func_native(
    in_group(
        SIZE
        + """
const int bricks = size[0] * size[1] * size[2];
return 2 * bricks <= CAPACITY ? BRICK_WORDS * bricks : 0;
""",
        "return 0;",
    )
)
def beyond_box() -> int:
    """Words from a node's to as many more for it, beyond those of the box; 0 where there is no room for these."""
    ...


@wp.func
def add_told(t: int, driven: Scattered, place: Scattered, drives: bool, to_place: int):
    """:func:`tell_box` of how a particle is ``driven`` and of its ``place``."""
    per_mass = per_unit_of(HEAVIEST)
    per_way = 0.5 * per_mass  # up to 1.5 masses
    k = per_unit_of(DRIVEN) * wp.vec3(driven.at_base[1], driven.at_base[2], driven.at_base[3])
    at_base = wp.vec4(
        per_mass * place.at_base[0], per_way * place.at_base[1], per_way * place.at_base[2], per_way * place.at_base[3]
    )
    tell_box(
        bricks_around(place.base), t, place.base, spline(place.f[0]), spline(place.f[1]), spline(place.f[2]), k,
        at_base, per_way * place.A[0, 0], drives, to_place,
    )  # fmt: skip


@wp.func
def tell_nodes(
    grid: Grid, particles: Particles, moving: Moving, failure: wp.array(dtype=int), sums: Sums, at: wp.vec4i
):
    """Scatter what particles that tell their nodes have besides momentum; all threads come here, few groups do.

    The first threads have those particles. How they are driven and where they are is added up at once, if there is room
    for both.
    """
    e = at[0]
    t = thread_of_block()
    tells = t < word(MORE)
    p = at[1] - t + word(TELLERS + wp.where(tells, t, 0))
    driven = told_by(grid, particles, e, p, moving.x[e, p], moving.vk[e, p], KINEMATIC)
    place = told_by(grid, particles, e, p, moving.x[e, p], moving.vk[e, p], PLACE)
    beyond = beyond_box()
    kinds = int(2)
    rounds = wp.where(beyond > 0, 1, kinds)
    for n in range(rounds):
        clear_nodes()
        if n == 0:  # what is added of places is no momentum, and as sound as the masses were
            tells = raised(driven, tells, KINEMATIC, failure, e)
        meet()
        if tells:
            add_told(t, driven, place, n == 0, wp.where(n == rounds - 1, beyond, -1))
        meet()
        for k in range(kinds):
            if rounds == 1 or k == n:
                put_down(grid, sums, failure, e, KINEMATIC + k, k * beyond)
        meet()
