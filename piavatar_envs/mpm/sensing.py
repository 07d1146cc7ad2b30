"""Contact sensors: impulses by body part and subject, and how deep bodies are in each other."""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.masks import fields_around, has_field
from piavatar_envs.mpm.stencil import base_node, block_index, grid_position, node_index, spline, stencil_inside
from piavatar_envs.mpm.types import Contact, Grid, Particles, Sensors, row, vec8

wp.set_module_options({"enable_backward": False})

#: Volume fraction of another subject at which a particle lies on its surface.
SURFACE = wp.constant(0.5)
#: Slope of the volume fraction at a flat surface, times the grid spacing: a step seen through the spline twice has the
#: slope of the integral of its square, 11/20.
SURFACE_SLOPE = wp.constant(0.55)


@wp.kernel
def sense_contact(
    grid: Grid,
    particles: Particles,
    contact: Contact,
    x: wp.array2d(dtype=wp.vec3),
    active: wp.array2d(dtype=int),
    node_contact: wp.array2d(dtype=wp.vec4),
    failure: wp.array(dtype=int),
    # in and out
    part_impulse: wp.array3d(dtype=wp.vec3),
):
    """Impulse on every sensor, by the subject that gave it.

    A particle takes its share ``w m`` of each node's change of velocity; summed over a subject's particles that is
    the impulse at the nodes. Where three subjects meet at a node, all of it is booked on the one that did most.
    """
    e, p = wp.tid()
    sensor = particles.sensor[p]
    if failure[e] != 0 or sensor < 0:
        return
    xg = grid_position(grid, x[e, p])
    base = base_node(xg)
    own = particles.field[p]
    if fields_around(grid, base, e, active) == (1 << own):
        return
    f = xg - wp.vec3(float(base[0]), float(base[1]), float(base[2]))
    wx = spline(f[0])
    wy = spline(f[1])
    wz = spline(f[2])
    m = particles.mass[row(e, particles.mass.shape[0]), p]
    # summed up before it is added to what may be a thousand times as large
    impulse = wp.vec3()
    giver = int(0)
    for i in range(3):
        for j in range(3):
            for k in range(3):
                mask = active[e, block_index(grid, base[0] + i, base[1] + j, base[2] + k)]
                if mask != (1 << own):
                    n = node_index(grid, base[0] + i, base[1] + j, base[2] + k)
                    change = node_contact[e, own * grid.num_nodes + n]
                    dv = wp.vec3(change[0], change[1], change[2])
                    if wp.length_sq(dv) > 0.0:
                        if int(change[3]) != giver:
                            if wp.length_sq(impulse) > 0.0:
                                wp.atomic_add(part_impulse, e, sensor, giver, impulse)
                            impulse = wp.vec3()
                            giver = int(change[3])
                        impulse += (m * wx[i] * wy[j] * wz[k]) * dv
    if wp.length_sq(impulse) > 0.0:
        wp.atomic_add(part_impulse, e, sensor, giver, impulse)


@wp.kernel
def sense_penetration(
    grid: Grid,
    particles: Particles,
    contact: Contact,
    x: wp.array2d(dtype=wp.vec3),
    active: wp.array2d(dtype=int),
    node_velocity: wp.array2d(dtype=vec8),
    failure: wp.array(dtype=int),
    # in and out
    penetration: wp.array2d(dtype=float),
):
    """Deepest particle of a subject below the surface of another [m].

    The surface is where the other's volume fraction, seen through the spline, is one half; depths are linear there
    and end at 0.9 grid spacings.
    """
    e, p = wp.tid()
    if failure[e] != 0:
        return
    xg = grid_position(grid, x[e, p])
    base = base_node(xg)
    if not stencil_inside(grid, base):
        return
    own = contact.subject[particles.field[p]]
    around = fields_around(grid, base, e, active)
    f = xg - wp.vec3(float(base[0]), float(base[1]), float(base[2]))
    wx = spline(f[0])
    wy = spline(f[1])
    wz = spline(f[2])
    fraction = float(0.0)
    for g in range(contact.num_fields):
        if has_field(around, g) and contact.subject[g] != own:
            m = float(0.0)
            for i in range(3):
                for j in range(3):
                    for k in range(3):
                        if has_field(active[e, block_index(grid, base[0] + i, base[1] + j, base[2] + k)], g):
                            n = node_index(grid, base[0] + i, base[1] + j, base[2] + k)
                            m += wx[i] * wy[j] * wz[k] * node_velocity[e, g * grid.num_nodes + n][0]
            density = contact.density[row(e, contact.density.shape[0]), g]
            fraction += m * grid.inv_dx * grid.inv_dx * grid.inv_dx / density
    depth = grid.dx * (wp.min(fraction, 1.0) - SURFACE) / SURFACE_SLOPE
    if depth > 0.0:
        wp.atomic_max(penetration, e, own, depth)


@wp.func
def forget(e: int, sensors: Sensors):
    """Zero the sensors of an environment."""
    for s in range(sensors.boundary_impulse.shape[1]):
        sensors.boundary_impulse[e, s] = wp.vec3(0.0)
        sensors.penetration[e, s] = 0.0
    for s in range(sensors.pair_impulse.shape[1]):
        sensors.pair_impulse[e, s] = wp.vec3(0.0)
    for i in range(sensors.part_impulse.shape[1]):
        for s in range(sensors.part_impulse.shape[2]):
            sensors.part_impulse[e, i, s] = wp.vec3(0.0)


@wp.kernel
def clear_sensors(sensors: Sensors):
    """Forget the contacts of the last control step."""
    forget(wp.tid(), sensors)


@wp.kernel
def clear_masked_sensors(mask: wp.array(dtype=wp.bool), sensors: Sensors):
    """Forget the contacts of the masked environments."""
    e = wp.tid()
    if mask[e]:
        forget(e, sensors)
