"""Contact of particles with colliders that are too thin for the grid.

Contact on the grid stops matter to a fraction of a grid spacing. In a collider thinner than that, matter passes the
middle, from where the nearest face is the far one: contact then drives it on, or holds a body that is on both sides.
Here, after G2P, the way of each particle in the substep ends at the face through which it would enter. No particle is
then ever inside, so that the way alone decides on which side it is. The velocities of particles are corrected as those
of nodes are, by Coulomb's law; particle and grid collisions were first combined by Stomakhin et al., "A Material Point
Method for Snow Simulation" (2013).

The first point of a way on a surface is found by sphere tracing (Hart, "Sphere Tracing: A Geometric Method for the
Antialiased Ray Tracing of Implicit Surfaces", 1996). Solids are convex: beyond the plane that touches there is none.
"""

from __future__ import annotations

from collections.abc import Sequence

import warp as wp

from piavatar_envs.mpm.bspline import base_node, grid_position, in_same_subblock, stencil_inside
from piavatar_envs.mpm.colliders import BOX, Collider, half_thickness, slide, solid_distance, surface_velocity, turned
from piavatar_envs.mpm.contact_sensors import add_impulse, boundary_entry, moment_entry
from piavatar_envs.mpm.sparse_grid import activate_stencil
from piavatar_envs.mpm.types import (
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
    row,
)

wp.set_module_options({"enable_backward": False})

#: Half thickness or radius below which a collider is thin [grid spacings]: contact on the grid alone let a ball at
#: 9 m/s pass the middle of thinner ones.
THIN = wp.constant(1.2)
#: Distance that particles keep from the surface, far below the gate of contact on the grid, which bears what rests
#: there; and how far a particle that begins inside moves out in a substep [grid spacings].
CLEARANCE, MOST_PARTING = wp.constant(1.0e-3), wp.constant(0.05)
#: Most points of a way at which the distance is evaluated.
TRACES = wp.constant(24)
#: Share of a way that touches nothing.
_NEVER = wp.constant(2.0)


def thin_colliders(colliders: Sequence[Collider], dx: float) -> list[int]:
    """Return the indices of the colliders that are thin on a grid of spacing ``dx`` [m]."""
    return [b for b, each in enumerate(colliders) if half_thickness(each.kind, each.size) < THIN * dx]


@wp.func
def parts_matter(grid: Grid, boundaries: Boundaries, e: int, b: int, x: wp.vec3):
    """Return whether the part of a thin collider that is nearest to ``x`` may part matter: anything but a wide face."""
    if boundaries.kind[b] != BOX:
        return True
    r = row(e, boundaries.position.shape[0])
    p = wp.quat_rotate_inv(boundaries.rotation[r, b], x - boundaries.position[r, b])
    half = boundaries.size[b]
    beyond = wp.vec3(wp.abs(p[0]) - half[0], wp.abs(p[1]) - half[1], wp.abs(p[2]) - half[2])
    faces = int(0)
    narrowest = float(0.0)
    for axis in range(3):
        if beyond[axis] > 0.0:
            faces += 1
            narrowest = wp.min(half[(axis + 1) % 3], half[(axis + 2) % 3])
    return faces != 1 or narrowest < THIN * grid.dx


@wp.func
def first_touch(kind: int, size: wp.vec3, start: wp.vec3, end: wp.vec3, clearance: float):
    """Return normal and distance [m] where a way first comes closer to a solid than ``clearance``, and its share there.

    The share is :data:`_NEVER` if it does not. Points are in the solid's frame. A way that is not decided after
    :data:`TRACES` points is nearly along the surface; it counts as a touch, which takes nothing from such a way.
    """
    way = end - start
    length = wp.length(way)
    share = float(0.0)
    d = solid_distance(kind, size, start)
    for _ in range(TRACES):
        if d[3] < clearance:
            break
        if d[3] >= (1.0 - share) * length:
            share = _NEVER
            break
        share += d[3] / length
        d = solid_distance(kind, size, start + share * way)
    return d, share


@wp.kernel
def store_positions(x: wp.array2d(dtype=wp.vec3), before: wp.array2d(dtype=wp.vec3)):
    """Store the positions of particles before G2P."""
    e, p = wp.tid()
    before[e, p] = x[e, p]


@wp.func
def stop_at_collider(
    grid: Grid, step: Step, boundaries: Boundaries, e: int, b: int, field: int, start: wp.vec3, end: wp.vec3, v: wp.vec3
):
    """Return position and velocity of a particle that goes from ``start`` to ``end``, after contact with a collider.

    ``v`` is its total velocity [m/s]. The way is taken in the frame of the collider, which moves during the substep.
    """
    r = row(e, boundaries.position.shape[0])
    rotation = boundaries.rotation[r, b]
    turned_on = turned(rotation, boundaries.spin[r, b], step.dt)
    center = boundaries.position[r, b]
    moved_on = center + step.dt * boundaries.velocity[r, b]
    first = wp.quat_rotate_inv(rotation, start - center)
    last = wp.quat_rotate_inv(turned_on, end - moved_on)
    clearance = CLEARANCE * grid.dx
    d, share = first_touch(boundaries.kind[b], boundaries.size[b], first, last, clearance)
    if share <= 1.0:
        face = wp.vec3(d[0], d[1], d[2])
        along = (1.0 - share) * wp.dot(face, last - first)  # what is left of the way, away from the face
        inside = clearance - d[3] - wp.max(along, 0.0)
        normal = wp.quat_rotate(turned_on, face)
        end += (wp.max(-along, 0.0) + wp.clamp(inside, 0.0, MOST_PARTING * grid.dx)) * normal
        surface = surface_velocity(boundaries, e, b, end)
        if wp.dot(v - surface, normal) < 0.0:
            friction = boundaries.friction[row(e, boundaries.friction.shape[0]), field * boundaries.count + b]
            v = surface + slide(v - surface, normal, friction)
    return end, v


@wp.kernel
def stop_at_thin_colliders(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    thin: wp.array(dtype=int),
    before: wp.array2d(dtype=wp.vec3),
    # in and out; vk is read
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
    sensors: Sensors,
):
    """Stop every particle at the thin colliders on its way from ``before``, and add the impulse to the sensors.

    A particle that one of them moves is checked against all of them again, because it may be moved into another.
    """
    e, p = wp.tid()
    if blocks.frozen[e] != 0:
        return
    free = moved.x[e, p]
    field = particles.field[p]
    vk = wp.vec3()
    if step.decoupling == SPLIT or step.decoupling == NO_STRESS:
        vk = moved.vk[e, p]
    arriving = moved.u[e, p] + vk
    end = free
    v = arriving
    for n in range(2 * thin.shape[0]):
        if n < thin.shape[0] or wp.length_sq(end - free) > 0.0:
            b = thin[n % thin.shape[0]]
            end, v = stop_at_collider(grid, step, boundaries, e, b, field, before[e, p], end, v)
    to = base_node(grid_position(grid, end))
    if wp.length_sq(end - free) + wp.length_sq(v - arriving) > 0.0 and stencil_inside(grid, to):
        m = particles.mass[row(e, particles.mass.shape[0]), p]
        subject = contact.subject[field]
        add_impulse(sensors, e, boundary_entry(sensors, subject), m * (v - arriving))
        add_impulse(
            sensors, e, moment_entry(sensors, subject), m * (wp.cross(end, v) - wp.cross(free, arriving))
        )  # the stop moves matter, too
        moved.x[e, p] = end
        moved.u[e, p] = v - vk
        if not in_same_subblock(to, base_node(grid_position(grid, free))):
            activate_stencil(grid, blocks, to, field, e, failure)
