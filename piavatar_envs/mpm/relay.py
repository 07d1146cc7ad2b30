"""One launch a substep: G2P and the next substep's P2G together, and no grid pass.

For bodies of few particles a cell on a GPU, see :mod:`piavatar_envs.mpm.singles`, and for substeps between which
nothing else acts. Where there are several fields, their contact takes two short launches more, see
:mod:`piavatar_envs.mpm.relay_contact`. A launch is mostly waiting there: for what it reads, and for the last of its
threads. Who gathers makes velocities out of a node's sums himself, a few threads the same for several particles, and
what becomes of a particle stays in registers until it is scattered.

There are three sets of sums, in turns: a launch gathers what the last one has added up, adds to the next set, and
clears the one that the last launch has gathered.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp

from piavatar_envs.mpm.blocks import NOBODY, awaited_slot, mark_block, slots_used
from piavatar_envs.mpm.colliders import CONTACT_GATE, NEAR_PARTICLE, nearest_boundary
from piavatar_envs.mpm.gather import Gathered, begun, own_velocity, settled
from piavatar_envs.mpm.materials import kirchhoff_stress
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.relay_contact import meets_others, record_contact, record_meeting
from piavatar_envs.mpm.singles import (
    SHARE,
    TEAM,
    THREADS,
    add_single,
    any_of_team,
    block_of_thread,
    fits,
    record_singles,
)
from piavatar_envs.mpm.stencil import BLOCK_NODES, base_node, grid_position, in_same_brick, stencil_at
from piavatar_envs.mpm.sweep import LANES, lanes_of_warp
from piavatar_envs.mpm.team import (
    KINEMATIC_VELOCITY,
    MASS,
    SPIN,
    deformation_of_team,
    field_of,
    number_of_team,
    read_by_team,
    store_by_team,
    substance_of_team,
    units_of_team,
    vector_of_team,
)
from piavatar_envs.mpm.team_clear import clear_share, clear_slot
from piavatar_envs.mpm.team_gather import gather_by_team
from piavatar_envs.mpm.team_sense import sense_by_team
from piavatar_envs.mpm.threads import environment_of
from piavatar_envs.mpm.transfer import admitted, impulse_of_stress, placed, with_momentum
from piavatar_envs.mpm.turns import TURNS
from piavatar_envs.mpm.types import (
    NO_STRESS,
    SPLIT,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Model,
    Moving,
    Particles,
    Scratch,
    Sensors,
    State,
    Step,
    Sums,
)

# divisions and roots to two units in the last place, and logarithms to 4e-7, in a few instructions instead of calls
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

#: At most so many substeps between two marks of all blocks: each costs six launches. Blocks that a body leaves behind
#: keep their slots until then, so that a fast one needs more of them than where blocks are marked every eight substeps.
PORTION = 50


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


@wp.func
def come_to(
    grid: Grid, blocks: Blocks, e: int, f: int, x: wp.vec3, base: wp.vec3i, slot: int, failure: wp.array(dtype=int)
):
    """Slot of the block that a thread looks up of a particle that has come to ``x``, marked if that is another one.

    The particle is of field ``f``, its stencil was at ``base``, and the thread's slot ``slot``. Also, whether it had to
    be looked up. It is ``NOBODY`` where slots have run out, which may be so for some threads of a particle only.
    """
    to = base_node(grid_position(grid, x))
    comes = not in_same_brick(to, base)
    if comes:
        block = block_of_thread(grid, to)
        mark_block(grid, blocks, block, f, e, failure)
        slot = awaited_slot(blocks, e, f * grid.num_blocks + block, failure)
    return slot, comes


@wp.func
def momentum_of_team(grid: Grid, step: Step, read: wp.vec3, s: Gathered):
    """What a particle scatters, as :func:`piavatar_envs.mpm.transfer.prepare`, of what its threads have read."""
    made_of = substance_of_team(read)
    stress = wp.mat33()
    if step.decoupling != NO_STRESS:
        tau = kirchhoff_stress(made_of.material, s.F, made_of.mu, made_of.lam)
        stress = impulse_of_stress(grid, step, made_of.volume, tau)
    return with_momentum(grid, placed(grid, s.x), made_of.mass, s.u, wp.vec3(), s.C, stress)


@wp.func
def carry(
    several: bool,
    thread: int,
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    turn: Turn,
    per_env: int,
    others: wp.array2d(dtype=int),
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
    sums: Sums,
    sensors: Sensors,
):
    """What :func:`carry_on` and, if there are ``several`` fields, :func:`carry_fields_on` do."""
    at = environment_of(thread // TEAM, per_env)
    e = at[0]
    p = wp.min(at[1], moved.x.shape[1] - 1)
    takes = at[1] < moved.x.shape[1] and turn.stops[e] > turn.substep
    x = moved.x[e, p]  # all is asked for at once, before it is known who takes part
    field = field_of(several, particles, p)
    used = slots_used(blocks, e)
    mine = at[1] // SHARE
    told = bool(False)
    if turn.swept >= 0:
        told = sums.told[e, turn.swept + wp.min(mine, blocks.held.shape[1] - 1)] != 0
    read = read_by_team(particles, moved, sums, e, p, field)
    stencil = stencil_at(grid_position(grid, x))
    slot = blocks.slot[e, field * grid.num_blocks + block_of_thread(grid, stencil.base)]
    touched = bool(False)
    if several:
        touched = sensors.touched[e, slot] == turn.substep + 1
    distance = nearest_boundary(boundaries, e, x) * grid.inv_dx
    units = units_of_team(read)
    m = wp.where(takes, number_of_team(read, MASS), 0.0)
    physical, kinematic = gather_by_team(
        several, grid, step, boundaries, contact, sums, e, field, units, stencil, BLOCK_NODES * (turn.gathered + slot),
        distance, m, sensors,
    )  # fmt: skip
    if several:
        sense_by_team(particles, sensors, e, p, m, stencil, slot, touched)
    if turn.swept >= 0:  # not before: who reads waits for what has been written
        clear_share(sums, e, turn.swept, mine, used, per_env // SHARE, told)
    vk = vector_of_team(read, KINEMATIC_VELOCITY)
    s = begun(grid, physical, stencil.f)
    advection = s.u
    if step.decoupling == SPLIT or step.decoupling == NO_STRESS:
        advection += own_velocity(grid, boundaries, e, x, vk, kinematic, distance < CONTACT_GATE)
    s = settled(grid, step, s, x, advection, deformation_of_team(read), wp.mat33(), vector_of_team(read, SPIN))
    adds = takes and s.fault == 0
    comes = bool(False)
    if adds:
        store_by_team(moved, e, p, s)
        slot, comes = come_to(grid, blocks, e, field, s.x, stencil.base, slot, failure)
    elif takes:
        wp.atomic_or(failure, e, s.fault)
    tells = distance - wp.length(s.x - x) * grid.inv_dx < NEAR_PARTICLE
    if several:
        to = base_node(grid_position(grid, s.x))
        tells = meets_others(others, blocks.held.shape[1], e, turn.substep, wp.max(slot, 0), to) or tells
    momentum = momentum_of_team(grid, step, read, s)
    if several:
        tells = any_of_team(tells)
    if turn.scattered >= 0:
        homeless = any_of_team(slot == NOBODY)  # all threads of a particle add it up, or none
        adds = admitted(adds and not homeless, wp.isfinite(wp.length_sq(s.u) + wp.length_sq(vk)), e, failure)
        adds = fits(grid, particles, e, p, s.x, vk, adds, tells, momentum, units[1], failure)
    if takes and (comes or not adds) and wp.atomic_or(failure, e, 0) != 0:  # nobody fails without coming here
        wp.atomic_min(turn.stops, e, turn.substep + 1)
    if turn.scattered >= 0:  # comes last: what a thread reads after its additions waits for them
        record = BLOCK_NODES * (turn.scattered + wp.max(slot, 0))
        add_single(grid, step, particles, sums, e, p, s.x, vk, adds, tells, record, units, momentum)


@wp.kernel(launch_bounds=(THREADS, 4))
def carry_on(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    turn: Turn,
    per_env: int,
    # in and out; vk is read
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
    sums: Sums,
    sensors: Sensors,
):
    """Move every particle with the nodes of one set of sums, add it to another, clear a third.

    ``per_env`` particles fill whole warps; all are of one field.
    """
    carry(
        False, wp.tid(), grid, step, particles, boundaries, contact, turn, per_env, blocks.fields, blocks, moved,
        failure, sums, sensors,
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
    sums: Sums,
    sensors: Sensors,
):
    """As :func:`carry_on`, of several fields, which have been in contact.

    A particle tells its nodes where it is if there was another field at any of them before the launch: that does not
    depend on the order in which others of it come to theirs.
    """
    per_env = (moved.x.shape[1] + SHARE - 1) // SHARE * SHARE
    carry(
        True, wp.tid(), grid, step, particles, boundaries, contact, turn, per_env, others, blocks, moved, failure,
        sums, sensors,
    )  # fmt: skip


@wp.kernel
def begin_turns(failure: wp.array(dtype=int), stops: wp.array(dtype=int)):
    """Environments that have failed take no part."""
    e = wp.tid()
    stops[e] = wp.where(failure[e] != 0, 0, PORTION + 1)


@wp.kernel
def sweep_sums(blocks: Blocks, swept: int, slots: int, sums: Sums):
    """:func:`clear_slot` of all ``slots`` that an environment may have, a warp each."""
    at = environment_of(wp.tid() // lanes_of_warp(), slots)
    told = sums.told[at[0], swept + at[1]] != 0
    if at[1] < slots_used(blocks, at[0]):
        clear_slot(sums, at[0], swept + at[1], told)


def record_relay(
    program: Program, model: Model, state: State, scratch: Scratch, moving: Moving, inputs: list[Any], count: int
) -> None:
    """Append ``count`` substeps whose blocks have just been marked; ``inputs`` are those of :func:`record_singles`."""
    m, s, sums = model, state, scratch.turns
    stops = wp.zeros(m.num_envs, dtype=int, device=m.device)
    record_singles(program, inputs, s.x.shape, s.failure, sums)
    program.launch(begin_turns, m.num_envs, [s.failure], [stops])
    per_env = -(-m.num_particles // int(SHARE)) * int(SHARE)
    several = m.contact.num_fields > 1
    others = record_contact(program, m, scratch) if several else None
    for index in range(count):
        turn = Turn()
        turn.substep, turn.stops = index, stops
        turn.gathered, turn.scattered, turn.swept = (m.max_slots * ((index + n) % TURNS) for n in (0, 1, 2))
        if index == count - 1:
            turn.scattered = -1
        if index == 0:
            turn.swept = -1
        if several:
            record_meeting(program, m, scratch, others, stops, index, turn.gathered)
        program.launch(
            carry_fields_on if several else carry_on,
            m.num_envs * per_env * int(TEAM),
            [m.grid, m.step, m.particles, m.boundaries, m.contact, turn, others if several else per_env],
            [scratch.blocks, moving, s.failure, sums, scratch.sensors],
            block_dim=THREADS,
        )
    program.launch(
        sweep_sums,
        m.num_envs * m.max_slots * LANES,
        [scratch.blocks, turn.gathered, m.max_slots],
        [sums],
        block_dim=THREADS,
    )


def portions(count: int) -> list[int]:
    """``count`` substeps in as few equal parts as may be, none longer than ``PORTION``."""
    ends = np.linspace(0, count, -(-count // PORTION) + 1).round().astype(int)
    return [int(end - begin) for begin, end in pairwise(ends)]
