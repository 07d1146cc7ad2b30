"""Contact sensors: impulses by subject, pair and body part over a control step, penetration depths, limited motion.

Impulses are accumulated in fixed point, so that the sum does not depend on their order. The entries of an environment:
colliders on every subject, every pair of subjects, every subject on every row of the contact sensor, and moments of the
colliders' impulses.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.arrays import read_vec4
from piavatar_envs.mpm.bspline import (
    BLOCK_NODES,
    base_node,
    block_index,
    grid_position,
    stencil_at,
    stencil_inside,
)
from piavatar_envs.mpm.grid_arrays import mass_of
from piavatar_envs.mpm.sparse_grid import (
    THREADS,
    VECTORS,
    candidate_bits,
    fields_around,
    first_record,
    has_field,
    line_of_records,
    record_of,
    slab_records,
)
from piavatar_envs.mpm.types import (
    FAILURE_CFL,
    FAILURE_OUT_OF_GRID,
    NEAR_FIELD,
    Blocks,
    Contact,
    Grid,
    Model,
    Particles,
    Sensors,
    row,
)

# an unrolled stencil needs so many registers that a GPU runs few threads at once
wp.set_module_options({"enable_backward": False, "max_unroll": 0})

#: Quanta of a newton second: sums resolve 1e-12 N s and reach 8e6 N s.
QUANTA_PER_NEWTON_SECOND = wp.constant(float(2**40))
#: Limits of a particle's motion: to a grid spacing a substep, to the grid, and of its stretch.
SLOWED, HELD, STRETCHED = wp.constant(1), wp.constant(2), wp.constant(3)
#: Quanta of the share of the mass that was limited in a substep.
QUANTA_OF_LIMITED = wp.constant(float(2**40))
#: Share of an environment's mass, on average over the substeps of a control step, that may be limited.
LIMITED_SHARE = 0.05
_LIMITED_SHARE = wp.constant(LIMITED_SHARE)
_CFL = wp.constant(FAILURE_CFL)
_OUT_OF_GRID = wp.constant(FAILURE_OUT_OF_GRID)
#: Volume fraction of another subject at which a particle lies on its surface.
SURFACE = wp.constant(0.5)
#: Slope of the volume fraction at a flat surface times the grid spacing: a step seen through the spline twice has the
#: slope of the integral of its square, 11/20.
SURFACE_SLOPE = wp.constant(0.55)
#: Volume fraction from which depths are measured along ways out, the number of ways, the step between samples, and the
#: greatest depth [grid spacings].
NEARLY_FULL = wp.constant(0.85)
WAYS, STRIDE, MOST_DEPTH = wp.constant(14), wp.constant(0.5), wp.constant(16.0)


@wp.func
def boundary_entry(sensors: Sensors, subject: int):
    """Return the entry of the colliders' impulse on a subject."""
    return subject


@wp.func
def pair_entry(sensors: Sensors, pair: int):
    """Return the entry of a pair's impulse."""
    return sensors.boundary_impulse.shape[1] + pair


@wp.func
def part_entry(sensors: Sensors, sensor: int, giver: int):
    """Return the entry of the impulse that subject ``giver`` has given a sensor."""
    subjects = sensors.boundary_impulse.shape[1]
    return subjects + subjects * subjects + sensor * subjects + giver


@wp.func
def moment_entry(sensors: Sensors, subject: int):
    """Return the entry of the moment of the colliders' impulse on a subject."""
    return part_entry(sensors, sensors.part_impulse.shape[1], 0) + subject


@wp.func
def add_impulse(sensors: Sensors, e: int, entry: int, J: wp.vec3):
    """Add an impulse [N s] to an entry."""
    for axis in range(3):
        wp.atomic_add(sensors.accumulators, e, 3 * entry + axis, wp.int64(wp.rint(QUANTA_PER_NEWTON_SECOND * J[axis])))


@wp.func
def impulse_at(sensors: Sensors, e: int, entry: int):
    """Return the sum of an entry [N s]."""
    x = float(sensors.accumulators[e, 3 * entry])
    y = float(sensors.accumulators[e, 3 * entry + 1])
    z = float(sensors.accumulators[e, 3 * entry + 2])
    return wp.vec3(x, y, z) / QUANTA_PER_NEWTON_SECOND


@wp.func
def clear_environment(e: int, sensors: Sensors):
    """Zero the sensors of an environment."""
    for n in range(sensors.accumulators.shape[1]):
        sensors.accumulators[e, n] = wp.int64(0)
    for s in range(sensors.boundary_impulse.shape[1]):
        sensors.boundary_impulse[e, s] = wp.vec3(0.0)
        sensors.boundary_moment[e, s] = wp.vec3(0.0)
        sensors.penetration[e, s] = 0.0
    for n in range(2):
        sensors.limited_sum[e, n] = wp.int64(0)
    sensors.limited[e] = 0.0
    for s in range(sensors.pair_impulse.shape[1]):
        sensors.pair_impulse[e, s] = wp.vec3(0.0)
    for i in range(sensors.part_impulse.shape[1]):
        for s in range(sensors.part_impulse.shape[2]):
            sensors.part_impulse[e, i, s] = wp.vec3(0.0)


@wp.kernel
def clear_sensors(sensors: Sensors):
    """Zero the sensors of all environments."""
    clear_environment(wp.tid(), sensors)


@wp.kernel
def clear_masked_sensors(mask: wp.array(dtype=wp.bool), sensors: Sensors):
    """Zero the sensors of the masked environments."""
    e = wp.tid()
    if mask[e]:
        clear_environment(e, sensors)


@wp.kernel
def read_impulses(sensors: Sensors):
    """Convert the accumulated impulses to floating point, a thread an entry."""
    e, entry = wp.tid()
    subjects = sensors.boundary_impulse.shape[1]
    J = impulse_at(sensors, e, entry)
    if entry < pair_entry(sensors, 0):
        sensors.boundary_impulse[e, entry - boundary_entry(sensors, 0)] = J
    elif entry < part_entry(sensors, 0, 0):
        sensors.pair_impulse[e, entry - pair_entry(sensors, 0)] = J
    elif entry < moment_entry(sensors, 0):
        n = entry - part_entry(sensors, 0, 0)
        sensors.part_impulse[e, n // subjects, n % subjects] = J
    else:
        sensors.boundary_moment[e, entry - moment_entry(sensors, 0)] = J


@wp.func
def add_limited(sensors: Sensors, particles: Particles, e: int, p: int, limit: int):
    """Add a particle that a substep has limited, by its share of the mass."""
    share = wp.int64(wp.rint(QUANTA_OF_LIMITED * particles.share[p]))
    wp.atomic_add(sensors.limited_sum, e, wp.where(limit == HELD, 1, 0), share)


@wp.kernel
def check_limited(substeps: int, sensors: Sensors, failure: wp.array(dtype=int)):
    """Write the share of an environment's mass that was limited, averaged over the ``substeps`` of a control step.

    Above :data:`LIMITED_SHARE` it flags a failure, because the motion as a whole is then not that of the velocities:
    ``out_of_grid`` if the grid has held most of it, ``cfl`` otherwise.
    """
    e = wp.tid()
    per_quantum = 1.0 / (QUANTA_OF_LIMITED * float(substeps))
    fast = per_quantum * float(sensors.limited_sum[e, 0])
    held = per_quantum * float(sensors.limited_sum[e, 1])
    sensors.limited[e] = fast + held
    if fast + held > _LIMITED_SHARE:
        wp.atomic_or(failure, e, wp.where(held > fast, _OUT_OF_GRID, _CFL))


@wp.func
def pick(w: wp.vec3, n: int):
    """Return ``w[n]`` without dynamic indexing, which would move ``w`` from registers to memory."""
    return wp.where(n == 0, w[0], wp.where(n == 1, w[1], w[2]))


@wp.func
def touched_around(grid: Grid, blocks: Blocks, sensors: Sensors, e: int, f: int, base: wp.vec3i):
    """Return whether contact has changed velocities of field ``f`` in any block of a stencil."""
    any = int(0)
    for i in range(2):  # see fields_around
        for j in range(2):
            for k in range(2):
                block = block_index(grid, base[0] + 2 * i, base[1] + 2 * j, base[2] + 2 * k)
                any = any | sensors.touched[e, first_record(grid, blocks, e, f, block) // BLOCK_NODES]
    return any != 0


@wp.func
def change_at(sensors: Sensors, e: int, r: int):
    """Return the change of velocity by contact at a record in this substep, and the subject that did most of it."""
    change = read_vec4(sensors.node, e, r)
    # without the flag, the change is of an earlier substep
    return wp.where(sensors.touched[e, r // BLOCK_NODES] != 0, change, wp.vec4())


@wp.func
def add_sensor_impulse(sensors: Sensors, e: int, sensor: int, taken: wp.vec4):
    """Add an impulse to a sensor, by the subject in its last component."""
    impulse = wp.vec3(taken[0], taken[1], taken[2])
    if wp.length_sq(impulse) > 0.0:
        add_impulse(sensors, e, part_entry(sensors, sensor, int(taken[3])), impulse)


@wp.func
def accumulate_share(sensors: Sensors, e: int, sensor: int, taken: wp.vec4, change: wp.vec4, share: float):
    """Return the impulse of a particle and its giver, with its ``share`` [kg] of a node's change of velocity added.

    Shares from one subject are summed before they are rounded.
    """
    if wp.length_sq(wp.vec3(change[0], change[1], change[2])) == 0.0:
        return taken
    if change[3] != taken[3]:
        add_sensor_impulse(sensors, e, sensor, taken)
        taken = wp.vec4(0.0, 0.0, 0.0, change[3])
    return taken + share * wp.vec4(change[0], change[1], change[2], 0.0)


@wp.func
def sense_particle(grid: Grid, particles: Particles, blocks: Blocks, sensors: Sensors, e: int, p: int, xg: wp.vec3):
    """Add the contact impulse on particle ``p`` at grid position ``xg`` to its sensor, by giver."""
    sensor = particles.sensor[p]
    own = particles.field[p]
    stencil = stencil_at(xg)
    base = stencil.base
    # nearly all particles return here
    if sensor < 0 or fields_around(grid, blocks, base, e) == (1 << own):
        return
    if not touched_around(grid, blocks, sensors, e, own, base):
        return
    m = particles.mass[row(e, particles.mass.shape[0]), p]
    taken = wp.vec4()
    slab = wp.vec4i()
    three = int(3)  # a variable, to keep the loops of this rare code
    for i in range(three):
        if i == 0 or ((base[0] + i) & 3) == 0:
            slab = slab_records(grid, blocks, e, own, base, i, VECTORS)
        for j in range(three):
            at = line_of_records(slab, base, i, j)
            w = m * pick(stencil.wx, i) * pick(stencil.wy, j)
            # all three loads are in flight before the first is used
            first = change_at(sensors, e, at[0])
            second = change_at(sensors, e, at[1])
            third = change_at(sensors, e, at[2])
            taken = accumulate_share(sensors, e, sensor, taken, first, w * stencil.wz[0])
            taken = accumulate_share(sensors, e, sensor, taken, second, w * stencil.wz[1])
            taken = accumulate_share(sensors, e, sensor, taken, third, w * stencil.wz[2])
    add_sensor_impulse(sensors, e, sensor, taken)


@wp.func
def sense_near_field(grid: Grid, particles: Particles, blocks: Blocks, sensors: Sensors, e: int, p: int, xg: wp.vec3):
    """Call :func:`sense_particle` if the grid update has stored that another field is near."""
    base = base_node(xg)
    r = first_record(grid, blocks, e, particles.field[p], block_index(grid, base[0], base[1], base[2]))
    if blocks.near_field[e, r // BLOCK_NODES] != 0:
        sense_particle(grid, particles, blocks, sensors, e, p, xg)


@wp.func
def is_single_field(grid: Grid, blocks: Blocks, e: int, f: int, base: wp.vec3i):
    """Return whether the grid update has stored that a stencil of field ``f`` overlaps no block of another one.

    Unknown, and false, for blocks activated since, and on paths that do not store it.
    """
    if blocks.near_field.shape[1] == 1:
        return False
    r = first_record(grid, blocks, e, f, block_index(grid, base[0], base[1], base[2]))
    if r >= BLOCK_NODES * blocks.num_updated[e]:
        return False
    return blocks.near_field[e, r // BLOCK_NODES] == 0


def senses_in_g2p(model: Model) -> bool:
    """Return whether G2P adds contact impulses to the sensors, on the tiled path, instead of a kernel of its own."""
    senses = model.contact.num_fields > 1 and model.num_sensors > 0
    return senses and model.path not in ("plain", "block")


@wp.kernel(launch_bounds=(THREADS, 7))
def sense_contact(
    grid: Grid,
    particles: Particles,
    x: wp.array2d(dtype=wp.vec3),
    blocks: Blocks,
    failure: wp.array(dtype=int),
    # in and out
    sensors: Sensors,
):
    """Add the contact impulses on all particles to their sensors, by giver.

    A particle takes its share ``w m`` of each node's change of velocity; summed over a subject's particles that is the
    impulse at the nodes. Where three subjects share a node, all of it counts for the one that did most.
    """
    e, p = wp.tid()
    xg = grid_position(grid, x[e, p])
    if failure[e] == 0 and (candidate_bits(blocks, e, p) & NEAR_FIELD) != 0:
        sense_particle(grid, particles, blocks, sensors, e, p, xg)


@wp.func
def fraction_of_others(
    grid: Grid,
    contact: Contact,
    blocks: Blocks,
    node_velocity: wp.array2d(dtype=wp.vec4),
    e: int,
    own: int,
    xg: wp.vec3,
):
    """Return the volume fraction of all subjects but ``own`` at grid position ``xg``, as the nodes hold it."""
    stencil = stencil_at(xg)
    base = stencil.base
    fraction = float(0.0)
    if not stencil_inside(grid, base):
        return fraction
    around = fields_around(grid, blocks, base, e)
    for g in range(contact.num_fields):
        if has_field(around, g) and contact.subject[g] != own:
            m = float(0.0)
            for i in range(3):
                for j in range(3):
                    for k in range(3):
                        if has_field(blocks.fields[e, block_index(grid, base[0] + i, base[1] + j, base[2] + k)], g):
                            r = record_of(grid, blocks, e, g, base[0] + i, base[1] + j, base[2] + k)
                            # a block activated by the last G2P holds no velocities yet
                            if r < BLOCK_NODES * blocks.num_updated[e]:
                                w = pick(stencil.wx, i) * pick(stencil.wy, j) * pick(stencil.wz, k)
                                m += w * mass_of(node_velocity, e, r)
            density = contact.density[row(e, contact.density.shape[0]), g]
            fraction += m * grid.inv_dx * grid.inv_dx * grid.inv_dx / density
    return fraction


@wp.func
def way_out(n: int):
    """Return the unit vector of way ``n`` of :data:`WAYS`: those along the axes, then the diagonals of a cube."""
    if n < 6:
        axis = n // 2
        side = 1.0 - 2.0 * float(n & 1)
        return side * wp.vec3(float(axis == 0), float(axis == 1), float(axis == 2))
    x = 1.0 - 2.0 * float(n & 1)
    y = 1.0 - 2.0 * float((n >> 1) & 1)
    z = 1.0 - 2.0 * float(((n - 6) >> 2) & 1)
    return wp.vec3(x, y, z) / wp.sqrt(3.0)


@wp.kernel
def sense_penetration(
    grid: Grid,
    particles: Particles,
    contact: Contact,
    x: wp.array2d(dtype=wp.vec3),
    blocks: Blocks,
    node_velocity: wp.array2d(dtype=wp.vec4),
    failure: wp.array(dtype=int),
    # in and out
    penetration: wp.array2d(dtype=float),
):
    """Raise ``penetration`` to the depth of the deepest particle of a subject below the surface of another [m].

    The surface is where the volume fraction of the other, seen through the spline, is one half. Near it the fraction
    gives the depth. Further down, where it is nearly one, the shortest of the ways out along the axes and diagonals
    does, which exceeds the depth by 15 % at most.
    """
    e, p = wp.tid()
    if failure[e] != 0:
        return
    xg = grid_position(grid, x[e, p])
    base = base_node(xg)
    if not stencil_inside(grid, base):
        return
    if is_single_field(grid, blocks, e, particles.field[p], base):
        return
    own = contact.subject[particles.field[p]]
    fraction = fraction_of_others(grid, contact, blocks, node_velocity, e, own, xg)
    depth = (fraction - SURFACE) / SURFACE_SLOPE
    if fraction > NEARLY_FULL:
        depth = MOST_DEPTH
        for n in range(WAYS):
            way = way_out(n)
            length = float(0.0)
            here = fraction
            there = fraction
            while there > SURFACE and length < depth:
                here = there
                length += STRIDE
                there = fraction_of_others(grid, contact, blocks, node_velocity, e, own, xg + length * way)
            if there <= SURFACE:
                depth = wp.min(depth, length - STRIDE * (SURFACE - there) / (here - there))
    if depth > 0.0:
        wp.atomic_max(penetration, e, own, grid.dx * depth)
