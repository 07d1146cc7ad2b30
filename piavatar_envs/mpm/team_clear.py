"""Sums that are not needed any longer, cleared by warps of relays: see :mod:`piavatar_envs.mpm.relay`."""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.counts import Counts
from piavatar_envs.mpm.shared_memory import native
from piavatar_envs.mpm.stencil import BLOCK_NODES

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})


@wp.func_native(
    native(f"""
constexpr int NODES = {int(BLOCK_NODES)};
const int lane = threadIdx.x & 31;
const int4 zero = make_int4(0, 0, 0, 0);  // one for each of a slot's physical halves, then as many kinematic ones
int4* const halves = reinterpret_cast<int4*>(&wp::index(counts.sum, e, 2 * NODES * slot));
int4* const places = reinterpret_cast<int4*>(&wp::index(counts.offset, e, NODES * slot));
__syncwarp();  // all know whether it has been told
#pragma unroll
for (int n = lane; n < NODES; n += 32) halves[n] = zero;
if (told)
#pragma unroll 1
    for (int n = lane; n < NODES; n += 32) halves[NODES + n] = places[n] = zero;
if (told && lane == 0) wp::index(counts.told, e, slot) = 0;
""")
)
def clear_slot(counts: Counts, e: int, slot: int, told: bool):
    """Forget what the nodes of a slot have got, and what they have been told; all threads of a warp come here."""
    ...


@wp.func
def told_in_slot(several: bool, counts: Counts, e: int, swept: int, slot: int):
    """Whether nodes of a ``slot`` have been told anything in the set that begins at ``swept``; -1 if there is none.

    Where there are ``several`` fields, others clear it.
    """
    told = bool(False)
    if not several and swept >= 0:
        told = counts.told[e, swept + slot] != 0
    return told


@wp.func
def clear_share(counts: Counts, e: int, swept: int, slot: int, used: int, apart: int, told: bool):
    """:func:`clear_slot` of every slot that is a warp's, ``slot`` and those ``apart`` from it, the first if ``told``.

    There are several where particles are so few that slots are more than warps.
    """
    while slot < used:
        clear_slot(counts, e, swept + slot, told)
        slot += apart
        if slot < used:
            told = counts.told[e, swept + slot] != 0
