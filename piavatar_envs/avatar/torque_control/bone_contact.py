"""Points of bones and boundaries: how fast a point may come, and which one is too fast by most.

Points are the particles that track a bone. They come no closer to a boundary than a thin layer of flesh that cannot be
squeezed further: one may approach it in a substep by what there is left. What is done about those that are too fast is
in :mod:`piavatar_envs.avatar.torque_control.bone_contact`.

Bones stop at boundaries: contact in joint space, for what the grid cannot stop.

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

from piavatar_envs.avatar.skinning import motion_at
from piavatar_envs.avatar.torque_control.dynamics import set_triple, spread_motion, triple_of
from piavatar_envs.avatar.torque_control.mass_matrix import BONES, NUM_DOF
from piavatar_envs.avatar.torque_control.tree_cholesky import begin_solution, end_solution
from piavatar_envs.avatar.torque_control.workspace import TorqueWorkspace, place_of_triple, row_in_arena, view_columns
from piavatar_envs.avatar.types import Body
from piavatar_envs.core.arrays import vec8, vector_at
from piavatar_envs.core.cuda_intrinsics import max_of_threads, or_of_threads, sum_threads6, sync_threads
from piavatar_envs.mpm.colliders import PLANE, signed_distance, surface_velocity
from piavatar_envs.mpm.contact_sensors import add_impulse, boundary_entry, moment_entry
from piavatar_envs.mpm.types import Boundaries, Sensors, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


#: Flesh that is left between a bone and a boundary [m].
LAYER = 0.001
_LAYER = wp.constant(LAYER)
#: A point that has come closer goes back by a share of that in a substep, no faster than at a speed [m/s].
_BACK_SHARE, _BACK_SPEED = wp.constant(0.2), wp.constant(0.5)
#: Speeds below are none [m/s].
TOLERANCE = wp.constant(1.0e-3)
_FAR = wp.constant(1.0e3)  # no point of a bone is as far from its joint [m]


@wp.struct
class Ground:
    """Boundaries that bones may meet, and sensors."""

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
    """Return the offset from a joint to a point of its bone in the rest pose [m]; the point by its tracker index."""
    joint = body.rest_joint[row(e, body.rest_joint.shape[0]), b]
    return vector_at(body.rest, row(e, body.rest.shape[0]), body.tracker[tracker]) - joint


@wp.func
def measure_bones(body: Body, e: int, thread: int, threads: int, w: TorqueWorkspace):
    """Find boxes that hold the points of bones, of the body as it is: another one may have been drawn."""
    for b in range(thread, BONES, threads):
        low = wp.vec3(_FAR)
        high = wp.vec3(-_FAR)
        for tracker in range(body.tracker_start[b], body.tracker_start[b + 1]):
            point = at_rest(body, e, b, tracker)
            low = wp.min(low, point)
            high = wp.max(high, point)
        w.middle[e, b] = 0.5 * (low + high)
        w.half[e, b] = 0.5 * (high - low)  # below zero where there are no points


@wp.func
def motion_of_bone(w: TorqueWorkspace, e: int, b: int, x: wp.vec3):
    """Return the velocity of a bone's matter at ``x`` [m/s]."""
    return motion_at(w.moving[e, b], x - w.pose.position[e, 0])


@wp.func
def touch_of(body: Body, boundaries: Boundaries, w: TorqueWorkspace, e: int, b: int, tracker: int, k: int) -> Touch:
    """Return the contact of a point of bone ``b``, by its tracker index, with boundary ``k``."""
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
def reach_along(half: wp.vec3, turn: wp.quat, n: wp.vec3):
    """Return the greatest component along ``n`` within a turned box of half extents ``half`` about the origin."""
    own = wp.quat_rotate_inv(turn, n)
    return wp.dot(half, wp.abs(own))


@wp.func
def may_lack(boundaries: Boundaries, dt: float, w: TorqueWorkspace, e: int, b: int, k: int):
    """Return whether any point of a bone may be too fast for a boundary, by the box that holds them.

    A boundary that is no plane has other normals elsewhere: there it is by the ball around the box, and by speeds.
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
    """Bits of the bones of which points may be too fast."""
    near = int(0)
    for b in range(thread, BONES, threads):
        for k in range(ground.boundaries.count):
            if may_lack(ground.boundaries, dt, w, e, b, k):
                near = near | (1 << b)
    return or_of_threads(near, threads)


@wp.func
def find_fastest(
    body: Body, ground: Ground, dt: float, e: int, thread: int, threads: int, w: TorqueWorkspace
) -> wp.vec2:
    """Find the point that is too fast by most: by how much [m/s], and point, bone and boundary as one number.

    Few bones come near a boundary: the threads share the points of one after the other. The number is exact in single
    precision, below 2^24.
    """
    most = float(0.0)
    which = int(0)
    count = ground.boundaries.count
    near = find_near(ground, dt, e, thread, threads, w)
    b = int(0)
    while near != 0:
        if (near & 1) != 0:
            first = body.tracker_start[b]
            for n in range(thread, body.tracker_start[b + 1] - first, threads):
                for k in range(count):
                    touch = touch_of(body, ground.boundaries, w, e, b, first + n, k)
                    lacking = least_speed(touch.distance, dt) - wp.dot(touch.velocity, touch.normal)
                    if lacking > most:
                        most = lacking
                        which = (n * BONES + b) * count + k
        near = near >> 1
        b += 1
    return max_of_threads(most, which, threads)


#: The pelvis' place, then all joints.
TRIPLES = wp.constant(1 + int(BONES))
#: Impulses in a substep, at most.
MOST_STOPS = 8
_MOST_STOPS = wp.constant(MOST_STOPS)
#: Share of the straight answer along the normal below which friction would jam a point: then it has none.
_JAMMED = wp.constant(0.1)


@wp.func
def carries(body: Body, a: int, b: int):
    """Return 1 if joint ``a`` moves bone ``b``, else 0."""
    above = int(b)
    while above > a:  # children come after their parents
        above = body.parent[above]
    return wp.where(above == a, 1.0, 0.0)


@wp.func
def answer_at(
    body: Body, factor: int, e: int, b: int, x: wp.vec3, thread: int, threads: int, arena: wp.uint64, w: TorqueWorkspace
) -> wp.mat33:
    """Compute ``K`` of bone ``b`` at ``x`` [1/kg], ``Y^T Y`` with ``Y = L^-T J^T``, which stays in the columns.

    ``J^T`` has something in joints that carry the bone, and ``Y`` hardly anywhere else: ``L`` is a tree's.
    """
    n = w.velocity.shape[0]
    wanted = w.pattern.reach[1 + b]
    columns = view_columns(w.touch, arena)
    sync_threads(threads)
    for k in range(thread, TRIPLES, threads):
        arm = wp.vec3()
        if k > 0:
            arm = carries(body, k - 1, b) * (x - w.pose.position[e, wp.max(k - 1, 0)])
        for axis in range(3):
            along = wp.vec3()
            along[axis] = 1.0
            if k > 0:  # else the pelvis' place
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
def push(
    p: wp.vec3, b: int, own: int, factor: int, e: int, thread: int, threads: int, arena: wp.uint64, w: TorqueWorkspace
):
    """Give bone ``b`` an impulse at the point that the columns are of: by ``M^-1 J^T p = L^-1 Y p``."""
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
def stopping_impulse(K: wp.mat33, v: wp.vec3, normal: wp.vec3, least: float, friction: float):
    """Return the impulse [N s] after which a point at ``v`` has ``least`` along the normal, by Coulomb's law."""
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
    arena: wp.uint64,
    w: TorqueWorkspace,
) -> vec8:
    """Stop a point as :func:`find_fastest` names it; the impulse, and its moment about the pelvis joint."""
    boundaries = ground.boundaries
    k = which % boundaries.count
    b = which // boundaries.count % BONES
    tracker = body.tracker_start[b] + which // (boundaries.count * BONES)
    touch = touch_of(body, boundaries, w, e, b, tracker, k)
    K = answer_at(body, factor, e, b, touch.place, thread, threads, arena, w)
    field = ground.field[body.first + body.tracker[tracker]]
    friction = boundaries.friction[row(e, boundaries.friction.shape[0]), field * boundaries.count + k]
    p = stopping_impulse(K, touch.velocity, touch.normal, least_speed(touch.distance, dt), friction)
    push(p, b, own, factor, e, thread, threads, arena, w)
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
    """Let no bone go through a boundary: changes share ``own``, which the joints are about to add to their velocity.

    ``factor`` is the matrix's that it was solved with. The answer is the impulse [N s] and its moment about the pelvis
    joint [N m s].
    """
    given = vec8()
    if ground.solid == 0:
        return given
    for i in range(thread, NUM_DOF, threads):
        w.whole[e, i] = w.velocity[e, i] + w.outside[e, i] + w.shares[own, i]
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
    """Add what boundaries gave the bones to what they gave the body."""
    p = wp.vec3(given[0], given[1], given[2])
    if wp.length_sq(p) > 0.0:
        subject = ground.subject[ground.field[body.first]]
        moment = wp.vec3(given[3], given[4], given[5]) + wp.cross(pelvis, p)
        add_impulse(ground.sensors, e, boundary_entry(ground.sensors, subject), p)
        add_impulse(ground.sensors, e, moment_entry(ground.sensors, subject), moment)
