"""Nodes at which fields may touch, listed a substep before: see :mod:`piavatar_envs.mpm.relay_contact`.

Of the nodes of blocks with several fields a tenth have matter of two. A warp has each of those then; if a thread had
one, most warps would go a long way for one or two. In which order they are listed is not determined, and nothing but
who sees to them depends on it.

The list of the next substep is written while that of this one is read, so there are two in turns. Of their lengths
there are three: one is read, one counts, and one is zeroed for the substep after that.
"""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from piavatar_envs.mpm.stencil import BLOCK_NODES
from piavatar_envs.mpm.sweep import most_shared
from piavatar_envs.mpm.types import Model, Scratch, group

wp.set_module_options({"enable_backward": False})

#: Nodes for which warps are launched at once where there are few environments: a large GPU has hardly room for more.
#: And the fewest for which an environment gets them.
NODES_AT_ONCE, FEWEST_NODES = 132 * 16, 4
#: Slots for which warps are launched at once that clear what is not needed any longer, and the fewest as well.
CLEARED_AT_ONCE, FEWEST_CLEARED = 132 * 16, 4
#: Lists, and their lengths.
LISTS, LENGTHS = wp.constant(2), wp.constant(3)


@wp.struct
class Meeting:
    """The lists of every environment."""

    node: wp.array2d(dtype=int)  # (num_envs, LISTS * most) 64 block + place in the block
    count: wp.array2d(dtype=int)  # (num_envs, LENGTHS)


@wp.struct
class Encounter:
    """A substep of contact."""

    substep: int  # since blocks were marked; -1 before the first
    gathered: int  # the first slot of the set of sums that it is about
    warps: int  # of an environment that see to nodes where fields may touch
    swept: int  # the first slot of a set of sums that nobody needs any longer
    clearing: int  # warps of an environment that clear it
    stops: wp.array(dtype=int)  # (num_envs,) the first substep in which an environment takes no part


def begin_lists(model: Model) -> Meeting:
    """Lists with room for all nodes of all blocks that have several fields."""
    n = model.num_envs
    most = int(BLOCK_NODES) * most_shared(model)
    node, count = (wp.zeros((n, size), dtype=int, device=model.device) for size in (LISTS * most, int(LENGTHS)))
    return group(Meeting, node=node, count=count)


@dataclass(frozen=True)
class Meetings:
    """What contact keeps from one substep to the next.

    Attributes:
        lists: where fields may touch.
        others: which nodes have several fields, two words a slot, see :mod:`piavatar_envs.mpm.others`, of even substeps
            since blocks were marked and of odd ones.
    """

    lists: Meeting
    others: tuple[wp.array, wp.array]


def meetings_of(model: Model, scratch: Scratch) -> Meetings:
    """Those of a world, allocated when they are first asked for."""
    if scratch.meetings is None:
        n, device = model.num_envs, model.device
        even, odd = (wp.zeros((n, 2 * model.max_slots), dtype=int, device=device) for _ in range(2))
        scratch.meetings = Meetings(begin_lists(model), (even, odd))
    return scratch.meetings


def warps_of_meeting(model: Model) -> int:
    """Warps of an environment, each with every so-many-th node."""
    return min(int(BLOCK_NODES) * most_shared(model), max(FEWEST_NODES, -(-NODES_AT_ONCE // model.num_envs)))


def warps_that_clear(model: Model) -> int:
    """Warps of an environment, each with every so-many-th slot."""
    return min(model.max_slots, max(FEWEST_CLEARED, -(-CLEARED_AT_ONCE // model.num_envs)))


@wp.func
def begin_meeting(meeting: Meeting, e: int, substep: int):
    """Who lists in the next substep finds nothing counted; one thread of an environment sees to that in each."""
    meeting.count[e, (substep + 2) % LENGTHS] = 0


@wp.func_native("""
#if defined(__CUDA_ARCH__)
// one addition a warp: those to the same number come one after the other
const unsigned all = __ballot_sync(0xffffffffu, here);
if (all == 0u) return;
const int lane = threadIdx.x & 31, leader = __ffs(all) - 1, next = substep + 1;
const int begin = (next & 1) * (meeting.node.shape[1] / 2);
int first = 0;
if (lane == leader) first = atomicAdd(&wp::index(meeting.count, e, next % 3), __popc(all));
first = begin + __shfl_sync(0xffffffffu, first, leader);
if (here) wp::index(meeting.node, e, first + __popc(all & ((1u << lane) - 1u))) = node;
#endif
""")
def note_meeting(meeting: Meeting, e: int, substep: int, node: int, here: bool):
    """List, for the substep after this one, the nodes of those threads of a warp for which it is so ``here``.

    All threads of the warp come here. The substep before the first is -1.
    """
    ...


@wp.func
def nodes_meeting(meeting: Meeting, e: int, substep: int):
    """How many nodes were listed for a substep."""
    return meeting.count[e, substep % LENGTHS]


@wp.func
def node_meeting(meeting: Meeting, e: int, substep: int, n: int):
    """Block and place in it of the ``n``-th node, nonsense beyond: who asks need not know their number yet."""
    most = meeting.node.shape[1] // LISTS
    node = meeting.node[e, (substep & 1) * most + wp.min(n, most - 1)]
    return wp.vec2i(node // BLOCK_NODES, node % BLOCK_NODES)
