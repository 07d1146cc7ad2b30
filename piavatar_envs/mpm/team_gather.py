"""The gather of a particle's threads: they share the nodes of its stencil, and make velocities out of their sums.

There is no grid pass before it, so what boundaries do at nodes is found here, too, by all who gather from them.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.colliders import CONTACT_GATE, GATED_STENCIL, boundary_contact
from piavatar_envs.mpm.counts import Counts, counted, kinematic_numbers, numbers_at, physical_numbers, vec4i
from piavatar_envs.mpm.gather import Gradients
from piavatar_envs.mpm.grid import total_velocity
from piavatar_envs.mpm.impulses import add_impulse, boundary_entry, moment_entry
from piavatar_envs.mpm.normals import MASS_MIN
from piavatar_envs.mpm.stencil import Stencil, node_position
from piavatar_envs.mpm.sums import physical_sum
from piavatar_envs.mpm.sweep import LANES, any_lane, lane_of_thread, vector_sum_of_team
from piavatar_envs.mpm.team import sum_of_team
from piavatar_envs.mpm.team_nodes import (
    MOST_OF_EIGHT,
    MOST_OF_FOUR,
    mat84i,
    node_of_thread,
    numbers_of_thread,
    place_of_node,
    record_in_team,
    records_of_thread,
    weight_at,
    weights_of_thread,
)
from piavatar_envs.mpm.types import NO_STRESS, SPLIT, Boundaries, Contact, Grid, Sensors, Step, vec8

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})


@wp.func
def weight_of(stencil: Stencil, n: wp.vec3i):
    """Weight of the node at place ``n`` of a stencil."""
    return weight_at(stencil.wx, n[0]) * weight_at(stencil.wy, n[1]) * weight_at(stencil.wz, n[2])


@wp.func
def add_weighted(g: Gradients, at: wp.vec3, v: wp.vec4):
    """``g`` and a node's velocity, which has been weighted, ``at`` its place in the stencil."""
    return Gradients(g.mean + v, g.along_x + at[0] * v, g.along_y + at[1] * v, g.along_z + at[2] * v)


@wp.func_native("""
const float about = 1.0f / m;
return fmaf(fmaf(-m, about, 1.0f), about, about);
""")
def one_over(m: float) -> float:
    """``1 / m``, by a step of Newton's method: a GPU's fast division is off to one side more often than to the other.

    A body would gain 4e-9 of its momentum a substep.
    """
    ...


@wp.func
def velocity_of(step: Step, units: wp.vec2, numbers: vec4i):
    """Units of mass and physical velocity of a node, from its sums."""
    a = counted(numbers)
    s = physical_sum(units, a)
    if s[0] <= MASS_MIN:
        return wp.vec4(a[0], 0.0, 0.0, 0.0)
    own = one_over(s[0]) * s
    total = total_velocity(step, False, vec8(1.0, own[1], own[2], own[3], 0.0, 0.0, 0.0, 0.0))
    return wp.vec4(a[0], total[1], total[2], total[3])


@wp.func
def total_of_team(team: int, own: Gradients):
    """Sums over the threads of a particle."""
    total = sum_of_team(team, wp.matrix_from_rows(own.mean, own.along_x, own.along_y, own.along_z))
    return Gradients(total[0], total[1], total[2], total[3])


@wp.func
def add_push(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    e: int,
    units: wp.vec2,
    stencil: Stencil,
    f: int,
    n: wp.vec3i,
    u: wp.vec4,
    driven: vec4i,
    offset: vec4i,
    g: Gradients,
    seen: wp.vec3,
):
    """Add what the boundaries do to field ``f`` at a node with :func:`velocity_of` ``u``, weighted.

    Also, its kinematic velocity to what has been ``seen``.
    """
    if n[0] < 0 or u[0] <= 0.0:
        return g, seen
    vk = (units[1] / (units[0] * u[0])) * wp.vec3(float(driven[0]), float(driven[1]), float(driven[2]))
    v = wp.vec3(u[1], u[2], u[3])
    if step.decoupling == SPLIT or step.decoupling == NO_STRESS:
        v += vk
    node = stencil.base + n
    way = (grid.dx / u[0]) * wp.vec3(float(offset[0]), float(offset[1]), float(offset[2]))
    matter = node_position(grid, node[0], node[1], node[2]) - way
    dv = boundary_contact(boundaries, e, f, matter, v, CONTACT_GATE * grid.dx) - v
    w = weight_of(stencil, n)
    at = wp.vec3(float(n[0]), float(n[1]), float(n[2]))
    return add_weighted(g, at, w * wp.vec4(0.0, dv[0], dv[1], dv[2])), seen + w * vk


@wp.func
def tell_sensors(
    team: int,
    several: bool,
    contact: Contact,
    sensors: Sensors,
    e: int,
    f: int,
    m: float,
    corner: wp.vec3,
    dx: float,
    g: Gradients,
):
    """Add what the boundaries have done to the particles of a warp, of mass ``m``, by the sums ``g`` of its threads.

    They are of one field, the first, unless there are ``several``; ``corner`` is the lowest node of a stencil. All
    threads of a warp come here.
    """
    J = m * wp.vec3(g.mean[1], g.mean[2], g.mean[3])
    along_x = wp.vec3(g.along_x[1], g.along_x[2], g.along_x[3])
    along_y = wp.vec3(g.along_y[1], g.along_y[2], g.along_y[3])
    along_z = wp.vec3(g.along_z[1], g.along_z[2], g.along_z[3])
    # the sum of x_i x dv_i over the nodes, by the sums of dv_i and of dv_i times their places along each axis
    own = wp.vec3(along_y[2] - along_z[1], along_z[0] - along_x[2], along_x[1] - along_y[0])
    moment = wp.cross(corner, J) + (m * dx) * own
    threads = LANES
    if several:
        threads = team
    moment = vector_sum_of_team(threads, moment)
    J = vector_sum_of_team(threads, J)
    if (lane_of_thread() & (threads - 1)) == 0 and wp.length_sq(J) > 0.0:
        add_impulse(sensors, e, boundary_entry(sensors, contact.subject[f]), J)
        add_impulse(sensors, e, moment_entry(sensors, contact.subject[f]), moment)


@wp.func
def added(a: Gradients, b: Gradients):
    """Sum of both."""
    return Gradients(a.mean + b.mean, a.along_x + b.along_x, a.along_y + b.along_y, a.along_z + b.along_z)


@wp.func
def add_free(team: int, step: Step, units: wp.vec2, base: wp.vec3i, weights: vec8, numbers: mat84i):
    """Sums of the velocities of a thread's nodes, weighted; also, the most that is counted of mass at any of them."""
    g = Gradients()
    crowd = wp.uint32(0)
    for n in range(MOST_OF_FOUR):
        if n < MOST_OF_EIGHT or team == 4:
            u = velocity_of(step, units, numbers[n])
            g = add_weighted(g, place_of_node(team, base, n), weights[n] * wp.vec4(0.0, u[1], u[2], u[3]))
            crowd = wp.max(crowd, wp.uint32(numbers[n][0]))  # one that has run over is too much, too
    return g, crowd


@wp.func
def push_two(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    counts: Counts,
    e: int,
    units: wp.vec2,
    stencil: Stencil,
    f: int,
    na: wp.vec3i,
    nb: wp.vec3i,
    ra: int,
    rb: int,
    ua: wp.vec4,
    ub: wp.vec4,
    g: Gradients,
    seen: wp.vec3,
):
    """:func:`add_push` of two nodes.

    A GPU has too few registers for what more were told, and few particles come here.
    """
    ka = kinematic_numbers(counts, e, ra)
    oa = numbers_at(counts.offset, e, ra)
    kb = kinematic_numbers(counts, e, rb)
    ob = numbers_at(counts.offset, e, rb)
    g, seen = add_push(grid, step, boundaries, e, units, stencil, f, na, ua, ka, oa, g, seen)
    g, seen = add_push(grid, step, boundaries, e, units, stencil, f, nb, ub, kb, ob, g, seen)
    return g, seen


@wp.func
def gather_by_team(
    team: int,
    several: bool,
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    counts: Counts,
    e: int,
    f: int,
    units: wp.vec2,
    stencil: Stencil,
    record: wp.vec2i,
    distance: float,
    m: float,
    sensors: Sensors,
):
    """Sums of a stencil's physical velocities, and the mean kinematic one where a boundary is near.

    Also, the most that a thread finds counted of mass at its nodes. ``units`` are those of mass and of momentum,
    ``record`` as for :func:`piavatar_envs.mpm.team_nodes.record_in_team`, ``distance`` [grid spacings] how far the
    particle is from any boundary, ``m`` its mass, 0 if it takes no part, ``f`` its field, the first unless there are
    ``several``. All threads of a warp come here.
    """
    records = records_of_thread(team, stencil.base, record)
    numbers = numbers_of_thread(team, counts, e, records)
    weights = weights_of_thread(team, stencil.base, stencil.wx, stencil.wy, stencil.wz)
    physical, crowd = add_free(team, step, units, stencil.base, weights, numbers)
    kinematic = Gradients()
    if any_lane(distance < GATED_STENCIL):
        g = Gradients()
        seen = wp.vec3()
        if team == 4:
            nodes = (26 + team) // team  # a loop: code and registers would be too many
            for n in range(nodes):
                na = node_of_thread(team, stencil.base, n)
                ra = record_in_team(team, stencil.base, na, record)
                ra = wp.where(na[0] < 0, 0, ra)  # any that exists
                sa = physical_numbers(counts, e, ra)
                ka = kinematic_numbers(counts, e, ra)
                oa = numbers_at(counts.offset, e, ra)
                ua = velocity_of(step, units, sa)
                g, seen = add_push(grid, step, boundaries, e, units, stencil, f, na, ua, ka, oa, g, seen)
        else:
            for pair in range(2):  # written down one by one
                na = node_of_thread(team, stencil.base, 2 * pair)
                nb = node_of_thread(team, stencil.base, 2 * pair + 1)
                ua = velocity_of(step, units, numbers[2 * pair])
                ub = velocity_of(step, units, numbers[2 * pair + 1])
                g, seen = push_two(
                    grid, step, boundaries, counts, e, units, stencil, f, na, nb, records[2 * pair],
                    records[2 * pair + 1], ua, ub, g, seen,
                )  # fmt: skip
        seen = vector_sum_of_team(team, seen)
        kinematic.mean = wp.vec4(0.0, seen[0], seen[1], seen[2])
        corner = node_position(grid, stencil.base[0], stencil.base[1], stencil.base[2])
        tell_sensors(team, several, contact, sensors, e, f, m, corner, grid.dx, g)
        physical = added(physical, g)
    return total_of_team(team, physical), kinematic, crowd
