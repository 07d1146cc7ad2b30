"""One launch a substep: what becomes of a particle, from one scatter to the next; see :mod:`piavatar_envs.mpm.relay`.

Who gathers makes velocities out of a node's sums himself, a few threads the same for several particles, and what
becomes of a particle stays in registers until it is scattered.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.blocks import NOBODY, awaited_slot, mark_block, slots_used
from piavatar_envs.mpm.colliders import CONTACT_GATE, NEAR_PARTICLE, nearest_boundary
from piavatar_envs.mpm.counts import MOST_MASS, Counts
from piavatar_envs.mpm.gather import Gathered, Gradients, begun, own_velocity, settled
from piavatar_envs.mpm.materials import kirchhoff_stress
from piavatar_envs.mpm.measures import pass_speeds, speeds_of_launch, unit_of_mass, units_at
from piavatar_envs.mpm.ranks import PART
from piavatar_envs.mpm.singles import (
    TEAM,
    THREADS,
    any_of_team,
    block_of_thread,
    slots_of_thread,
)
from piavatar_envs.mpm.stencil import BLOCK_NODES, base_node, grid_position, in_same_brick, stencil_at
from piavatar_envs.mpm.sweep import LANES
from piavatar_envs.mpm.team import (
    HEAVIEST,
    KINEMATIC_VELOCITY,
    MASS,
    SPIN,
    deformation_of_team,
    field_of,
    number_of_team,
    read_by_team,
    store_by_team,
    substance_of_team,
    vec6,
    vector_of_team,
)
from piavatar_envs.mpm.team_clear import clear_share, told_in_slot
from piavatar_envs.mpm.team_count import count_single, most_of
from piavatar_envs.mpm.team_gather import gather_by_team
from piavatar_envs.mpm.team_others import meets_others
from piavatar_envs.mpm.team_sense import sense_by_team, slots_touched
from piavatar_envs.mpm.threads import environment_of
from piavatar_envs.mpm.transfer import admitted, affine_momentum, impulse_of_stress, placed, with_momentum
from piavatar_envs.mpm.types import (
    FAILURE_CFL,
    NO_STRESS,
    SPLIT,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Moving,
    Particles,
    Sensors,
    Step,
)

# divisions and roots to two units in the last place, and logarithms to 4e-7, in a few instructions instead of calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

_CFL = wp.constant(FAILURE_CFL)
#: Threads of a particle where there are several fields. Much is the same for all of them, so half as many do less.
TEAM_OF_FIELDS = wp.constant(4)


@wp.struct
class Turn:
    """Which sums a launch has to do with, by the first of their slots."""

    substep: int  # since blocks were marked
    gathered: int
    scattered: int  # -1 if nothing is scattered
    swept: int  # -1 if there is nothing to clear
    # (num_envs,) the first substep in which an environment takes no part: what threads of a launch find out must not
    # stop others of it, or what a failed environment is left with would depend on their order
    stops: wp.array(dtype=int)
    order: wp.array2d(dtype=int)  # (num_envs, parts) see :mod:`piavatar_envs.mpm.ranks`


@wp.func
def particle_of_thread(team: int, thread: int, order: wp.array2d(dtype=int)):
    """Environment and place of the particle that a thread is for; there may be none any more."""
    at = environment_of(thread // (PART * team), order.shape[1])
    return wp.vec2i(at[0], PART * order[at[0], at[1]] + thread % (PART * team) // team)


@wp.func
def slot_marked(
    team: int, grid: Grid, blocks: Blocks, e: int, f: int, base: wp.vec3i, n: int, failure: wp.array(dtype=int)
):
    """Slot of the ``n``-th block that a thread looks up, which is marked; ``NOBODY`` where slots have run out."""
    block = block_of_thread(team, grid, base, n)
    mark_block(grid, blocks, block, f, e, failure)
    return awaited_slot(blocks, e, f * grid.num_blocks + block, failure)


@wp.func
def come_to(
    team: int,
    grid: Grid,
    blocks: Blocks,
    e: int,
    f: int,
    x: wp.vec3,
    base: wp.vec3i,
    slot: wp.vec2i,
    failure: wp.array(dtype=int),
):
    """Slots of the blocks that a thread looks up of a particle that has come to ``x``, marked if those are other ones.

    The particle is of field ``f``, its stencil was at ``base``, and the thread's slots ``slot``. Also, whether they had
    to be looked up. They are ``NOBODY`` where slots have run out, maybe for some threads of a particle only.
    """
    to = base_node(grid_position(grid, x))
    comes = not in_same_brick(to, base)
    if comes:
        slot[0] = slot_marked(team, grid, blocks, e, f, to, 0, failure)
        if team == 4:
            slot[1] = slot_marked(team, grid, blocks, e, f, to, 1, failure)
    # changes nothing, but sees to it that the threads of a warp meet here: or a compiler lets those that had to wait do
    # all that follows after the others, and one skin takes a tenth more time a substep
    return wp.max(slot, wp.vec2i(NOBODY)), comes


@wp.func
def settled_by_team(
    team: int,
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    e: int,
    x: wp.vec3,
    read: vec6,
    vk: wp.vec3,
    physical: Gradients,
    kinematic: Gradients,
    f: wp.vec3,
    asked: bool,
):
    """What a particle becomes, as :func:`piavatar_envs.mpm.gather.gather`, of what its threads have found and read.

    ``f`` is its place in its stencil, ``asked`` as for :func:`piavatar_envs.mpm.gather.own_velocity`.
    """
    s = begun(grid, physical, f)
    advection = s.u
    if step.decoupling == SPLIT or step.decoupling == NO_STRESS:
        advection += own_velocity(grid, boundaries, e, x, vk, kinematic, asked)
    return settled(
        grid, step, s, x, advection, deformation_of_team(team, read), wp.mat33(), vector_of_team(team, read, SPIN)
    )


@wp.func
def momentum_of_team(team: int, grid: Grid, step: Step, read: vec6, s: Gathered):
    """What a particle scatters, as :func:`piavatar_envs.mpm.transfer.prepare`, of what its threads have read."""
    made_of = substance_of_team(team, read)
    stress = wp.mat33()
    if step.decoupling != NO_STRESS:
        tau = kirchhoff_stress(made_of.material, s.F, made_of.mu, made_of.lam)
        stress = impulse_of_stress(grid, step, made_of.volume, tau)
    A = affine_momentum(grid, made_of.mass, s.C, stress)
    return with_momentum(placed(grid, s.x), made_of.mass, s.u, wp.vec3(), A)


@wp.func
def records_of(first: int, slots: wp.vec2i):
    """The first records of a thread's ``slots`` in the set of sums whose ``first`` slot this is."""
    return wp.vec2i(BLOCK_NODES * (first + slots[0]), BLOCK_NODES * (first + slots[1]))


@wp.func
def carry(
    team: int,
    several: bool,
    thread: int,
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    turn: Turn,
    others: wp.array2d(dtype=int),
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
    counts: Counts,
    sensors: Sensors,
):
    """What :func:`carry_on` and, if there are ``several`` fields, :func:`carry_fields_on` do, by a ``team`` each."""
    at = particle_of_thread(team, thread, turn.order)
    e = at[0]
    p = wp.min(at[1], moved.x.shape[1] - 1)
    takes = at[1] < moved.x.shape[1] and turn.stops[e] > turn.substep
    x = moved.x[e, p]  # all is asked for at once, before it is known who takes part
    field = field_of(several, particles, p)
    used = slots_used(blocks, e)
    mine = at[1] * team // LANES  # a warp's number
    told = told_in_slot(several, counts, e, turn.swept, wp.min(mine, blocks.held.shape[1] - 1))
    speeds = speeds_of_launch(counts, e, turn.substep)
    read = read_by_team(team, particles, moved, counts, e, p, field)
    stencil = stencil_at(grid_position(grid, x))
    slot = slots_of_thread(team, grid, blocks, e, field, stencil.base)
    touched = slots_touched(several, sensors, e, slot, turn.substep + 1)
    distance = nearest_boundary(boundaries, e, x) * grid.inv_dx
    unit = unit_of_mass(number_of_team(team, read, HEAVIEST))
    m = wp.where(takes, number_of_team(team, read, MASS), 0.0)
    physical, kinematic, crowd = gather_by_team(
        team, several, grid, step, boundaries, contact, counts, e, field, units_at(unit, speeds.gathered), stencil,
        records_of(turn.gathered, slot), distance, m, sensors,
    )  # fmt: skip
    if several:
        sense_by_team(team, particles, sensors, e, p, m, stencil, slot, touched)
    if not several and turn.swept >= 0:  # not before: who reads waits for what has been written
        clear_share(counts, e, turn.swept, mine, used, PART * team // LANES * turn.order.shape[1], told)
    vk = vector_of_team(team, read, KINEMATIC_VELOCITY)
    s = settled_by_team(
        team, grid, step, boundaries, e, x, read, vk, physical, kinematic, stencil.f, distance < CONTACT_GATE
    )  # fmt: skip
    fault = s.fault | wp.where(any_of_team(team, crowd > wp.uint32(MOST_MASS)), _CFL, 0)
    adds = takes and fault == 0
    comes = bool(False)
    if adds:
        store_by_team(team, moved, e, p, s)
        slot, comes = come_to(team, grid, blocks, e, field, s.x, stencil.base, slot, failure)
    elif takes:
        wp.atomic_or(failure, e, fault)
    tells = distance - wp.length(s.x - x) * grid.inv_dx < NEAR_PARTICLE
    if several:
        to = base_node(grid_position(grid, s.x))
        tells = meets_others(team, others, e, wp.max(slot, wp.vec2i()), to) or tells
    momentum = momentum_of_team(team, grid, step, read, s)
    if several:
        tells = any_of_team(team, tells)
    if turn.scattered >= 0:
        homeless = any_of_team(team, wp.min(slot[0], slot[1]) == NOBODY)  # all threads of a particle add it up, or none
        adds = admitted(adds and not homeless, wp.isfinite(wp.length_sq(s.u) + wp.length_sq(vk)), e, failure)
        most = most_of(momentum, m, vk)
        adds = pass_speeds(counts, e, turn.substep, speeds, at[1] == 0, adds, most, m, unit, failure)
    if takes and (comes or not adds) and wp.atomic_or(failure, e, 0) != 0:  # nobody fails without coming here
        wp.atomic_min(turn.stops, e, turn.substep + 1)
    if turn.scattered >= 0:  # comes last: what a thread reads after its additions waits for them
        record = records_of(turn.scattered, wp.max(slot, wp.vec2i()))
        units = units_at(unit, speeds.added)
        count_single(team, grid, particles, counts, e, p, s.x, vk, adds, tells, record, units, momentum)


@wp.kernel(launch_bounds=(THREADS, 4))
def carry_on(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    turn: Turn,
    # in and out; vk is read
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
    counts: Counts,
    sensors: Sensors,
):
    """Move every particle, all of one field, with the nodes of one set of sums, add it to another, clear a third."""
    carry(
        TEAM, False, wp.tid(), grid, step, particles, boundaries, contact, turn, blocks.fields, blocks, moved, failure,
        counts, sensors,
    )  # fmt: skip


@wp.kernel(launch_bounds=(THREADS, 4))
def carry_fields_on(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    turn: Turn,
    others: wp.array2d(dtype=int),
    # in and out; vk is read
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
    counts: Counts,
    sensors: Sensors,
):
    """As :func:`carry_on`, of several fields, which have been in contact.

    A particle tells its nodes where it is if there was another field at any of them before the launch: that does not
    depend on the order in which others of it come to theirs.
    """
    carry(
        TEAM_OF_FIELDS, True, wp.tid(), grid, step, particles, boundaries, contact, turn, others, blocks, moved,
        failure, counts, sensors,
    )  # fmt: skip
