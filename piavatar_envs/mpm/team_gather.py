"""The gather of a particle's threads: they share the nodes of its stencil, and make velocities out of their sums.

There is no grid pass before it, so what boundaries do at nodes is found here, too, by all who gather from them.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.colliders import CONTACT_GATE, GATED_STENCIL, boundary_contact
from piavatar_envs.mpm.gather import Gradients
from piavatar_envs.mpm.grid import total_velocity
from piavatar_envs.mpm.impulses import add_impulse, boundary_entry, moment_entry
from piavatar_envs.mpm.records import half_of
from piavatar_envs.mpm.stencil import Stencil, node_position
from piavatar_envs.mpm.sums import begin_sum, counted, numbers_at, physical_sum
from piavatar_envs.mpm.sweep import LANES, any_lane, lane_of_thread, vector_sum_of_team
from piavatar_envs.mpm.team import (
    node_of_thread,
    record_in_team,
    sum_of_team,
    weight_at,
)
from piavatar_envs.mpm.types import NO_STRESS, SPLIT, Boundaries, Contact, Grid, Sensors, Step, Sums, vec4l

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})


@wp.func
def weight_of(stencil: Stencil, n: wp.vec3i):
    """Weight of the node at place ``n`` of a stencil."""
    return weight_at(stencil.wx, n[0]) * weight_at(stencil.wy, n[1]) * weight_at(stencil.wz, n[2])


@wp.func
def add_node(g: Gradients, stencil: Stencil, n: wp.vec3i, x: float, y: float, z: float):
    """``g`` and a node's velocity, ``n`` its place in the stencil."""
    return add_weighted(g, n, weight_of(stencil, n) * wp.vec4(0.0, x, y, z))


@wp.func
def add_weighted(g: Gradients, n: wp.vec3i, v: wp.vec4):
    """:func:`add_node` of a velocity that has been weighted."""
    return Gradients(
        g.mean + v, g.along_x + float(n[0]) * v, g.along_y + float(n[1]) * v, g.along_z + float(n[2]) * v
    )  # fmt: skip


@wp.func
def velocity_of(step: Step, units: wp.vec2, begun: vec4l):
    """Units of mass and physical velocity of a node, from its sum."""
    a = counted(begun)
    total = total_velocity(step, False, physical_sum(units, a))
    return wp.vec4(a[0], total[1], total[2], total[3])


@wp.func
def add_free(g: Gradients, stencil: Stencil, n: wp.vec3i, u: wp.vec4):
    """:func:`add_node` with :func:`velocity_of` it; nothing if it is none."""
    if n[0] < 0:
        return g
    return add_node(g, stencil, n, u[1], u[2], u[3])


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
    driven: vec4l,
    offset: vec4l,
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
    return add_weighted(g, n, w * wp.vec4(0.0, dv[0], dv[1], dv[2])), seen + w * vk


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


@wp.struct
class Few:
    """Four of a thread's nodes: their places in the stencil, records, sums, and :func:`velocity_of` these."""

    n0: wp.vec3i
    n1: wp.vec3i
    n2: wp.vec3i
    n3: wp.vec3i
    r0: int
    r1: int
    r2: int
    r3: int
    s0: vec4l
    s1: vec4l
    s2: vec4l
    s3: vec4l
    u0: wp.vec4
    u1: wp.vec4
    u2: wp.vec4
    u3: wp.vec4


@wp.func
def ask_few(team: int, sums: Sums, e: int, stencil: Stencil, record: wp.vec2i, first: int):
    """A thread's nodes from its ``first`` on, four of them; all threads of a warp come here."""
    few = Few()
    few.n0 = node_of_thread(team, first)
    few.n1 = node_of_thread(team, first + 1)
    few.n2 = node_of_thread(team, first + 2)
    few.n3 = node_of_thread(team, first + 3)
    few.r0 = record_in_team(team, stencil.base, few.n0, record)
    few.r1 = record_in_team(team, stencil.base, few.n1, record)
    few.r2 = record_in_team(team, stencil.base, few.n2, record)
    few.r3 = record_in_team(team, stencil.base, few.n3, record)
    few.r2 = wp.where(few.n2[0] < 0, few.r1, few.r2)  # who has fewer reads one of them twice
    few.r3 = wp.where(few.n3[0] < 0, few.r2, few.r3)
    few.s0 = begin_sum(sums, e, few.r0)  # all are asked for before the first has answered
    few.s1 = begin_sum(sums, e, few.r1)
    few.s2 = begin_sum(sums, e, few.r2)
    few.s3 = begin_sum(sums, e, few.r3)
    return few


@wp.func
def add_few(g: Gradients, step: Step, units: wp.vec2, stencil: Stencil, few: Few):
    """:func:`add_free` of them, when they have answered; also, they with their velocities."""
    few.u0 = velocity_of(step, units, few.s0)
    few.u1 = velocity_of(step, units, few.s1)
    few.u2 = velocity_of(step, units, few.s2)
    few.u3 = velocity_of(step, units, few.s3)
    g = add_free(g, stencil, few.n0, few.u0)
    g = add_free(g, stencil, few.n1, few.u1)
    g = add_free(g, stencil, few.n2, few.u2)
    return add_free(g, stencil, few.n3, few.u3), few


@wp.func
def push_two(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    sums: Sums,
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
    ka = numbers_at(sums.fixed, e, half_of(ra, 1))
    oa = numbers_at(sums.offset_fixed, e, ra)
    kb = numbers_at(sums.fixed, e, half_of(rb, 1))
    ob = numbers_at(sums.offset_fixed, e, rb)
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
    sums: Sums,
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

    ``record`` are as for :func:`piavatar_envs.mpm.team.record_in_team`, ``distance`` [grid spacings] how far the
    particle is from any boundary, ``m`` its mass, 0 if it takes no part, ``f`` its field, the first unless there are
    ``several``. All threads of a warp come here.
    """
    few = ask_few(team, sums, e, stencil, record, 0)
    more = Few()
    if team == 4:
        more = ask_few(team, sums, e, stencil, record, 4)
    physical, few = add_few(Gradients(), step, units, stencil, few)
    if team == 4:
        physical, more = add_few(physical, step, units, stencil, more)
    kinematic = Gradients()
    if any_lane(distance < GATED_STENCIL):
        g = Gradients()
        seen = wp.vec3()
        if team == 4:
            pairs = 16 // team  # not a constant, and sums are asked for again: code and registers would be too many
            for pair in range(pairs):
                na = node_of_thread(team, 2 * pair)
                nb = node_of_thread(team, 2 * pair + 1)
                ra = record_in_team(team, stencil.base, na, record)
                rb = record_in_team(team, stencil.base, nb, record)
                ra = wp.where(na[0] < 0, 0, ra)  # any that exists
                rb = wp.where(nb[0] < 0, ra, rb)
                sa = begin_sum(sums, e, ra)
                sb = begin_sum(sums, e, rb)
                ua = velocity_of(step, units, sa)
                ub = velocity_of(step, units, sb)
                g, seen = push_two(
                    grid, step, boundaries, sums, e, units, stencil, f, na, nb, ra, rb, ua, ub, g, seen
                )  # fmt: skip
        else:
            g, seen = push_two(
                grid, step, boundaries, sums, e, units, stencil, f, few.n0, few.n1, few.r0, few.r1, few.u0, few.u1, g,
                seen,
            )  # fmt: skip
            g, seen = push_two(
                grid, step, boundaries, sums, e, units, stencil, f, few.n2, few.n3, few.r2, few.r3, few.u2, few.u3, g,
                seen,
            )  # fmt: skip
        seen = vector_sum_of_team(team, seen)
        kinematic.mean = wp.vec4(0.0, seen[0], seen[1], seen[2])
        corner = node_position(grid, stencil.base[0], stencil.base[1], stencil.base[2])
        tell_sensors(team, several, contact, sensors, e, f, m, corner, grid.dx, g)
        physical = added(physical, g)
    return total_of_team(team, physical), kinematic
