"""Points of bones and boundaries: how fast a point may come, and which one is too fast by most.

Points are the particles that track a bone. They come no closer to a boundary than a thin layer of flesh that cannot be
squeezed further: one may approach it in a substep by what there is left. What is done about those that are too fast is
in :mod:`piavatar_envs.avatar.bone_contact`.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.blending import motion_at
from piavatar_envs.avatar.joint_bench import JointBench
from piavatar_envs.avatar.lanes import bits_of_threads, most_of_threads
from piavatar_envs.avatar.loads import vector_at
from piavatar_envs.avatar.mass_matrix import BONES
from piavatar_envs.avatar.types import Body
from piavatar_envs.mpm.colliders import PLANE, signed_distance, surface_velocity
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
def reach_along(half: wp.vec3, turn: wp.quat, n: wp.vec3):
    """The greatest component along ``n`` of what is in a box of half extents ``half`` about the origin, turned."""
    own = wp.quat_rotate_inv(turn, n)
    return wp.dot(half, wp.abs(own))


@wp.func
def may_lack(boundaries: Boundaries, dt: float, w: JointBench, e: int, b: int, k: int):
    """Whether any point of a bone may be too fast for a boundary, by the box that holds them.

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
def find_near(ground: Ground, dt: float, e: int, thread: int, threads: int, w: JointBench):
    """Bits of the bones of which points may be too fast."""
    near = int(0)
    for b in range(thread, BONES, threads):
        for k in range(ground.boundaries.count):
            if may_lack(ground.boundaries, dt, w, e, b, k):
                near = near | (1 << b)
    return bits_of_threads(near, threads)


@wp.func
def find_fastest(body: Body, ground: Ground, dt: float, e: int, thread: int, threads: int, w: JointBench) -> wp.vec2:
    """By how much the point is too fast that is so by most [m/s], and which: point, bone and boundary in a number.

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
    return most_of_threads(most, which, threads)
