"""At which nodes of a field another one has been: there its particles tell their nodes where they are.

Contact acts at nodes to which all particles of both fields have told that. Which these are must be known before the
particles are scattered, whatever the order in which they are: it is known of the substep before. A field tells a node
if another one was there then, and only fields that have told a node touch there. That is a substep after the second has
come to it, with little weight unless it moves nearly a grid spacing in a time step. When blocks are marked anew, their
slots are others, and fields tell all nodes of blocks that have several: who comes then touches at once.

For :mod:`piavatar_envs.mpm.groups`, where a group takes much longer if one of its particles tells; other scatters tell
all nodes of blocks with several fields in every substep.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.blocks import slots_used
from piavatar_envs.mpm.stencil import BLOCK_NODES
from piavatar_envs.mpm.sweep import lane_of_thread, lanes_with
from piavatar_envs.mpm.types import Blocks, Model

wp.set_module_options({"enable_backward": False})


def notes_others(model: Model) -> bool:
    """Whether that is noted, and not told everywhere."""
    return model.scatter == "runs" and model.contact.num_fields > 1


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
def has_bit(words: wp.array2d(dtype=int), e: int, first: int, local: int):
    """Whether a node of a block has its bit, of the two words from ``first`` on."""
    return ((words[e, first + local // 32] >> (local & 31)) & 1) != 0


@wp.func
def note_bits(words: wp.array2d(dtype=int), e: int, first: int, local: int, here: bool):
    """Give a node of a block its bit, or take it away; all threads of a warp, with half a block, come here."""
    bits = lanes_with(here)
    if lane_of_thread() == 0:
        words[e, first + local // 32] = bits


@wp.func
def had_others(others: wp.array2d(dtype=int), e: int, r: int):
    """Whether the node of a field's record ``r`` had another field in the substep whose bits these are.

    In the next, all particles of its own field have told it where they are.
    """
    return has_bit(others, e, 2 * (r // BLOCK_NODES), r % BLOCK_NODES)


@wp.func
def has_told(blocks: Blocks, e: int, r: int):
    """Whether all particles have told the node of a field's record ``r``, in a block that has several, where they are.

    They have where nobody notes who is where.
    """
    if blocks.others.shape[1] == 1:
        return True
    return had_others(blocks.others, e, r)


@wp.func
def note_others(blocks: Blocks, e: int, r: int, here: bool):
    """Note whether others are ``here``, at the node of record ``r``; all threads of a warp, with half a block, do."""
    if blocks.others.shape[1] == 1:
        return
    note_bits(blocks.others, e, 2 * (r // BLOCK_NODES), r % BLOCK_NODES, here)
