"""Nodes at which fields may touch, listed by who finds out which way these face, for :mod:`piavatar_envs.mpm.relay`.

Of the nodes of blocks with several fields a tenth have matter of two. A warp has each of those then; if a thread had
one, most warps would go a long way for one or two. In which order they are listed is not determined, and nothing but
who sees to them depends on it.

There are two numbers of nodes, of even and of odd substeps: one is in use while the other is zeroed.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.stencil import BLOCK_NODES
from piavatar_envs.mpm.sweep import most_shared
from piavatar_envs.mpm.types import Model, group

wp.set_module_options({"enable_backward": False})

#: Nodes for which warps are launched where there are few environments, more than a large GPU has room for: a warp that
#: comes back for a second one takes longer than others to begin. And the fewest for which an environment gets them.
NODES_AT_ONCE, FEWEST_NODES = 132 * 40, 4


@wp.struct
class Meeting:
    """The list of every environment."""

    node: wp.array2d(dtype=int)  # (num_envs, most) 64 block + place in the block
    count: wp.array2d(dtype=int)  # (num_envs, 2)


def begin_list(model: Model) -> Meeting:
    """A list with room for all nodes of all blocks that have several fields."""
    n = model.num_envs
    most = int(BLOCK_NODES) * most_shared(model)
    node, count = (wp.zeros((n, size), dtype=int, device=model.device) for size in (most, 2))
    return group(Meeting, node=node, count=count)


def warps_of_meeting(model: Model) -> int:
    """Warps of an environment, each with every so-many-th node."""
    return min(int(BLOCK_NODES) * most_shared(model), max(FEWEST_NODES, -(-NODES_AT_ONCE // model.num_envs)))


@wp.func
def begin_meeting(meeting: Meeting, e: int, substep: int):
    """The next substep will find its number zeroed; one thread of an environment does that."""
    meeting.count[e, (substep + 1) & 1] = 0


@wp.func_native("""
#if defined(__CUDA_ARCH__)
// one addition a warp: those to the same number come one after the other
const unsigned all = __ballot_sync(0xffffffffu, here);
if (all == 0u) return;
const int lane = threadIdx.x & 31, leader = __ffs(all) - 1;
int first = 0;
if (lane == leader) first = atomicAdd(&wp::index(meeting.count, e, substep & 1), __popc(all));
first = __shfl_sync(0xffffffffu, first, leader);
if (here) wp::index(meeting.node, e, first + __popc(all & ((1u << lane) - 1u))) = node;
#endif
""")
def note_meeting(meeting: Meeting, e: int, substep: int, node: int, here: bool):
    """List the nodes of those threads of a warp for which it is so ``here``; all of them come here."""
    ...


@wp.func
def nodes_meeting(meeting: Meeting, e: int, substep: int):
    """How many nodes are listed, when all have been."""
    return meeting.count[e, substep & 1]


@wp.func
def node_meeting(meeting: Meeting, e: int, n: int):
    """Block and place in it of the ``n``-th node, nonsense beyond: who asks need not know their number yet."""
    node = meeting.node[e, wp.min(n, meeting.node.shape[1] - 1)]
    return wp.vec2i(node // BLOCK_NODES, node % BLOCK_NODES)
