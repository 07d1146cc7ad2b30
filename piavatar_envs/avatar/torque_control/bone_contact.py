"""Bone contact: boundaries stop bones by impulses in joint space, where contact on the grid cannot.

Contact on the grid stops the matter near a surface. Of a limb that falls on the floor this is a little soft flesh,
which its bones would pass through. Therefore points of bones, the particles that track them, have contact of their own:
a thin layer of flesh between bone and boundary is incompressible, and a point may approach the boundary in a substep by
the remaining distance to this layer.

An impulse ``p`` at a point changes the joints' velocities by ``M^-1 J^T p``, with the Jacobian ``J`` of the point, and
the point's own velocity by ``W p``, with the mobility ``W = J M^-1 J^T``. ``M`` includes everything implicit, so
springs and dampers respond to a stopped bone as to any load. The impulse is the least that stops the point under
Coulomb's law: the point sticks if that impulse is in the friction cone; otherwise friction opposes the slip of the
frictionless solution, as strong as the cone allows but no stronger than what halts the slip. The point that violates
its bound most is stopped first, then the next, until none is left or :data:`MOST_STOPS` is reached (the Gauss-Southwell
order; for contact of articulated bodies in joint space see Featherstone, "Rigid Body Dynamics Algorithms", 2008, ch.
11). Impulses never pull, and add no energy unless a point has come below a boundary at rest.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.bone_hulls import NOWHERE, rest_offset
from piavatar_envs.avatar.skinning import motion_at
from piavatar_envs.avatar.torque_control.joint_motion import set_triple, spread_motion, triple_of
from piavatar_envs.avatar.torque_control.mass_matrix import BONES, NUM_DOF
from piavatar_envs.avatar.torque_control.tree_cholesky import begin_solution, end_solution
from piavatar_envs.avatar.torque_control.workspace import TorqueWorkspace, place_of_triple, row_in_arena, view_columns
from piavatar_envs.avatar.types import Body
from piavatar_envs.core.arrays import vec8
from piavatar_envs.core.cuda_intrinsics import max_of_threads, or_of_threads, sum_threads6, sync_threads
from piavatar_envs.mpm.colliders import PLANE, signed_distance, surface_velocity
from piavatar_envs.mpm.contact_sensors import add_impulse, boundary_entry, moment_entry
from piavatar_envs.mpm.types import Boundaries, Sensors, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


#: Thickness of the incompressible layer between a bone and a boundary [m].
LAYER = 0.001
_LAYER = wp.constant(LAYER)
#: A point within the layer moves out by this share of its depth in a substep, at no more than this speed [m/s].
_BACK_SHARE, _BACK_SPEED = wp.constant(0.2), wp.constant(0.5)
#: Violations below this speed are ignored [m/s].
TOLERANCE = wp.constant(1.0e-3)
_FAR = wp.constant(1.0e3)  # farther than any point of a bone from its joint [m]


@wp.struct
class Ground:
    """Boundaries and sensors of bone contact."""

    solid: int  # whether bones stop at all
    boundaries: Boundaries
    # (num_envs, bones * boundaries) deepest point of a bone in a boundary, see piavatar_envs.avatar.bone_hulls [m];
    # without columns where all are planes
    deepest: wp.array2d(dtype=wp.vec3)
    field: wp.array(dtype=int)  # (num_particles,) velocity field, which selects the friction
    subject: wp.array(dtype=int)  # (fields,) sensor subject of a field
    sensors: Sensors


@wp.struct
class Touch:
    """Contact of a point of a bone with a boundary."""

    place: wp.vec3  # [m]
    normal: wp.vec3
    distance: float  # [m]
    velocity: wp.vec3  # relative to the boundary's surface [m/s]


@wp.func
def measure_bones(body: Body, hulls: int, e: int, thread: int, threads: int, w: TorqueWorkspace):
    """Compute the bounding boxes of the bones' points, for the current body; of their ``hulls`` if not 0."""
    r = row(e, body.rest_joint.shape[0])
    for b in range(thread, BONES, threads):
        low = wp.vec3(_FAR)
        high = wp.vec3(-_FAR)
        for tracker in range(body.tracker_start[b], body.tracker_start[b + 1]):
            point = rest_offset(body, e, b, tracker)
            low = wp.min(low, point)
            high = wp.max(high, point)
        if hulls != 0:
            for child in range(b, BONES):  # children come after their parents
                if child == b or body.parent[child] == b:
                    point = body.rest_joint[r, child] - body.rest_joint[r, b]
                    low = wp.min(low, point)
                    high = wp.max(high, point)
        w.middle[e, b] = 0.5 * (low + high)
        w.half[e, b] = 0.5 * (high - low)  # negative for a bone without points


@wp.func
def motion_of_bone(w: TorqueWorkspace, e: int, b: int, x: wp.vec3):
    """Return the velocity of a bone at ``x`` [m/s]."""
    return motion_at(w.moving[e, b], x - w.pose.position[e, 0])


@wp.func
def touch_of(body: Body, boundaries: Boundaries, w: TorqueWorkspace, e: int, b: int, tracker: int, k: int) -> Touch:
    """Return the contact of a point of bone ``b``, by its tracker index, with boundary ``k``."""
    place = w.pose.position[e, b] + wp.quat_rotate(w.pose.rotation[e, b], rest_offset(body, e, b, tracker))
    return touch_at(boundaries, w, e, b, place, k)


@wp.func
def touch_at(boundaries: Boundaries, w: TorqueWorkspace, e: int, b: int, place: wp.vec3, k: int) -> Touch:
    """Return the contact of bone ``b`` at ``place`` with boundary ``k``."""
    touch = Touch()
    touch.place = place
    d = signed_distance(boundaries, e, k, touch.place)
    touch.normal = wp.vec3(d[0], d[1], d[2])
    touch.distance = d[3]
    touch.velocity = motion_of_bone(w, e, b, touch.place) - surface_velocity(boundaries, e, k, touch.place)
    return touch


@wp.func
def nth_touch(body: Body, ground: Ground, w: TorqueWorkspace, e: int, b: int, n: int, k: int) -> Touch:
    """Return the contact of point ``n`` of bone ``b`` with boundary ``k``; beyond the last, of its deepest point."""
    tracker = body.tracker_start[b] + n
    if tracker < body.tracker_start[b + 1]:
        return touch_of(body, ground.boundaries, w, e, b, tracker, k)
    place = ground.deepest[e, b * ground.boundaries.count + k]
    if place[0] >= NOWHERE:
        return Touch(place, wp.vec3(), NOWHERE, wp.vec3())
    return touch_at(ground.boundaries, w, e, b, place, k)


@wp.func
def least_speed(distance: float, dt: float):
    """Return the least allowed normal velocity [m/s]: a point may reach the layer, or must move out of it."""
    way = _LAYER - distance
    if way < 0.0:
        return way / dt
    return wp.min(_BACK_SHARE * way / dt, _BACK_SPEED)


@wp.func
def reach_along(half: wp.vec3, turn: wp.quat, n: wp.vec3):
    """Return the greatest component along ``n`` in a box of half extents ``half``, rotated about the origin."""
    own = wp.quat_rotate_inv(turn, n)
    return wp.dot(half, wp.abs(own))


@wp.func
def may_violate(boundaries: Boundaries, dt: float, w: TorqueWorkspace, e: int, b: int, k: int):
    """Return whether any point of a bone may violate its bound at a boundary, from the bone's bounding box.

    For a boundary that is not a plane, whose normals vary, the test uses the sphere around the box, and speeds.
    """
    half = w.half[e, b]
    turn = w.pose.rotation[e, b]
    middle = w.pose.position[e, b] + wp.quat_rotate(turn, w.middle[e, b])
    motion = w.moving[e, b]
    spin = wp.vec3(motion[3], motion[4], motion[5]) - boundaries.spin[row(e, boundaries.spin.shape[0]), k]
    velocity = motion_of_bone(w, e, b, middle) - surface_velocity(boundaries, e, k, middle)
    d = signed_distance(boundaries, e, k, middle)
    normal = wp.vec3(d[0], d[1], d[2])
    reach = wp.length(half)
    least = -wp.length(velocity) - reach * wp.length(spin)
    if boundaries.kind[k] == PLANE:
        reach = reach_along(half, turn, normal)
        least = wp.dot(velocity, normal) - reach_along(half, turn, wp.cross(normal, spin))
    return half[0] >= 0.0 and least_speed(d[3] - reach, dt) - least > TOLERANCE


@wp.func
def find_near(ground: Ground, dt: float, e: int, thread: int, threads: int, w: TorqueWorkspace):
    """Return the bits of the bones with points that may violate their bounds."""
    near = int(0)
    for b in range(thread, BONES, threads):
        for k in range(ground.boundaries.count):
            if may_violate(ground.boundaries, dt, w, e, b, k):
                near = near | (1 << b)
    return or_of_threads(near, threads)


@wp.func
def find_fastest(
    body: Body, ground: Ground, dt: float, e: int, thread: int, threads: int, w: TorqueWorkspace
) -> wp.vec2:
    """Return the greatest violation [m/s], and point, bone and boundary of it as one number.

    Few bones are near a boundary, so the threads share the points of one bone after the other. The number is below
    2^24, hence exact in single precision.
    """
    most = float(0.0)
    which = int(0)
    count = ground.boundaries.count
    near = find_near(ground, dt, e, thread, threads, w)
    b = int(0)
    while near != 0:
        if (near & 1) != 0:
            points = body.tracker_start[b + 1] - body.tracker_start[b]
            for n in range(thread, points + wp.min(ground.deepest.shape[1], 1), threads):
                for k in range(count):
                    touch = nth_touch(body, ground, w, e, b, n, k)
                    lacking = least_speed(touch.distance, dt) - wp.dot(touch.velocity, touch.normal)
                    if lacking > most:
                        most = lacking
                        which = (n * BONES + b) * count + k
        near = near >> 1
        b += 1
    return max_of_threads(most, which, threads)


#: Triples of a generalised velocity: the pelvis' position, then all joints.
TRIPLES = wp.constant(1 + int(BONES))
#: Most impulses in a substep.
MOST_STOPS = 8
_MOST_STOPS = wp.constant(MOST_STOPS)
#: If friction reduces the normal response to less than this share, the point would jam: then it has no friction.
_JAMMED = wp.constant(0.1)


@wp.func
def moves_bone(body: Body, a: int, b: int):
    """Return 1 if joint ``a`` moves bone ``b``, else 0."""
    above = int(b)
    while above > a:  # children come after their parents
        above = body.parent[above]
    return wp.where(above == a, 1.0, 0.0)


@wp.func
def mobility_at(
    body: Body, factor: int, e: int, b: int, x: wp.vec3, thread: int, threads: int, arena: wp.uint64, w: TorqueWorkspace
) -> wp.mat33:
    """Compute the mobility ``W = Y^T Y`` of bone ``b`` at ``x`` [1/kg].

    ``Y = L^-T J^T`` stays in the columns. ``J^T`` has entries for the joints that carry the bone; because ``L`` follows
    the tree, ``Y`` has few others.
    """
    n = w.velocity.shape[0]
    wanted = w.pattern.reach[1 + b]
    columns = view_columns(w.touch, arena)
    sync_threads(threads)
    for k in range(thread, TRIPLES, threads):
        arm = wp.vec3()
        if k > 0:
            arm = moves_bone(body, k - 1, b) * (x - w.pose.position[e, wp.max(k - 1, 0)])
        for axis in range(3):
            along = wp.vec3()
            along[axis] = 1.0
            if k > 0:  # the pelvis' position has unit columns
                along = wp.cross(arm, along)
            set_triple(columns, row_in_arena(axis * n + e, axis), place_of_triple(k), along)
    begin_solution(w.pattern, w.factors, factor, wanted, e, n, threads, arena, w.touch)
    sync_threads(threads)
    s = vec8()
    for k in range(thread, TRIPLES, threads):
        if (wanted >> k) & 1 == 1:
            y = wp.mat33()
            for axis in range(3):
                y[axis] = triple_of(columns, row_in_arena(axis * n + e, axis), place_of_triple(k))
            s += vec8(
                wp.dot(y[0], y[0]), wp.dot(y[1], y[1]), wp.dot(y[2], y[2]),
                wp.dot(y[1], y[2]), wp.dot(y[0], y[2]), wp.dot(y[0], y[1]), 0.0, 0.0,
            )  # fmt: skip
    s = sum_threads6(s, threads)
    return wp.mat33(s[0], s[5], s[4], s[5], s[1], s[3], s[4], s[3], s[2])


@wp.func
def apply_impulse(
    p: wp.vec3, b: int, own: int, factor: int, e: int, thread: int, threads: int, arena: wp.uint64, w: TorqueWorkspace
):
    """Apply impulse ``p`` to bone ``b`` at the point of the columns ``Y``: ``M^-1 J^T p = L^-1 Y p``."""
    n = w.velocity.shape[0]
    wanted = w.pattern.reach[1 + b]
    columns = view_columns(w.touch, arena)
    for k in range(thread, TRIPLES, threads):
        y = wp.vec3()
        if (wanted >> k) & 1 == 1:
            for axis in range(3):
                y += p[axis] * triple_of(columns, row_in_arena(axis * n + e, axis), place_of_triple(k))
        set_triple(columns, row_in_arena(e, 0), place_of_triple(k), y)
    end_solution(w.pattern, w.factors, factor, e, threads, arena, w.touch)
    sync_threads(threads)
    for k in range(thread, TRIPLES, threads):
        change = triple_of(columns, row_in_arena(e, 0), place_of_triple(k))
        set_triple(w.whole, e, 3 * k, triple_of(w.whole, e, 3 * k) + change)
        set_triple(w.shares, own, 3 * k, triple_of(w.shares, own, 3 * k) + change)


@wp.func
def stopping_impulse(mobility: wp.mat33, v: wp.vec3, normal: wp.vec3, least: float, friction: float):
    """Return the impulse [N s] that gives a point of velocity ``v`` the normal velocity ``least``, by Coulomb's law."""
    stick = wp.inverse(mobility) * (least * normal - v)
    push = wp.dot(stick, normal)
    if wp.length(stick - push * normal) <= friction * push:
        return stick
    lacking = wp.max(least - wp.dot(v, normal), 0.0)
    straight = wp.dot(normal, mobility * normal)
    slip = v + lacking / straight * (mobility * normal)  # the frictionless slip, which friction opposes
    along = wp.normalize(slip - wp.dot(slip, normal) * normal)
    share = friction
    halting = wp.dot(along, v) * wp.dot(normal, mobility * along) + lacking * wp.dot(along, mobility * along)
    if halting > 0.0:  # more friction than halts the slip would reverse it
        share = wp.min(friction, straight * wp.dot(along, slip) / halting)
    direction = normal - share * along
    answer = wp.dot(normal, mobility * direction)
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
    arena: wp.uint64,
    w: TorqueWorkspace,
) -> vec8:
    """Stop the point that :func:`find_fastest` returned; return the impulse and its moment about the pelvis joint."""
    boundaries = ground.boundaries
    k = which % boundaries.count
    b = which // boundaries.count % BONES
    n = which // (boundaries.count * BONES)
    touch = nth_touch(body, ground, w, e, b, n, k)
    mobility = mobility_at(body, factor, e, b, touch.place, thread, threads, arena, w)
    tracker = wp.min(body.tracker_start[b] + n, body.tracker_start[b + 1] - 1)
    field = ground.field[body.first + body.tracker[tracker]]
    friction = boundaries.friction[row(e, boundaries.friction.shape[0]), field * boundaries.count + k]
    p = stopping_impulse(mobility, touch.velocity, touch.normal, least_speed(touch.distance, dt), friction)
    apply_impulse(p, b, own, factor, e, thread, threads, arena, w)
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
    arena: wp.uint64,
    w: TorqueWorkspace,
) -> vec8:
    """Stop bones at boundaries: correct share ``own``, the velocity change that the joints are about to make.

    ``factor`` is the factor that the share was solved with. Returns the sum of the impulses [N s] and their moment
    about the pelvis joint [N m s].
    """
    given = vec8()
    if ground.solid == 0:
        return given
    for i in range(thread, NUM_DOF, threads):
        w.whole[e, i] = w.velocity[e, i] + w.outside[e, i] + w.shares[own, i]
        if w.reference.shape[0] > 0:
            w.whole[e, i] = w.whole[e, i] + w.reference[e, i]
    stops = int(0)
    while stops < _MOST_STOPS:
        spread_motion(body, w.pose.position, w.whole, e, e, thread, threads, w.moving)
        sync_threads(threads)
        fastest = find_fastest(body, ground, dt, e, thread, threads, w)
        if fastest[0] <= TOLERANCE:
            break
        given += stop_point(body, ground, dt, int(fastest[1]), own, factor, e, thread, threads, arena, w)
        stops += 1
    sync_threads(threads)
    return given


@wp.func
def add_to_sensors(body: Body, ground: Ground, given: vec8, e: int, pelvis: wp.vec3):
    """Add the impulses on bones to the sensors of the body's boundary contact."""
    p = wp.vec3(given[0], given[1], given[2])
    if wp.length_sq(p) > 0.0:
        subject = ground.subject[ground.field[body.first]]
        moment = wp.vec3(given[3], given[4], given[5]) + wp.cross(pelvis, p)
        add_impulse(ground.sensors, e, boundary_entry(ground.sensors, subject), p)
        add_impulse(ground.sensors, e, moment_entry(ground.sensors, subject), moment)
