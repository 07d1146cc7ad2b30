"""Retention of the short waves that APIC filters, where substeps are more than the softest matter needs.

Let ``z = (u, C)`` be the velocities of all particles, ``W`` the interpolation of G2P, and ``W*`` that of P2G, which is
its adjoint with the masses as weights. A substep of APIC is ``z' = W (W* z + a)``, with the change ``a`` of the nodes'
velocities by stress, gravity and contact. ``W W*`` filters short waves, once a substep: twice the substeps damp twice
as much per second. Here particles retain a share ``s`` of what is filtered from them, as in the blend of FLIP and PIC
(Zhu & Bridson, "Animating Sand as a Fluid", 2005), of the affine velocity as well::

    z' = W (W* z + a) + s (z - W W* z)

Of a wave of which ``W W*`` keeps ``m``, a substep then keeps ``s + (1 - s) m``. The share ``s`` is such that the
shortest wave of the grid is damped as much per second as by the reference number of substeps, at which it is 0.

- *Momentum*, linear and angular, of ``z`` and ``W W* z`` is that of ``W* z``: what is retained has none. Positions
  advance with ``z'``, so that their moment of momentum does not change either.
- *Energy*: ``W* W <= 1`` in the norm of kinetic energy, since masses are lumped. With ``v = W* z``, ``w = v + a`` and
  ``A = 1 - W* W`` the energy (twice) was ``|z - W v|^2 + |v|^2 + <A v, v>``, and becomes ``s^2 |z - W v|^2 + |w|^2 +
  2 s <A v, w> - <A w, w>``, which is at most ``s^2 |z - W v|^2 + |w|^2 + s^2 <A v, v>``. So a substep in which contact
  takes energy from the nodes takes it from the particles, whatever they retain.
- ``F`` follows the gradient at the nodes, ``C`` before the retained part is added: what the nodes do not see must not
  strain matter.

``W* z`` is the velocity of the nodes before ``a``. P2G adds the impulse of stress to the same sums, so it runs a second
time, without stress and boundaries. Nothing here is recorded, and no other kernel differs, where nothing is retained.
"""

from __future__ import annotations

import math

import warp as wp

from piavatar_envs.core.arrays import matrix_at, store_matrix
from piavatar_envs.core.cuda_intrinsics import environment_of, lane_of_thread, lanes_of_warp
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.bspline import (
    BLOCK_NODES,
    base_node,
    grid_position,
    in_same_subblock,
    stencil_at,
    stencil_inside,
)
from piavatar_envs.mpm.g2p import Gradients, sum_lines, velocity_of
from piavatar_envs.mpm.grid_arrays import (
    clear_offset,
    finish_take,
    first_of_halves,
    load_accumulator,
    quanta_of,
    read_record,
    write_physical,
)
from piavatar_envs.mpm.grid_update import nodes_of_lane, physical_velocity, threads_per_active_block, total_velocity
from piavatar_envs.mpm.p2g import lines_of
from piavatar_envs.mpm.sparse_grid import HALVES, THREADS, activate_stencil, field_and_block, num_active
from piavatar_envs.mpm.types import (
    Accumulators,
    Blocks,
    Grid,
    Model,
    Moving,
    Particles,
    Retained,
    Scratch,
    State,
    Step,
)

wp.set_module_options({"enable_backward": False})

#: Share that a substep of APIC keeps of a wave two grid spacings long, ``N^2 + 4 N'^2`` with the transform
#: ``N = (sin(k/2) / (k/2))^3`` of the quadratic spline at ``k = pi`` per grid spacing.
SHORTEST_KEPT = 64.0 / math.pi**6 + 4.0 * 576.0 / math.pi**8


def retained_share(times: float) -> float:
    """Return the share ``s`` for ``times`` as many substeps as the reference, at least 1.

    It solves ``(s + (1 - s) m)^times = m`` with ``m`` = :data:`SHORTEST_KEPT`.
    """
    return 1.0 - (1.0 - SHORTEST_KEPT ** (1.0 / times)) / (1.0 - SHORTEST_KEPT)


@wp.kernel
def write_free_velocities(
    grid: Grid,
    step: Step,
    active_blocks: int,
    blocks: Blocks,
    # in and out: sums are read, then cleared
    accumulators: Accumulators,
    # out
    node_velocity: wp.array2d(dtype=wp.vec4),
):
    """Write the physical velocity of every node from sums without stress; a warp has an active block.

    ``step`` has no gravity. Contact candidates add offsets and kinematic momentum to the blocks that they flag.
    """
    at = environment_of(wp.tid(), active_blocks * lanes_of_warp())
    e = at[0]
    active = at[1] // lanes_of_warp()
    if active >= num_active(blocks, e):
        return
    quanta = quanta_of(accumulators, e, field_and_block(grid, blocks.owner[e, active])[0])
    driven = accumulators.candidates[e, active] != 0
    for n in range(nodes_of_lane()):
        r = BLOCK_NODES * active + lane_of_thread() + n * lanes_of_warp()
        loaded = load_accumulator(accumulators, e, r)
        total = total_velocity(step, False, finish_take(accumulators, e, quanta, r, loaded, driven))
        write_physical(node_velocity, e, r, physical_velocity(False, total))
        if driven:
            clear_offset(accumulators, e, r)


@wp.kernel
def finish_free_velocities(
    grid: Grid,
    step: Step,
    active_blocks: int,
    blocks: Blocks,
    # in and out: offsets are cleared
    accumulators: Accumulators,
    node_velocity: wp.array2d(dtype=wp.vec4),
):
    """Replace sums by velocities in contact blocks, where the path ``"block"`` leaves sums; a warp has a block."""
    at = environment_of(wp.tid(), active_blocks * lanes_of_warp())
    e = at[0]
    active = at[1] // lanes_of_warp()
    if active >= num_active(blocks, e):
        return
    owner = field_and_block(grid, blocks.owner[e, active])
    if blocks.fields[e, owner[1]] == (1 << owner[0]):
        return
    for n in range(nodes_of_lane()):
        r = BLOCK_NODES * active + lane_of_thread() + n * lanes_of_warp()
        total = total_velocity(step, False, read_record(node_velocity, e, r))
        write_physical(node_velocity, e, r, physical_velocity(False, total))
        clear_offset(accumulators, e, r)


@wp.kernel
def store_retained(
    grid: Grid,
    particles: Particles,
    node_velocity: wp.array2d(dtype=wp.vec4),
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
    # out
    retained: Retained,
):
    """Store the share that every particle retains of the difference between its velocity and the nodes'."""
    e, p = wp.tid()
    share = retained.share[p]
    if failure[e] != 0 or share == 0.0:
        return
    stencil = stencil_at(grid_position(grid, moved.x[e, p]))
    lines = lines_of(grid, blocks, e, particles.field[p], stencil, HALVES)
    sums = sum_lines(first_of_halves(node_velocity, e), lines)
    filtered = velocity_of(grid, Gradients(sums[0], sums[1], sums[2], sums[3]), stencil.f)
    retained.u[e, p] = share * (moved.u[e, p] - filtered.u)
    store_matrix(retained.C, e, p, share * (matrix_at(moved.C, e, p) - filtered.C))


@wp.kernel
def add_retained(
    grid: Grid,
    step: Step,
    particles: Particles,
    retained: Retained,
    # in and out
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
):
    """Add what every particle retains to its velocity, and move it accordingly; activates the blocks that it enters."""
    e, p = wp.tid()
    if failure[e] != 0 or retained.share[p] == 0.0:
        return
    u = retained.u[e, p]
    moved.u[e, p] = moved.u[e, p] + u
    store_matrix(moved.C, e, p, matrix_at(moved.C, e, p) + matrix_at(retained.C, e, p))
    x = moved.x[e, p]
    base = base_node(grid_position(grid, x))
    x = x + step.dt * u
    to = base_node(grid_position(grid, x))
    if stencil_inside(grid, to):
        moved.x[e, p] = x
        if not in_same_subblock(to, base):
            activate_stencil(grid, blocks, to, particles.field[p], e, failure)


def record_free_velocities(graph: LaunchGraph, model: Model, scratch: Scratch) -> None:
    """Append the velocities of the nodes from the sums of P2G, for a ``model`` without forces."""
    m, on_block_path = model, model.path == "block"
    if on_block_path and m.contact.num_fields == 1:
        return
    graph.launch(
        finish_free_velocities if on_block_path else write_free_velocities,
        m.num_envs * m.max_active_blocks * threads_per_active_block(m),
        [m.grid, m.step, m.max_active_blocks, scratch.blocks],
        [scratch.accumulators, scratch.velocity],
        block_dim=THREADS,
    )


def record_store(graph: LaunchGraph, model: Model, state: State, scratch: Scratch, moving: Moving) -> None:
    """Append the storing of what particles retain, from the nodes' velocities of :func:`record_free_velocities`."""
    inputs = [model.grid, model.particles, scratch.velocity, scratch.blocks, moving, state.failure]
    graph.launch(store_retained, state.x.shape, inputs, [scratch.retained], block_dim=THREADS)


def record_add(graph: LaunchGraph, model: Model, state: State, scratch: Scratch, moving: Moving) -> None:
    """Append the addition of what particles retain, after G2P."""
    inputs = [model.grid, model.step, model.particles, scratch.retained]
    graph.launch(add_retained, state.x.shape, inputs, [scratch.blocks, moving, state.failure], block_dim=THREADS)
