"""One MPM substep: scatter, solve, gather."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from piavatar_envs.mpm import runs
from piavatar_envs.mpm.ahead import Ahead, allocate_ahead, forget_ahead, grid_to_momenta, momenta_to_grid
from piavatar_envs.mpm.blocks import forget_blocks, free_slots, freeze, mark_particles
from piavatar_envs.mpm.colliders import move_colliders
from piavatar_envs.mpm.contact_pass import solve_contact
from piavatar_envs.mpm.gather import grid_to_particles
from piavatar_envs.mpm.grid import update_grid
from piavatar_envs.mpm.groups import record_groups, runs_to_grid
from piavatar_envs.mpm.impulses import clear_sensors, read_impulses
from piavatar_envs.mpm.normals import find_facing
from piavatar_envs.mpm.others import begin_others, notes_others
from piavatar_envs.mpm.parts import Part, has_groups, parts_of_world, whole_world
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.relay import portions, record_relay
from piavatar_envs.mpm.sensing import sense_contact, sense_penetration, senses_in_gather
from piavatar_envs.mpm.shared_substep import forget_speeds, record_in_block
from piavatar_envs.mpm.singles import record_singles
from piavatar_envs.mpm.sweep import THREADS, plan_sweep, slot_threads, slots_at_once
from piavatar_envs.mpm.transfer import particles_to_grid
from piavatar_envs.mpm.turns import has_turns
from piavatar_envs.mpm.types import Model, Moving, Scratch, State, group


def record_substep(program: Program, model: Model, state: State, scratch: Scratch, index: int) -> None:
    """Append substep ``index`` of a control step to ``program``.

    The physical velocity, position and deformation in ``state`` advance by ``model.step.dt`` under the kinematic
    velocity ``state.vk``; contact is added to the sensors.
    """
    m = model
    if index == 0 and m.scatter == "shared":
        program.launch(forget_speeds, scratch.room.speed.shape, [scratch.room])
    if index > 0 and index % m.marks_every == 0:
        _record_new_marks(program, model, state, scratch)
    record_scatter(program, model, state, scratch)
    _record_grid(program, model, state, scratch)
    if m.contact.num_fields > 1 or m.scatter != "shared":
        _record_gather(program, model, state, scratch)
    if m.moving_boundaries:
        program.launch(move_colliders, m.boundaries.position.shape, [m.step.dt], [m.boundaries])


def record_substeps(program: Program, model: Model, state: State, scratch: Scratch) -> None:
    """Append all substeps of a control step between which nothing acts, see :func:`record_substep`.

    Where that suits them, each is one launch, see :mod:`piavatar_envs.mpm.relay`, or what is gathered says what is
    scattered next, see :mod:`piavatar_envs.mpm.ahead`. An environment that fails meanwhile keeps the affine velocities
    that it had before.
    """
    if has_turns(model):
        _record_turns(program, model, state, scratch)
    elif has_groups(model) and not model.moving_boundaries:  # else who is near one is not known ahead
        _record_ahead(program, model, state, scratch)
    else:
        for index in range(model.num_substeps):
            record_substep(program, model, state, scratch, index)


def _record_turns(program: Program, model: Model, state: State, scratch: Scratch) -> None:
    """:func:`record_substeps` of one launch each."""
    # what is sensed once a step of several fields asks for the nodes' velocities of the last substep
    apart = int(model.contact.num_fields > 1)
    for index, count in enumerate(portions(model.num_substeps - apart)):
        if index > 0:
            _record_new_marks(program, model, state, scratch)
        record_relay(program, model, state, scratch, _moving(state), _scattering(model, state, scratch), count)
    if apart:
        record_substep(program, model, state, scratch, model.num_substeps - 1)


def _record_ahead(program: Program, model: Model, state: State, scratch: Scratch) -> None:
    """:func:`record_substeps` of gathers that find what is scattered next; the last one leaves the state.

    Parts of the world, see :mod:`piavatar_envs.mpm.parts`, go from gather to scatter by themselves, where all blocks
    have their marks.
    """
    if scratch.ahead is None:
        scratch.ahead = allocate_ahead(model)
    world, parts = (model, state, scratch), parts_of_world(model)

    def gather_and_scatter(part: Part, branch: Program) -> None:
        _record_gather(branch, *world, part, scratch.ahead)
        record_scatter(branch, *world, part, scratch.ahead)

    program.launch(forget_ahead, state.x.shape, [], [scratch.ahead])
    record_scatter(program, *world)
    for index in range(1, model.num_substeps):
        _record_grid(program, *world)
        if index % model.marks_every != 0:
            program.fork_each(parts, gather_and_scatter)
            continue
        _record_gather(program, *world, ahead=scratch.ahead)
        _record_new_marks(program, *world)
        record_scatter(program, *world, ahead=scratch.ahead)
    _record_grid(program, *world)
    _record_gather(program, *world)


def _record_gather(
    program: Program,
    model: Model,
    state: State,
    scratch: Scratch,
    part: Part | None = None,
    ahead: Ahead | None = None,
) -> None:
    """Append the transfer of nodes to particles, of a ``part`` or of all, and what their contact sensors feel.

    What is scattered next is left ``ahead``, if given, instead of the affine velocity in the state.
    """
    m, s = model, state
    inputs = [m.grid, m.step, m.particles, m.boundaries, scratch.velocity]
    moved = [scratch.blocks, _moving(s)]
    if m.scatter == "plain":
        program.launch(grid_to_particles, s.x.shape, inputs, [*moved, s.failure], block_dim=runs.THREADS)
        return
    those = (part or whole_world(m)).particles
    inputs += [int(senses_in_gather(m)), those]
    kernel = runs.grid_to_particles
    if ahead is not None:
        kernel = grid_to_momenta
        moved.append(ahead)
    outputs = [*moved, s.failure, scratch.sensors]
    program.launch(kernel, m.num_envs * those[1], inputs, outputs, block_dim=runs.THREADS)


def _record_grid(program: Program, model: Model, state: State, scratch: Scratch) -> None:
    """Append the grid pass, and what the contact sensors feel.

    Blocks with several fields are few, and what contact does there mostly waits: the others go on beside it.
    """
    m = model
    contact, beside = Program(program.device), Program(program.device)
    if m.contact.num_fields > 1:
        _record_contact(contact, model, state, scratch)
    if m.scatter != "shared":  # else that pass has been made in shared memory
        slots = slots_at_once(m)
        beside.launch(
            update_grid,
            m.num_envs * slots * slot_threads(m),
            [m.grid, m.step, m.boundaries, m.contact, slots, state.failure],
            [scratch.blocks, scratch.sums, scratch.velocity, scratch.sensors],
            block_dim=THREADS,
        )
    program.fork(contact, beside)
    if m.contact.num_fields > 1 and m.num_sensors > 0 and not senses_in_gather(m):
        program.launch(
            sense_contact,
            state.x.shape,
            [m.grid, m.particles, state.x, scratch.blocks, state.failure],
            [scratch.sensors],
            block_dim=THREADS,
        )


def _record_contact(program: Program, model: Model, state: State, scratch: Scratch) -> None:
    """Append the pass over the blocks with several fields."""
    m, blocks, sums = model, scratch.blocks, scratch.sums
    sweep = plan_sweep(m)
    program.launch(
        find_facing,
        m.num_envs * sweep.threads,
        [m.grid, m.contact, sweep, blocks, state.failure],
        [sums, scratch.velocity, scratch.facing, scratch.sensors],
        block_dim=THREADS,
    )
    program.launch(
        solve_contact,
        m.num_envs * sweep.threads,
        [m.grid, m.step, m.boundaries, m.contact, sweep, blocks, state.failure, scratch.facing],
        [sums, scratch.velocity, scratch.sensors],
        block_dim=THREADS,
    )


def record_scatter(
    program: Program,
    model: Model,
    state: State,
    scratch: Scratch,
    part: Part | None = None,
    ahead: Ahead | None = None,
) -> None:
    """Append the transfer of particles to nodes, in the way of ``model.scatter``; if shared, what goes with it.

    Of all particles, or of a ``part`` of those that groups scatter; of these, from what a gather has left in
    ``ahead``, if given.
    """
    m, s = model, state
    if m.scatter == "shared":
        record_in_block(program, model, state, scratch, _moving(s))
        return
    inputs = _scattering(m, s, scratch)
    if m.scatter == "plain":
        program.launch(particles_to_grid, s.x.shape, inputs, [s.failure, scratch.sums])
    elif m.scatter in ("singles", "singles_float"):
        record_singles(program, inputs, s.x.shape, s.failure, scratch.sums)
    else:
        outputs = [s.failure, scratch.sums]
        part = part or whole_world(m)
        if ahead is None:
            record_groups(program, runs_to_grid, m, part, inputs, outputs)
        else:
            inputs = [m.grid, m.step, m.particles, m.contact, _moving(s), scratch.blocks, ahead]
            record_groups(program, momenta_to_grid, m, part, inputs, outputs)


def _scattering(m: Model, s: State, scratch: Scratch) -> list[Any]:
    return [m.grid, m.step, m.particles, m.boundaries, m.contact, _moving(s), scratch.blocks]


def _moving(s: State) -> Moving:
    return group(Moving, x=s.x, u=s.u, C=s.C, F=s.F, vk=s.vk, spin=s.spin)


def record_begin(
    program: Program, model: Model, state: State, scratch: Scratch, beside: Sequence[Program] = ()
) -> None:
    """Append what comes before the first substep of a control step: sensors forget, blocks with matter are marked.

    What goes on ``beside`` that has to do with neither sensors nor blocks, moves no particles, and does not ask which
    environments have failed: marks find that out.
    """
    sensors, marks = Program(program.device), Program(program.device)
    sensors.launch(clear_sensors, model.num_envs, [], [scratch.sensors])
    record_marks(marks, model, state, scratch)
    program.fork(sensors, marks, *beside)


def record_marks(program: Program, model: Model, state: State, scratch: Scratch) -> None:
    """Append: give slots to the blocks of all particles; the gather of every substep adds those that it comes to.

    What has been is forgotten first: a reset may have put the particles elsewhere, and a block that is marked for
    nothing costs time and, in its rounding, the equality of runs.
    """
    _record_new_marks(program, model, state, scratch)
    program.launch(freeze, model.num_envs, [state.failure], [scratch.blocks])


def _record_new_marks(program: Program, model: Model, state: State, scratch: Scratch) -> None:
    """:func:`record_marks` where no environment can fail by them: only gathers have moved particles since the last."""
    m, blocks = model, scratch.blocks
    program.launch(forget_blocks, (m.num_envs, m.max_slots), [m.grid], [blocks])
    program.launch(free_slots, m.num_envs, [state.failure], [blocks])
    program.launch(mark_particles, state.x.shape, [m.grid, m.particles, state.x], [blocks, state.failure])
    if notes_others(m):
        program.launch(begin_others, (m.num_envs, m.max_slots), [], [blocks])


def record_end(program: Program, model: Model, state: State, scratch: Scratch, beside: Sequence[Program] = ()) -> None:
    """Append what comes after the last substep of a control step: what is sensed once a step.

    What goes on ``beside`` that has to do with no sensors, moves no particles, and lets no environment fail.
    """
    m, impulses, depths = model, Program(program.device), Program(program.device)
    entries = scratch.sensors.sums.shape[1] // 3
    impulses.launch(read_impulses, (m.num_envs, entries), [], [scratch.sensors])
    if m.contact.num_subjects > 1:
        depths.launch(
            sense_penetration,
            state.x.shape,
            [m.grid, m.particles, m.contact, state.x, scratch.blocks, scratch.velocity, state.failure],
            [scratch.sensors.penetration],
        )
    program.fork(impulses, depths, *beside)
