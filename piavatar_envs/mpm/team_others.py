"""Whether a particle's threads have other fields at the nodes of its stencil: see :mod:`piavatar_envs.mpm.carry`."""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.singles import place_of_block

wp.set_module_options({"enable_backward": False})


@wp.func
def nodes_along(base: int, upper: bool):
    """Bits of the nodes ``base`` to ``base + 2`` in a block of 4 along an axis, the lower or upper that they lie in."""
    block = base >> 2
    if upper:
        block = (base + 2) >> 2
    return (7 << (base - 4 * block + 2) >> 2) & 15


@wp.func
def meets_others(team: int, others: wp.array2d(dtype=int), e: int, slot: wp.vec2i, base: wp.vec3i):
    """Whether there was another field at those nodes of the stencil at ``base`` that are in a thread's blocks.

    Those of :func:`piavatar_envs.mpm.singles.slots_of_thread`, which these are; ``others`` as for
    :func:`piavatar_envs.mpm.others.had_others`.
    """
    meets = has_others(others, e, slot[0], place_of_block(team, 0), base)
    if team == 4:
        meets = has_others(others, e, slot[1], place_of_block(team, 1), base) or meets
    return meets


@wp.func
def has_others(others: wp.array2d(dtype=int), e: int, slot: int, place: int, base: wp.vec3i):
    """:func:`meets_others` in one ``slot``, by its :func:`piavatar_envs.mpm.singles.place_of_block`."""
    lower = others[e, 2 * slot]
    upper = others[e, 2 * slot + 1]
    x = nodes_along(base[0], (place & 4) != 0)
    y = nodes_along(base[1], (place & 2) != 0)
    z = nodes_along(base[2], (place & 1) != 0)
    plane = z * ((y & 1) | ((y & 2) << 3) | ((y & 4) << 6) | ((y & 8) << 9))
    first = plane * (x & 1) | (plane << 16) * ((x >> 1) & 1)
    second = plane * ((x >> 2) & 1) | (plane << 16) * (x >> 3)
    return ((lower & first) | (upper & second)) != 0
