"""At which nodes of a field another one has been: there its particles tell their nodes where they are.

Contact acts at nodes to which all particles of both fields have told that. Which these are must be known before the
particles are scattered, and is known of the substep before: a field tells a node if another one was there then, and
only fields that have told a node touch there. That is a substep after the second has come to it, with little weight
unless it moves nearly a grid spacing in a time step. When blocks are marked anew, their slots are others, and fields
tell all nodes of blocks that have several: who comes then touches at once.

For :mod:`piavatar_envs.mpm.groups`, where a group takes three times as long if one of its particles tells; other
scatters tell all nodes of blocks with several fields in every substep.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.blocks import slots_used
from piavatar_envs.mpm.stencil import BLOCK_NODES
from piavatar_envs.mpm.sweep import lane_of_thread, lanes_with
from piavatar_envs.mpm.types import Blocks

wp.set_module_options({"enable_backward": False})


@wp.func
def told_at_first(blocks: Blocks, e: int, slot: int):
    """Bits of a slot's nodes that are told where particles are when blocks have just been marked: all or none."""
    told = int(0)
    if slot < slots_used(blocks, e):
        mask = blocks.fields[e, blocks.held[e, slot] % blocks.fields.shape[1]]
        if (mask & (mask - 1)) != 0:
            told = -1
    return told


@wp.kernel
def begin_others(blocks: Blocks):
    """Blocks have been marked."""
    e, slot = wp.tid()
    told = told_at_first(blocks, e, slot)
    blocks.others[e, 2 * slot] = told
    blocks.others[e, 2 * slot + 1] = told


@wp.func
def has_told(blocks: Blocks, e: int, r: int):
    """Whether all particles have told the node of a field's record ``r``, in a block that has several, where they are.

    They have where nobody notes who is where.
    """
    if blocks.others.shape[1] == 1:
        return True
    local = r % BLOCK_NODES
    return ((blocks.others[e, 2 * (r // BLOCK_NODES) + local // 32] >> (local & 31)) & 1) != 0


@wp.func
def note_others(blocks: Blocks, e: int, r: int, here: bool):
    """Note whether others are ``here``, at the node of record ``r``; all threads of a warp, with half a block, do."""
    if blocks.others.shape[1] == 1:
        return
    bits = lanes_with(here)
    if lane_of_thread() == 0:
        blocks.others[e, 2 * (r // BLOCK_NODES) + (r % BLOCK_NODES) // 32] = bits
