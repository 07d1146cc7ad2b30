"""How the threads of a grid pass walk over the nodes of the slots in use.

Only the device knows how many slots an environment uses. There is room for twice as many, and a thread that finds
nothing to do costs a good part of one that does. On a GPU an environment therefore gets fewer threads, which come back
for more: a warp takes half a block in a turn. What must be known of the blocks of its next turns its threads find out
beforehand, each for one. On a CPU a thread takes a whole block, and that is that.

    lane = lane_of_thread()
    begin = first_node(sweep, thread)
    if begin >= end:
        return
    known = ...  # of the block of node begin + lane * sweep.stride, if that comes before the end
    for turn in range(sweep.turns):
        first = begin + turn * sweep.stride
        if first >= end:
            break
        of_block = from_lane(known, turn)
        for r in range(first + lane, first + lane + sweep.share):
            ...
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.stencil import BLOCK_NODES
from piavatar_envs.mpm.types import Model

wp.set_module_options({"enable_backward": False})

#: Threads of a CUDA block: two slots.
THREADS = 128
#: Threads of a warp.
LANES = 32
#: Slots for which a large GPU has threads at once, and the fewest for which an environment gets them.
SLOTS_AT_ONCE = 132 * 32
FEWEST_SLOTS = 8
#: The same for blocks that have several fields.
SHARED_AT_ONCE = 132 * 6
FEWEST_SHARED = 2


@wp.struct
class Sweep:
    """Who takes which nodes."""

    threads: int  # of an environment
    turns: int  # that a thread may have, no more than there are threads to look ahead for each other
    share: int  # nodes of a thread in a turn
    stride: int  # nodes from one turn to the next


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return threadIdx.x & 31;
#else
return 0;
#endif
""")
def lane_of_thread() -> int:
    """Place of a thread in its warp; 0 on a CPU."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __shfl_sync(0xffffffffu, value, lane);
#else
return value;
#endif
""")
def from_lane(value: int, lane: int) -> int:
    """What ``value`` is in thread ``lane`` of the warp; all of its threads must come here."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __any_sync(0xffffffffu, here);
#else
return here;
#endif
""")
def any_lane(here: bool) -> bool:
    """Whether it is so ``here`` in any thread of the warp; all of its threads must come here."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return 32;
#else
return 1;
#endif
""")
def lanes_of_warp() -> int:
    """Threads of a warp; 1 on a CPU."""
    ...


@wp.func
def first_node(sweep: Sweep, thread: int):
    """First node that the warp of a thread takes."""
    return thread * sweep.share - lane_of_thread()


def most_shared(model: Model) -> int:
    """Most blocks of an environment that can have several fields, and so several slots; 1 where there is but one."""
    return max(1, model.max_slots // 2) if model.contact.num_fields > 1 else 1


def plan_shared_sweep(model: Model) -> tuple[tuple[int, int], Sweep]:
    """:func:`plan_sweep` over the blocks that have several fields, which are listed and few."""
    nodes, blocks = int(BLOCK_NODES), 1
    sweep = Sweep()
    sweep.share = nodes
    if wp.get_device(model.device).is_cuda:
        blocks = min(most_shared(model), max(FEWEST_SHARED, -(-SHARED_AT_ONCE // model.num_envs)))
        sweep.share = 1
    sweep.turns, sweep.stride = -(-most_shared(model) // blocks), nodes * blocks
    sweep.threads = sweep.stride // sweep.share
    return (model.num_envs, sweep.threads), sweep


def plan_sweep(model: Model) -> tuple[tuple[int, int], Sweep]:
    """Launch dimensions ``(num_envs, threads)`` of a grid pass, and how its threads walk."""
    nodes = int(BLOCK_NODES)
    sweep = Sweep()
    slots, sweep.share = model.max_slots, nodes
    if wp.get_device(model.device).is_cuda:
        slots = max(FEWEST_SLOTS, -(-SLOTS_AT_ONCE // model.num_envs), -(-model.max_slots // LANES))
        slots, sweep.share = min(slots, model.max_slots), 1
    sweep.turns, sweep.stride = -(-model.max_slots // slots), nodes * slots
    sweep.threads = sweep.stride // sweep.share
    return (model.num_envs, sweep.threads), sweep
