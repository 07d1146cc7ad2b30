"""Cores of props: thin colliders stop a prop as a whole, where they would part its particles.

Contact on the grid and at thin colliders stops particles, each by its own nearest face. A pole or an edge that soft
matter strikes fast so parts the particles, which close behind it: the prop hangs impaled, or the pole passes through.
Therefore the innermost part of a prop, its core, meets the poles, edges and balls among the thin colliders as a rigid
body, as the hulls of bones do. It moves with the rigid motion that is fitted to all particles. A point of it may
approach a collider in a substep by no more than the distance, and moves out of one. In the impulse that stops it by
Coulomb's law the prop is a free rigid body; all its particles take the change of rigid motion, which has exactly the
impulse and its moment. Matter outside the core is dented as before. Faces of plates part nothing.

The core is a set of balls (Bradshaw & O'Sullivan, "Adaptive Medial-Axis Approximation for Sphere-Tree Construction",
2004), see :func:`piavatar_envs.sim.prop_geometry.core_balls`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import warp as wp

from piavatar_envs.avatar.pose_control.bone_contact import Rigid, response_at
from piavatar_envs.avatar.skinning import motion_at
from piavatar_envs.avatar.torque_control.bone_contact import TOLERANCE, stopping_impulse
from piavatar_envs.avatar.tracking import kabsch_rotation, spin_of
from piavatar_envs.core.arrays import vec8, vec16
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.colliders import signed_distance, surface_velocity
from piavatar_envs.mpm.contact import MOST_PARTING, PARTING
from piavatar_envs.mpm.contact_sensors import add_impulse, boundary_entry, moment_entry
from piavatar_envs.mpm.thin_colliders import parts_matter
from piavatar_envs.mpm.types import Boundaries, Contact, Grid, Model, Particles, Scratch, Sensors, State, Step, row
from piavatar_envs.sim.prop_geometry import PropPoints
from piavatar_envs.sim.props import Prop, add_moments, fit_prop

wp.set_module_options({"enable_backward": False})

#: Threads that share the particles of a prop on a GPU, and the most impulses on a prop in a substep.
SHARES, MOST_STOPS = 32, wp.constant(8)


@wp.struct
class Core:
    """Core of a prop and its change of motion in a substep."""

    balls: wp.array(dtype=wp.vec4)  # centre about the centre of mass, and radius [m]
    reach: float  # of the balls from the centre of mass [m]
    center: wp.array(dtype=wp.vec3)  # (num_envs,) centre of mass [m]
    change: wp.array(dtype=vec8)  # (num_envs,) of the rigid motion: velocity there [m/s] and spin [rad/s]


@dataclass(frozen=True)
class _Own:
    """A prop, its velocity field, its core and the sums over its particles."""

    prop: Prop
    field: int
    core: Core
    moments: wp.array
    correlation: wp.array


class PropCores:
    """Cores of the props of a world; nothing is recorded where no collider is thin."""

    def __init__(
        self, points: Sequence[PropPoints], props: Sequence[Prop], fields_of: Sequence[int], model: Model
    ) -> None:
        """Allocate the cores of ``props``, with their particles and velocity fields, in the world of ``model``."""
        self._model = model
        used = model.thin_colliders is not None
        self._own = [self._of(*one) for one in zip(points, props, fields_of, strict=True)] if used else []

    def _of(self, points: PropPoints, prop: Prop, field: int) -> _Own:
        """Allocate the core of a prop."""
        n, device = self._model.num_envs, self._model.device
        shares = SHARES if wp.get_device(device).is_cuda else 1
        core = Core()
        core.balls = wp.array(points.core, dtype=wp.vec4, device=device)
        core.reach = points.core_reach
        core.center = wp.zeros(n, dtype=wp.vec3, device=device)
        core.change = wp.zeros(n, dtype=vec8, device=device)
        moments = wp.zeros((n, shares), dtype=vec16, device=device)
        return _Own(prop, field, core, moments, wp.zeros((n, shares), dtype=wp.mat33, device=device))

    def record_before_substep(self, graph: LaunchGraph, state: State, scratch: Scratch) -> None:
        """Append the contact of all cores with thin colliders."""
        m, s = self._model, state
        for own in self._own:
            sums = [own.moments, own.correlation]
            graph.launch(sum_prop, own.moments.shape, [own.prop, m.particles, s.x, s.u, s.vk, s.failure], sums)
            inputs = [m.grid, m.step, m.boundaries, m.contact, m.thin_colliders, own.prop, own.field]
            inputs += [s.x, s.u, s.vk, *sums, s.failure]
            graph.launch(stop_core, m.num_envs, inputs, [scratch.sensors, own.core])
            shape = m.num_envs, int(own.prop.count)
            graph.launch(apply_change, shape, [own.prop, own.core, s.x, s.failure], [s.u])


@wp.kernel
def sum_prop(
    prop: Prop,
    particles: Particles,
    x: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    vk: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # out
    moments: wp.array2d(dtype=vec16),
    correlation: wp.array2d(dtype=wp.mat33),
):
    """Sum moments and correlation with the rest shape about the first particle; over ``(num_envs, shares)``."""
    e, share = wp.tid()
    if failure[e] != 0:
        return
    total, H = add_moments(prop, particles, x, u, vk, e, share, moments.shape[1])
    moments[e, share] = total
    correlation[e, share] = H


@wp.struct
class CoreTouch:
    """Contact of a ball of a core with a collider."""

    place: wp.vec3  # point of the ball that is nearest to the collider [m]
    normal: wp.vec3  # away from the collider
    velocity: wp.vec3  # of the prop there, relative to the collider [m/s]
    least: float  # allowed velocity along the normal [m/s]; where the ball is not in contact, that of ``velocity``


@wp.func
def touch_of_core(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    e: int,
    b: int,
    ball: wp.vec4,
    turn: wp.mat33,
    c: wp.vec3,
    motion: vec8,
):
    """Return the contact of a ``ball`` of a core at ``c``, turned and in ``motion``, with a collider."""
    s = CoreTouch()
    middle = c + turn * wp.vec3(ball[0], ball[1], ball[2])
    d = signed_distance(boundaries, e, b, middle)
    s.normal = wp.vec3(d[0], d[1], d[2])
    s.place = middle - ball[3] * s.normal
    s.velocity = motion_at(motion, s.place - c) - surface_velocity(boundaries, e, b, s.place)
    gap = d[3] - ball[3]
    s.least = wp.where(gap > 0.0, -gap, wp.min(-PARTING * gap, MOST_PARTING * grid.dx)) / step.dt
    if not parts_matter(grid, boundaries, e, b, middle):
        s.least = wp.dot(s.velocity, s.normal)
    return s


@wp.kernel
def stop_core(
    grid: Grid,
    step: Step,
    boundaries: Boundaries,
    contact: Contact,
    thin: wp.array(dtype=int),
    prop: Prop,
    field: int,
    x: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    vk: wp.array2d(dtype=wp.vec3),
    moments: wp.array2d(dtype=vec16),
    correlation: wp.array2d(dtype=wp.mat33),
    failure: wp.array(dtype=int),
    # in and out
    sensors: Sensors,
    core: Core,
):
    """Compute the change of a prop's rigid motion by thin colliders that its core meets; over ``num_envs``.

    The ball that lacks most of the speed it must have is stopped first.
    """
    e = wp.tid()
    if failure[e] != 0:
        return
    s = vec16()
    H = wp.mat33()
    for share in range(moments.shape[1]):
        s += moments[e, share]
        H += correlation[e, share]
    fit = fit_prop(prop, x, u, vk, e, s)
    own = Rigid()
    own.mass = fit.mass
    own.center = fit.center
    own.inertia = fit.inertia
    velocity = fit.velocity
    spin = fit.spin
    start = vec8(velocity[0], velocity[1], velocity[2], spin[0], spin[1], spin[2], 0.0, 0.0)
    motion = start
    core.center[e] = own.center
    near = bool(False)
    for n in range(thin.shape[0]):
        b = thin[n]
        turning = wp.length(spin) + wp.length(boundaries.spin[row(e, boundaries.spin.shape[0]), b])
        closing = wp.length(velocity - surface_velocity(boundaries, e, b, own.center)) + core.reach * turning
        if signed_distance(boundaries, e, b, own.center)[3] < core.reach + step.dt * closing:
            near = True
    stops = int(0)
    turn = wp.mat33()
    if near:
        stops = MOST_STOPS
        turn = kabsch_rotation(H)
    for _ in range(stops):
        most = float(TOLERANCE)
        which = int(-1)
        for n in range(thin.shape[0] * core.balls.shape[0]):
            ball = core.balls[n % core.balls.shape[0]]
            b = thin[n // core.balls.shape[0]]
            touch = touch_of_core(grid, step, boundaries, e, b, ball, turn, own.center, motion)
            lacking = touch.least - wp.dot(touch.velocity, touch.normal)
            if lacking > most:
                most = lacking
                which = n
        if which < 0:
            break
        b = thin[which // core.balls.shape[0]]
        ball = core.balls[which % core.balls.shape[0]]
        touch = touch_of_core(grid, step, boundaries, e, b, ball, turn, own.center, motion)
        friction = boundaries.friction[row(e, boundaries.friction.shape[0]), field * boundaries.count + b]
        mobility = response_at(own, touch.place, touch.place)
        p = stopping_impulse(mobility, touch.velocity, touch.normal, touch.least, friction)
        turned = spin_of(own.inertia, wp.cross(touch.place - own.center, p))
        v = p / own.mass
        motion += vec8(v[0], v[1], v[2], turned[0], turned[1], turned[2], 0.0, 0.0)
        subject = contact.subject[field]
        add_impulse(sensors, e, boundary_entry(sensors, subject), p)
        add_impulse(sensors, e, moment_entry(sensors, subject), wp.cross(touch.place, p))
    core.change[e] = motion - start


@wp.kernel
def apply_change(
    prop: Prop,
    core: Core,
    x: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
):
    """Give every particle of a prop the change of its rigid motion; over ``(num_envs, count)``."""
    e, p = wp.tid()
    change = core.change[e]
    if failure[e] == 0 and wp.length_sq(change) > 0.0:
        q = prop.first + p
        u[e, q] = u[e, q] + motion_at(change, x[e, q] - core.center[e])
