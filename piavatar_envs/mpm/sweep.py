"""How the threads of a grid pass share the nodes.

There is room for twice as many slots as an environment uses, and only the device knows how many those are. A warp of a
GPU has the nodes of a slot, two a thread; on a CPU a thread has all of them. Where there are many, an environment gets
warps for some, which come back for more, and end where there is nothing to do.

Blocks with several fields are few, and listed. There a thread has one node::

    for turn in range(sweep.turns):
        first = thread * sweep.share + turn * sweep.stride
        if first >= end:
            break
        for n in range(first, first + sweep.share):
            ...
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.cuda_intrinsics import native
from piavatar_envs.mpm.bspline import BLOCK_NODES
from piavatar_envs.mpm.types import Model

wp.set_module_options({"enable_backward": False})

#: Threads of a CUDA block: four slots.
THREADS = 128
#: Threads of a warp.
LANES = 32
#: Slots for which a large GPU has threads at once, and the fewest for which an environment gets them.
SLOTS_AT_ONCE = 132 * 28
FEWEST_SLOTS = 8
#: The same for blocks that have several fields.
SHARED_AT_ONCE = 132 * 6
FEWEST_SHARED = 2


@wp.struct
class Sweep:
    """Who takes which nodes of blocks that have several fields; nobody where there are none."""

    threads: int  # of an environment
    turns: int  # that a thread may have
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
return (int)__ballot_sync(0xffffffffu, here);
#else
return here;
#endif
""")
def lanes_with(here: bool) -> int:
    """A bit for each thread of a warp, whether it is so ``here``; all of them come here. One bit on a CPU."""
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


@wp.func_native(
    native(
        """
wp::vec_t<3, wp::float32> sum = own;
#pragma unroll
for (int distance = 1; distance < 32; distance *= 2)
    if (distance < team)
#pragma unroll
        for (int c = 0; c < 3; ++c) sum[c] += __shfl_xor_sync(0xffffffffu, sum[c], distance);
return sum;
""",
        "return own;",
    )
)
def vector_sum_of_team(team: int, own: wp.vec3) -> wp.vec3:
    """Sum over the threads of a particle, or of a warp if that is the ``team``; all threads of a warp come here."""
    ...


@wp.func
def nodes_of_lane():
    """Nodes of a block that each of them has."""
    return BLOCK_NODES // lanes_of_warp()


def most_shared(model: Model) -> int:
    """Most blocks of an environment that can have several fields, and so several slots; 1 where there is but one."""
    return max(1, model.max_slots // 2) if model.contact.num_fields > 1 else 1


def plan_sweep(model: Model) -> Sweep:
    """How the threads of each environment walk over its blocks that have several fields."""
    nodes, blocks = int(BLOCK_NODES), 1
    sweep = Sweep()
    if model.contact.num_fields == 1:
        return sweep
    sweep.share = nodes
    if wp.get_device(model.device).is_cuda:
        blocks = min(most_shared(model), max(FEWEST_SHARED, -(-SHARED_AT_ONCE // model.num_envs)))
        sweep.share = 1
    sweep.turns, sweep.stride = -(-most_shared(model) // blocks), nodes * blocks
    sweep.threads = sweep.stride // sweep.share
    return sweep


def slots_at_once(model: Model) -> int:
    """Slots of an environment that a grid pass begins with; who has one comes back for more."""
    if wp.get_device(model.device).is_cuda:
        return min(model.max_slots, max(FEWEST_SLOTS, -(-SLOTS_AT_ONCE // model.num_envs)))
    return model.max_slots


def slot_threads(model: Model) -> int:
    """Threads that a slot has in a grid pass."""
    return LANES if wp.get_device(model.device).is_cuda else 1
