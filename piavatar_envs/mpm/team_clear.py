"""Sums that are not needed any longer, cleared by warps that carry particles on: see :mod:`piavatar_envs.mpm.relay`."""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.stencil import BLOCK_NODES
from piavatar_envs.mpm.sums import clear_offset
from piavatar_envs.mpm.sweep import lane_of_thread, lanes_of_warp, nodes_of_lane
from piavatar_envs.mpm.team import clear_halves
from piavatar_envs.mpm.types import Sums

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})


@wp.func
def clear_slot(sums: Sums, e: int, slot: int, told: bool):
    """Forget what the nodes of a slot have got, and what they have been told; all threads of a warp come here."""
    clear_halves(sums, e, BLOCK_NODES * slot, told)
    if told:
        for n in range(nodes_of_lane()):
            clear_offset(sums, e, BLOCK_NODES * slot + lane_of_thread() + n * lanes_of_warp())
        sums.told[e, slot] = 0


@wp.func
def clear_share(sums: Sums, e: int, swept: int, slot: int, used: int, apart: int, told: bool):
    """:func:`clear_slot` of every slot that is a warp's, ``slot`` and those ``apart`` from it, the first if ``told``.

    There are several where particles are so few that slots are more than warps.
    """
    while slot < used:
        clear_slot(sums, e, swept + slot, told)
        slot += apart
        if slot < used:
            told = sums.told[e, swept + slot] != 0
