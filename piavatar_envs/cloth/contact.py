"""Contact of cloth with the surfaces of bodies and props, with colliders and the floor.

The surface of an obstacle is curved by its normals: at weights ``b`` in a triangle with corners ``p_i`` and normals
``n_i``, over the flat point ``p``, it lies at ``p + 3/4 sum b_i ((p_i - p) . n_i) n_i`` (Boubekeur and Alexa, "Phong
Tessellation", 2008). A vertex has a slot for its wearer and one for all other pieces. Every few substeps a search walks
from the point that was nearest over neighboring points to the nearest one, and stores point, motion and normal of the
surface there; between searches the obstacle is this moving plane.

A vertex below its distance from the plane is moved out along the normal, and against its motion along the surface by at
most the friction coefficient times that, which is Coulomb's law: Macklin et al., "Unified particle physics for
real-time applications" (2014). Its velocity relative to the surface is at most ``pop`` outwards.

What a vertex loses of its momentum and of its angular momentum is booked at the three corners, in fixed point.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.cloth.obstacles import QUANTUM, Obstacles
from piavatar_envs.cloth.proxy import CURVATURE
from piavatar_envs.core.arrays import vector_at
from piavatar_envs.mpm.colliders import signed_distance, surface_velocity
from piavatar_envs.mpm.types import Boundaries

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_CURVATURE = wp.constant(CURVATURE)
#: Distance [m] from which a vertex may touch an obstacle until the next search, and the speed [m/s] that is added.
REACH, APPROACH = wp.constant(0.03), wp.constant(4.0)
_QUANTA = wp.constant(1.0 / QUANTUM)
#: Most points that a search visits.
_HOPS = wp.constant(64)
_FAR = wp.constant(1.0e30)
#: Shorter motion [m] is round-off.
_NO_LENGTH = wp.constant(1.0e-12)


@wp.struct
class Touches:
    """Contact slots, ``(B, slots * V)``: slot ``s`` of vertex ``i`` is ``s V + i``; workspace of a step, by row."""

    slots: int  # 1: the wearer; 2: all other pieces too
    triangle: wp.array2d(dtype=int)  # -1: none within reach
    weights: wp.array2d(dtype=wp.vec2)  # of its first two corners
    point: wp.array2d(dtype=wp.vec3)  # of the surface when searched [m]
    way: wp.array2d(dtype=wp.vec3)  # its motion in a substep [m]
    normal: wp.array2d(dtype=wp.vec3)
    impulse: wp.array2d(dtype=wp.vec3)  # on the obstacle since the search [N s]
    moment: wp.array2d(dtype=wp.vec3)  # its moment about ``point`` [N m s]
    near_collider: wp.array2d(dtype=int)  # (B, V) not 0: a collider is within reach


@wp.struct
class Pushed:
    """Motion of a vertex in a substep while obstacles push it."""

    z: wp.vec3  # position [m]
    u: wp.vec3  # velocity [m/s]
    way: wp.vec3  # motion in the substep [m]
    normal: wp.vec3  # of the last obstacle that pushed it, 0 for none
    squeezed: int  # not 0: an obstacle pushed it into another one


@wp.func
def curved_patch(a: wp.vec3, b: wp.vec3, c: wp.vec3, na: wp.vec3, nb: wp.vec3, nc: wp.vec3, w: wp.vec3):
    """Return point and unit normal of the curved surface over a triangle at weights ``w``."""
    p = w[0] * a + w[1] * b + w[2] * c
    lift = w[0] * wp.dot(a - p, na) * na + w[1] * wp.dot(b - p, nb) * nb + w[2] * wp.dot(c - p, nc) * nc
    return p + _CURVATURE * lift, wp.normalize(w[0] * na + w[1] * nb + w[2] * nc)


@wp.func
def weights_of_nearest(a: wp.vec3, b: wp.vec3, c: wp.vec3, p: wp.vec3):
    """Return the weights of the point of a triangle that is nearest to ``p``; Ericson, "Real-time collision detection".

    The triangle may be degenerate.
    """
    ab = b - a
    ac = c - a
    ap = p - a
    d1 = wp.dot(ab, ap)
    d2 = wp.dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return wp.vec3(1.0, 0.0, 0.0)
    bp = p - b
    d3 = wp.dot(ab, bp)
    d4 = wp.dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return wp.vec3(0.0, 1.0, 0.0)
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        t = d1 / (d1 - d3)
        return wp.vec3(1.0 - t, t, 0.0)
    cp = p - c
    d5 = wp.dot(ab, cp)
    d6 = wp.dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return wp.vec3(0.0, 0.0, 1.0)
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        t = d2 / (d2 - d6)
        return wp.vec3(1.0 - t, 0.0, t)
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return wp.vec3(0.0, 1.0 - t, t)
    s = 1.0 / (va + vb + vc)
    return wp.vec3(1.0 - (vb + vc) * s, vb * s, vc * s)


@wp.func
def obstacle_point(o: Obstacles, e: int, n: int, share: float):
    """Return a point of the obstacles [m] when ``share`` of the control step has passed."""
    start = vector_at(o.start, e, n)
    return start + share * (vector_at(o.end, e, n) - start)


@wp.func
def obstacle_normal(o: Obstacles, e: int, n: int, share: float):
    """Return the normal of a point of the obstacles, not of unit length, when ``share`` has passed."""
    start = vector_at(o.start_normal, e, n)
    return start + share * (vector_at(o.end_normal, e, n) - start)


@wp.func
def obstacle_patch(o: Obstacles, e: int, f: wp.vec3i, share: float, w: wp.vec3):
    """Return point and normal of the curved surface of a triangle when ``share`` has passed."""
    a = obstacle_point(o, e, f[0], share)
    b = obstacle_point(o, e, f[1], share)
    c = obstacle_point(o, e, f[2], share)
    na = obstacle_normal(o, e, f[0], share)
    nb = obstacle_normal(o, e, f[1], share)
    nc = obstacle_normal(o, e, f[2], share)
    p, n = curved_patch(a, b, c, na, nb, nc, w)
    return p, n


@wp.func
def walk(o: Obstacles, e: int, share: float, x: wp.vec3, start: int, sees: int):
    """Go from a point to its neighbor nearest to ``x`` until none is nearer; returns it and its squared distance."""
    at = int(start)
    best = float(wp.length_sq(x - obstacle_point(o, e, start, share)))
    for _ in range(_HOPS):
        to = int(at)
        for k in range(o.ring_start[at], o.ring_start[at + 1]):
            n = o.ring[k]
            if (o.part[n] & sees) != 0:
                distance = wp.length_sq(x - obstacle_point(o, e, n, share))
                if distance < best:
                    best = distance
                    to = n
        if to == at:
            break
        at = to
    return at, best


@wp.func
def nearest_post(o: Obstacles, e: int, share: float, x: wp.vec3, sees: int, piece: int, slot: int):
    """Return the post nearest to ``x``, of a piece for slot 0 and of all others for slot 1; -1 if there is none."""
    post = int(-1)
    best = float(_FAR)
    first = int(0)
    last = int(0)
    if piece >= 0:
        first = o.post_start[piece]
        last = o.post_start[piece + 1]
    begin = int(first)
    end = int(last)
    if slot == 1:
        begin = 0
        end = o.post.shape[0]
    for k in range(begin, end):
        if slot == 0 or k < first or k >= last:
            n = o.post[k]
            if (o.part[n] & sees) != 0:
                distance = wp.length_sq(x - obstacle_point(o, e, n, share))
                if distance < best:
                    best = distance
                    post = n
    return post


@wp.func
def nearest_point(
    o: Obstacles, e: int, share: float, x: wp.vec3, before: int, from_posts: bool, sees: int, piece: int, slot: int
):
    """Return the nearest point of the obstacles, found from the last one and, if ``from_posts``, from the posts.

    It is -1 if none is found.
    """
    at = int(-1)
    best = float(_FAR)
    if before >= 0 and before < o.part.shape[0]:  # noqa: SIM102 - a loaded state may hold anything, and both sides run
        if (o.part[before] & sees) != 0:
            near, distance = walk(o, e, share, x, before, sees)
            at = near
            best = distance
    if from_posts:
        post = nearest_post(o, e, share, x, sees, piece, slot)
        if post >= 0 and post != before:
            other, least = walk(o, e, share, x, post, sees)
            if least < best:
                at = other
    return at


@wp.func
def nearest_triangle(o: Obstacles, e: int, share: float, x: wp.vec3, at: int):
    """Return the triangle around a point nearest to ``x``, the weights there, and the squared distance."""
    triangle = int(-1)
    weights = wp.vec3()
    best = float(_FAR)
    for k in range(o.fan_start[at], o.fan_start[at + 1]):
        f = o.faces[o.fan[k]]
        a = obstacle_point(o, e, f[0], share)
        b = obstacle_point(o, e, f[1], share)
        c = obstacle_point(o, e, f[2], share)
        w = weights_of_nearest(a, b, c, x)
        distance = wp.length_sq(w[0] * a + w[1] * b + w[2] * c - x)
        if distance < best:
            best = distance
            triangle = o.fan[k]
            weights = w
    return triangle, weights, best


@wp.func
def book(o: Obstacles, e: int, triangle: int, w: wp.vec3, z: wp.vec3, J: wp.vec3, M: wp.vec3):
    """Add an impulse ``J`` on a triangle, with moment ``M`` about ``z``, to the books of its corners.

    Nothing is added of numbers that are not finite; the environment has failed then.
    """
    if wp.isfinite(J) and wp.isfinite(M):
        f = o.faces[triangle]
        for corner in range(3):
            n = f[corner]
            about_end = M + wp.cross(z - vector_at(o.end, e, n), J)
            for axis in range(3):
                wp.atomic_add(o.impulse, e, n, axis, wp.int64(wp.rint(_QUANTA * w[corner] * J[axis])))
                wp.atomic_add(o.impulse, e, n, 3 + axis, wp.int64(wp.rint(_QUANTA * w[corner] * about_end[axis])))


@wp.func
def book_slot(o: Obstacles, touches: Touches, e: int, b: int, k: int):
    """Move the impulse of a contact slot to the books of the obstacles."""
    triangle = touches.triangle[b, k]
    if triangle >= 0:
        J = touches.impulse[b, k]
        if wp.length_sq(J) > 0.0:
            w = touches.weights[b, k]
            weights = wp.vec3(w[0], w[1], 1.0 - w[0] - w[1])
            book(o, e, triangle, weights, touches.point[b, k], J, touches.moment[b, k])
            touches.impulse[b, k] = wp.vec3(0.0)
            touches.moment[b, k] = wp.vec3(0.0)


@wp.func
def search(
    o: Obstacles,
    e: int,
    b: int,
    k: int,
    slot: int,
    piece: int,
    sees: int,
    z: wp.vec3,
    step: int,
    substeps: int,
    look_every: int,
    dt: float,
    # in and out
    near: int,
    touches: Touches,
):
    """Fill contact slot ``k`` of a vertex at ``z`` until the next search; returns the nearest point."""
    if step == 0:  # the row may hold the contacts of another environment
        touches.impulse[b, k] = wp.vec3(0.0)
        touches.moment[b, k] = wp.vec3(0.0)
    else:
        book_slot(o, touches, e, b, k)
    begun = float(step) / float(substeps)
    share = float(step + 1) / float(substeps)
    till = wp.min(float(step + look_every) / float(substeps), 1.0)
    at = nearest_point(o, e, share, z, near, step == 0, sees, piece, slot)
    touches.triangle[b, k] = -1
    if at >= 0:
        triangle, w, distance = nearest_triangle(o, e, share, z, at)
        reach = REACH + APPROACH * dt * float(look_every)
        if distance < reach * reach:
            f = o.faces[triangle]
            begin, na = obstacle_patch(o, e, f, begun, w)
            end, nb = obstacle_patch(o, e, f, till, w)
            touches.triangle[b, k] = triangle
            touches.weights[b, k] = wp.vec2(w[0], w[1])
            touches.point[b, k] = begin
            touches.way[b, k] = (end - begin) / (float(substeps) * (till - begun))
            touches.normal[b, k] = wp.normalize(na + nb)
    return at


@wp.func
def push(p: Pushed, depth: float, n: wp.vec3, goes: wp.vec3, friction: float, pop: float, dt: float):
    """Return the motion of a vertex that is ``depth`` too deep in an obstacle which moves by ``goes`` in a substep."""
    slip = p.way - goes
    slip = slip - wp.dot(slip, n) * n
    size = wp.length(slip)
    most = friction * depth
    out = depth * n - wp.where(size > most, most / wp.max(size, _NO_LENGTH), 1.0) * slip
    q = Pushed()
    q.z = p.z + out
    q.way = p.way + out
    q.u = p.u + out / dt
    rise = wp.dot(q.u - goes / dt, n) - pop
    if rise > 0.0:
        q.u = q.u - rise * n
    q.normal = n
    q.squeezed = p.squeezed
    if wp.dot(n, p.normal) < 0.0:  # its thickness would push the two apart without end
        q.squeezed = 1
        q.u = goes / dt
        # it sticks to the one that pushes last: the other one would shift it along that surface, and stretch the cloth
        stuck = p.z - p.way + goes
        q.z = stuck + wp.dot(q.z - stuck, n) * n
        q.way = q.z - (p.z - p.way)
    return q


@wp.func
def push_by_slot(
    touches: Touches, b: int, k: int, p: Pushed, since: float, thickness: float, friction: float, pop: float, dt: float
):
    """Return the motion of a vertex after contact slot ``k``, ``since`` substeps after the search."""
    if touches.triangle[b, k] >= 0:
        n = vector_at(touches.normal, b, k)
        goes = vector_at(touches.way, b, k)
        depth = thickness - wp.dot(p.z - vector_at(touches.point, b, k) - since * goes, n)
        if depth > 0.0:
            return push(p, depth, n, goes, friction, pop, dt)
    return p


@wp.func
def add_to_slot(touches: Touches, b: int, k: int, mass: float, before: Pushed, after: Pushed):
    """Add what a vertex lost of its momentum and angular momentum to contact slot ``k``."""
    about = vector_at(touches.point, b, k)
    J = mass * (before.u - after.u)
    M = mass * (wp.cross(before.z - about, before.u) - wp.cross(after.z - about, after.u))
    touches.impulse[b, k] = touches.impulse[b, k] + J
    touches.moment[b, k] = touches.moment[b, k] + M


@wp.func
def push_by_colliders(
    boundaries: Boundaries, e: int, p: Pushed, ahead: float, thickness: float, friction: float, pop: float, dt: float
):
    """Return the motion of a vertex after contact with all colliders, whose poses are those in ``ahead`` seconds."""
    for b in range(boundaries.count):
        velocity = surface_velocity(boundaries, e, b, p.z)
        d = signed_distance(boundaries, e, b, p.z + ahead * velocity)
        if d[3] < thickness:
            p = push(p, thickness - d[3], wp.vec3(d[0], d[1], d[2]), dt * velocity, friction, pop, dt)
    return p


@wp.func
def is_near_collider(boundaries: Boundaries, e: int, z: wp.vec3, ahead: float, window: float):
    """Return whether a vertex may touch a collider within ``window`` seconds; see :func:`push_by_colliders`."""
    for b in range(boundaries.count):
        velocity = surface_velocity(boundaries, e, b, z)
        if signed_distance(boundaries, e, b, z + ahead * velocity)[3] < REACH + APPROACH * window:
            return True
    return False
