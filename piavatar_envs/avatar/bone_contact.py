"""Bones stop at boundaries: contact in joint space, for what the grid cannot stop.

Contact on the grid stops the matter that is near a surface. Of a limb that falls on the floor that is a little soft
flesh, and its bones go on through it. So bones have contact of their own. Points of theirs, the particles that track
them, come no closer to a boundary than a thin layer of flesh that cannot be squeezed further: a bone may approach it in
a substep by what there is left, and no more.

An impulse ``p`` at a point of a bone changes the joints' velocities by ``M^-1 J^T p``, ``J`` the Jacobian of the point,
and the point's own by ``K p``, ``K = J M^-1 J^T``. It is the least that stops the point, by Coulomb's law: it sticks if
the impulse is in the friction cone, else friction is against the slip that there would be without, as strong as the
cone allows but no stronger than what halts it. ``M`` is that of all that is implicit, springs and dampers included: so
these answer to a bone that is stopped as they do to any load. Of all points the one that is too fast by most is
stopped, then the next, until none is left or there have been :data:`MOST_STOPS` (Gauss and Southwell's order; for
contact of articulated bodies in such coordinates see Featherstone, "Rigid Body Dynamics Algorithms", 2008, ch. 11). No
point is pulled, and where nothing has come below a boundary at rest no energy is made.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.blending import motion_at
from piavatar_envs.avatar.cholesky import solve_three_in_place
from piavatar_envs.avatar.joint_bench import JointBench
from piavatar_envs.avatar.joint_motion import part_of, set_part, spread_motion
from piavatar_envs.avatar.lanes import bits_of_threads, meet_threads, most_of_threads, sum_threads12
from piavatar_envs.avatar.loads import vector_at
from piavatar_envs.avatar.mass_matrix import BONES, NUM_DOF
from piavatar_envs.avatar.types import Body, vec8, vec12
from piavatar_envs.mpm.colliders import signed_distance, surface_velocity
from piavatar_envs.mpm.impulses import add_impulse, boundary_entry, moment_entry
from piavatar_envs.mpm.types import Boundaries, Sensors, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Flesh that is left between a bone and a boundary [m].
LAYER = 0.001
#: Impulses in a substep, at most.
MOST_STOPS = 8
_LAYER, _MOST_STOPS = wp.constant(LAYER), wp.constant(MOST_STOPS)
#: A point that has come closer goes back by a share of that in a substep, no faster than at a speed [m/s].
_BACK_SHARE, _BACK_SPEED = wp.constant(0.2), wp.constant(0.5)
#: Speeds below are none [m/s].
_TOLERANCE = wp.constant(1.0e-3)
#: Share of the straight answer along the normal below which friction would jam a point: then it has none.
_JAMMED = wp.constant(0.1)


@wp.struct
class Ground:
    """What bones may meet, and who is told."""

    solid: int  # whether bones stop at all
    boundaries: Boundaries
    field: wp.array(dtype=int)  # (num_particles,) velocity field, whose friction it is
    subject: wp.array(dtype=int)  # (fields,) of a field
    sensors: Sensors


@wp.struct
class Touch:
    """A point of a bone and a boundary."""

    place: wp.vec3  # [m]
    normal: wp.vec3
    distance: float  # [m]
    velocity: wp.vec3  # against the boundary's matter [m/s]


@wp.func
def at_rest(body: Body, e: int, b: int, tracker: int):
    """From a joint to a point of its bone in the rest pose [m]; the point by its place in the list of trackers."""
    joint = body.rest_joint[row(e, body.rest_joint.shape[0]), b]
    return vector_at(body.rest, row(e, body.rest.shape[0]), body.tracker[tracker]) - joint


@wp.func
def measure_bones(body: Body, e: int, thread: int, threads: int, w: JointBench):
    """How far bones reach, of the body as it is: another one may have been drawn."""
    for b in range(thread, BONES, threads):
        reach = float(0.0)
        for tracker in range(body.tracker_start[b], body.tracker_start[b + 1]):
            reach = wp.max(reach, wp.length(at_rest(body, e, b, tracker)))
        w.reach[e, b] = reach


@wp.func
def motion_of_bone(w: JointBench, e: int, b: int, x: wp.vec3):
    """Velocity of a bone's matter at ``x`` [m/s]."""
    return motion_at(w.moving[e, b], x - w.pose.position[e, 0])


@wp.func
def touch_of(body: Body, boundaries: Boundaries, w: JointBench, e: int, b: int, tracker: int, k: int) -> Touch:
    """A point of bone ``b``, by its place in the list of trackers, and boundary ``k``."""
    touch = Touch()
    touch.place = w.pose.position[e, b] + wp.quat_rotate(w.pose.rotation[e, b], at_rest(body, e, b, tracker))
    d = signed_distance(boundaries, e, k, touch.place)
    touch.normal = wp.vec3(d[0], d[1], d[2])
    touch.distance = d[3]
    touch.velocity = motion_of_bone(w, e, b, touch.place) - surface_velocity(boundaries, e, k, touch.place)
    return touch


@wp.func
def least_speed(distance: float, dt: float):
    """With which a point may go, away from a boundary [m/s]: it may come to the layer, or goes back to it."""
    way = _LAYER - distance
    if way < 0.0:
        return way / dt
    return wp.min(_BACK_SHARE * way / dt, _BACK_SPEED)


@wp.func
def may_touch(boundaries: Boundaries, dt: float, w: JointBench, e: int, b: int, k: int):
    """Whether any point of a bone may come to a boundary in a substep."""
    reach = w.reach[e, b]
    joint = w.pose.position[e, b]
    motion = w.moving[e, b]
    turn = wp.length(wp.vec3(motion[3], motion[4], motion[5]))
    turn += wp.length(boundaries.spin[row(e, boundaries.spin.shape[0]), k])
    speed = wp.length(motion_of_bone(w, e, b, joint) - surface_velocity(boundaries, e, k, joint)) + reach * turn
    return signed_distance(boundaries, e, k, joint)[3] < reach + _LAYER + dt * speed


@wp.func
def find_near(ground: Ground, dt: float, e: int, thread: int, threads: int, w: JointBench):
    """Bits of the bones that may touch a boundary."""
    near = int(0)
    for b in range(thread, BONES, threads):
        for k in range(ground.boundaries.count):
            if may_touch(ground.boundaries, dt, w, e, b, k):
                near = near | (1 << b)
    return bits_of_threads(near, threads)


@wp.func
def find_fastest(body: Body, ground: Ground, dt: float, e: int, thread: int, threads: int, w: JointBench) -> wp.vec2:
    """By how much the point is too fast that is so by most [m/s], and which: tracker times boundaries, and boundary.

    Few bones are near a boundary: the threads share the points of one after the other.
    """
    most = float(0.0)
    which = int(0)
    count = ground.boundaries.count
    near = find_near(ground, dt, e, thread, threads, w)
    b = int(0)
    while near != 0:
        if (near & 1) != 0:
            for tracker in range(body.tracker_start[b] + thread, body.tracker_start[b + 1], threads):
                for k in range(count):
                    touch = touch_of(body, ground.boundaries, w, e, b, tracker, k)
                    lacking = least_speed(touch.distance, dt) - wp.dot(touch.velocity, touch.normal)
                    if lacking > most:
                        most = lacking
                        which = tracker * count + k
        near = near >> 1
        b += 1
    return most_of_threads(most, which, threads)


@wp.func
def carries(body: Body, a: int, b: int):
    """1 if joint ``a`` moves bone ``b``, else 0."""
    above = int(b)
    while above > a:  # children come after their parents
        above = body.parent[above]
    return wp.where(above == a, 1.0, 0.0)


@wp.func
def answer_at(
    body: Body, factor: int, e: int, b: int, x: wp.vec3, thread: int, threads: int, room: wp.uint64, w: JointBench
) -> wp.mat33:
    """``K`` of bone ``b`` at ``x`` [1/kg]; rows of ``w.touch`` have ``M^-1 J^T`` of an impulse along each axis."""
    n = w.velocity.shape[0]
    meet_threads(threads)
    for a in range(thread, BONES, threads):
        arm = carries(body, a, b) * (x - w.pose.position[e, a])
        for axis in range(3):
            along = wp.vec3()
            along[axis] = 1.0
            set_part(w.touch, axis * n + e, 3 + 3 * a, wp.cross(arm, along))
            if a == 0:
                set_part(w.touch, axis * n + e, 0, along)
    solve_three_in_place(w.pattern, w.factors, factor, e, n, threads, room, w.touch)
    meet_threads(threads)
    s = vec12()
    for a in range(thread, BONES, threads):
        arm = carries(body, a, b) * (x - w.pose.position[e, a])
        for axis in range(3):
            v = wp.cross(part_of(w.touch, axis * n + e, 3 + 3 * a), arm)
            if a == 0:
                v += part_of(w.touch, axis * n + e, 0)
            for i in range(3):
                s[3 * axis + i] = s[3 * axis + i] + v[i]
    s = sum_threads12(s, threads)
    return wp.mat33(s[0], s[3], s[6], s[1], s[4], s[7], s[2], s[5], s[8])


@wp.func
def stopping_impulse(K: wp.mat33, v: wp.vec3, normal: wp.vec3, least: float, friction: float):
    """Impulse [N s] after which a point at ``v`` goes at ``least`` along the normal, by Coulomb's law."""
    stick = wp.inverse(K) * (least * normal - v)
    push = wp.dot(stick, normal)
    if wp.length(stick - push * normal) <= friction * push:
        return stick
    lacking = wp.max(least - wp.dot(v, normal), 0.0)
    straight = wp.dot(normal, K * normal)
    slip = v + lacking / straight * (K * normal)  # without friction, which is against it
    along = wp.normalize(slip - wp.dot(slip, normal) * normal)
    share = friction
    halting = wp.dot(along, v) * wp.dot(normal, K * along) + lacking * wp.dot(along, K * along)
    if halting > 0.0:  # more than halts the slip would turn it
        share = wp.min(friction, straight * wp.dot(along, slip) / halting)
    direction = normal - share * along
    answer = wp.dot(normal, K * direction)
    if answer < _JAMMED * straight:
        direction = normal
        answer = straight
    return lacking / answer * direction


@wp.func
def stop_point(
    body: Body,
    ground: Ground,
    dt: float,
    which: int,
    own: int,
    factor: int,
    e: int,
    thread: int,
    threads: int,
    room: wp.uint64,
    w: JointBench,
) -> vec8:
    """Stop a point as :func:`find_fastest` names it; the impulse, and its moment about the pelvis joint."""
    n = w.velocity.shape[0]
    boundaries = ground.boundaries
    k = which % boundaries.count
    tracker = which // boundaries.count
    b = int(0)
    while body.tracker_start[b + 1] <= tracker:
        b += 1
    touch = touch_of(body, boundaries, w, e, b, tracker, k)
    K = answer_at(body, factor, e, b, touch.place, thread, threads, room, w)
    field = ground.field[body.first + body.tracker[tracker]]
    friction = boundaries.friction[row(e, boundaries.friction.shape[0]), field * boundaries.count + k]
    p = stopping_impulse(K, touch.velocity, touch.normal, least_speed(touch.distance, dt), friction)
    for i in range(thread, NUM_DOF, threads):
        change = p[0] * w.touch[e, i] + p[1] * w.touch[n + e, i] + p[2] * w.touch[2 * n + e, i]
        w.touch[3 * n + e, i] = w.touch[3 * n + e, i] + change
        w.shares[own, i] = w.shares[own, i] + change
    moment = wp.cross(touch.place - w.pose.position[e, 0], p)
    return vec8(p[0], p[1], p[2], moment[0], moment[1], moment[2], 0.0, 0.0)


@wp.func
def stop_bones(
    body: Body,
    ground: Ground,
    dt: float,
    own: int,
    factor: int,
    e: int,
    thread: int,
    threads: int,
    room: wp.uint64,
    w: JointBench,
) -> vec8:
    """Let no bone go through a boundary: changes share ``own``, which the joints are about to add to their velocity.

    ``factor`` is the matrix's that it was solved with. The answer is the impulse [N s] and its moment about the pelvis
    joint [N m s].
    """
    given = vec8()
    if ground.solid == 0:
        return given
    total = 3 * w.velocity.shape[0] + e
    for i in range(thread, NUM_DOF, threads):
        w.touch[total, i] = w.velocity[e, i] + w.outside[e, i] + w.shares[own, i]
    stops = int(0)
    while stops < _MOST_STOPS:
        spread_motion(body, w.pose.position, w.touch, total, e, thread, threads, w.moving)
        meet_threads(threads)
        fastest = find_fastest(body, ground, dt, e, thread, threads, w)
        if fastest[0] <= _TOLERANCE:
            break
        given += stop_point(body, ground, dt, int(fastest[1]), own, factor, e, thread, threads, room, w)
        stops += 1
    meet_threads(threads)
    return given


@wp.func
def tell_sensors(body: Body, ground: Ground, given: vec8, e: int, pelvis: wp.vec3):
    """Add what boundaries gave the bones to what they gave the body."""
    p = wp.vec3(given[0], given[1], given[2])
    if wp.length_sq(p) > 0.0:
        subject = ground.subject[ground.field[body.first]]
        moment = wp.vec3(given[3], given[4], given[5]) + wp.cross(pelvis, p)
        add_impulse(ground.sensors, e, boundary_entry(ground.sensors, subject), p)
        add_impulse(ground.sensors, e, moment_entry(ground.sensors, subject), moment)
