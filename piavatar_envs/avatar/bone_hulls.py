"""Hulls of bones: where the convex hull of a bone's points is nearest to a collider, or deepest in it.

A bone has some twenty points, with centimetres between them, in which a pole or an edge finds room. Their convex hull
has none. The distance from a convex solid is a convex function, so that its minimum over the hull is found by steps
along the hull: each takes weight from the point of the mean that lies farthest along the normal, and gives it to the
point of the bone that lies farthest against it, as long as the distance falls (pairwise steps after Frank & Wolfe, "An
Algorithm for Quadratic Programming", 1956; Lacoste-Julien & Jaggi, "On the Global Linear Convergence of Frank-Wolfe
Optimization Variants", 2015). On a plane a point of the bone is the lowest.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.types import Body, Pose
from piavatar_envs.core.arrays import vector_at
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.colliders import PLANE, signed_distance
from piavatar_envs.mpm.types import Boundaries, Model, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Hulls farther from a collider are left out [m].
NEAR = wp.constant(0.05)
#: Coordinates of the nearest point of a hull that is left out [m].
NOWHERE = wp.constant(1.0e6)
#: Most steps, halvings of the interval in which a step ends, and what a step must promise [m].
_STEPS, _HALVINGS, _PROMISE = wp.constant(40), wp.constant(12), wp.constant(1.0e-4)


class BoneHulls:
    """Hulls of the bones of one avatar in every environment: of a bone's points, its joint and the joints beyond it.

    So there is no gap between a bone and the next one.

    Attributes:
        deepest: deepest points of bones in colliders [m], ``(num_envs, bones * colliders)``; without columns where all
            colliders are planes, or hulls are not wanted.
    """

    def __init__(self, body: Body, model: Model, wanted: bool = True) -> None:
        """Allocate the hulls of a body in the world of ``model``."""
        self._body, self._model = body, model
        kinds = model.boundaries.kind.numpy()[: model.boundaries.count]
        used = int(wanted and (kinds != int(PLANE)).any())
        joints = [1 + int(children).bit_count() for children in body.children.numpy()]
        start = body.tracker_start.numpy() + np.cumsum([0, *joints])
        self._start = wp.array(start.astype(np.int32), dtype=int, device=model.device)
        count = model.boundaries.count
        self._weight = wp.zeros((model.num_envs, used * count * int(start[-1])), dtype=float, device=model.device)
        sizes = int(start[-1]), NUM_JOINTS * count
        self._place, self.deepest = (
            wp.zeros((model.num_envs, used * size), dtype=wp.vec3, device=model.device) for size in sizes
        )

    def record(self, graph: LaunchGraph, pose: Pose, failure: wp.array) -> None:
        """Append the search for the deepest points of bones in a pose; nothing if hulls are not used."""
        if self.deepest.size == 0:
            return
        inputs = [self._body, self._start, pose, failure]
        graph.launch(place_hulls, (self._model.num_envs, NUM_JOINTS), inputs, [self._place])
        inputs = [self._model.boundaries, self._start, self._place, failure]
        graph.launch(find_deepest_points, self.deepest.shape, inputs, [self._weight, self.deepest])


@wp.kernel
def place_hulls(
    body: Body,
    start: wp.array(dtype=int),
    pose: Pose,
    failure: wp.array(dtype=int),
    # out
    place: wp.array2d(dtype=wp.vec3),
):
    """Write where the points of all hulls are in a pose [m]; over ``(num_envs, bones)``.

    Those of a bone are ``start[b]`` to ``start[b + 1]``, exclusive.
    """
    e, b = wp.tid()
    if failure[e] != 0:
        return
    n = start[b]
    for tracker in range(body.tracker_start[b], body.tracker_start[b + 1]):
        place[e, n] = pose.position[e, b] + wp.quat_rotate(pose.rotation[e, b], rest_offset(body, e, b, tracker))
        n += 1
    place[e, n] = pose.position[e, b]
    for child in range(body.parent.shape[0]):
        if body.parent[child] == b:
            n += 1
            place[e, n] = pose.position[e, child]


@wp.func
def rest_offset(body: Body, e: int, b: int, tracker: int):
    """Return the offset from a joint to a point of its bone in the rest pose [m]; the point by its tracker index."""
    joint = body.rest_joint[row(e, body.rest_joint.shape[0]), b]
    return vector_at(body.rest, row(e, body.rest.shape[0]), body.tracker[tracker]) - joint


@wp.func
def shortened(boundaries: Boundaries, e: int, k: int, x: wp.vec3, way: wp.vec3):
    """Return the share of a ``way`` from ``x`` [m] at which the distance from a collider is least."""
    least = float(0.0)
    most = float(1.0)
    for _ in range(_HALVINGS):
        share = 0.5 * (least + most)
        d = signed_distance(boundaries, e, k, x + share * way)
        if wp.dot(wp.vec3(d[0], d[1], d[2]), way) < 0.0:
            least = share
        else:
            most = share
    return 0.5 * (least + most)


@wp.func
def deepest_point(
    boundaries: Boundaries,
    place: wp.array2d(dtype=wp.vec3),
    e: int,
    k: int,
    first: int,
    last: int,
    # out
    weight: wp.array2d(dtype=float),
) -> wp.vec3:
    """Return the point of a hull that is nearest to a collider or deepest in it [m], nowhere if the hull is not near.

    ``first`` to ``last``, exclusive, are the points of the hull, of which the answer is the mean with ``weight``.
    """
    best = int(first)
    depth = float(1.0e9)
    for n in range(first, last):
        distance = signed_distance(boundaries, e, k, place[e, n])[3]
        if distance < depth:
            depth = distance
            best = n
    x = place[e, best]
    extent = float(0.0)
    own = k * place.shape[1]
    for n in range(first, last):
        extent = wp.max(extent, wp.length(place[e, n] - x))
        weight[e, own + n] = 0.0
    weight[e, own + best] = 1.0
    if depth - extent > NEAR:
        return wp.vec3(NOWHERE)
    for _ in range(_STEPS):
        d = signed_distance(boundaries, e, k, x)
        normal = wp.vec3(d[0], d[1], d[2])
        to = int(first)
        away = int(first)
        least = float(1.0e9)
        most = float(-1.0e9)
        for n in range(first, last):
            height = wp.dot(place[e, n] - x, normal)
            if height < least:
                least = height
                to = n
            if height > most and weight[e, own + n] > 0.0:
                most = height
                away = n
        if least > -_PROMISE:
            break
        share = weight[e, own + away]
        way = share * (place[e, to] - place[e, away])
        part = shortened(boundaries, e, k, x, way)
        if part > 0.999:  # so that a point leaves the mean
            part = 1.0
        weight[e, own + away] = (1.0 - part) * share
        weight[e, own + to] = weight[e, own + to] + part * share
        x += part * way
    return x


@wp.kernel
def find_deepest_points(
    boundaries: Boundaries,
    start: wp.array(dtype=int),
    place: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # out
    weight: wp.array2d(dtype=float),
    deepest: wp.array2d(dtype=wp.vec3),
):
    """Write the deepest point of every bone's hull in every collider [m], nowhere in planes.

    Over ``(num_envs, bones * colliders)``; ``start`` and ``place`` as in :func:`place_hulls`, ``weight`` as in
    :func:`deepest_point`, ``(num_envs, colliders * points)``.
    """
    e, n = wp.tid()
    if failure[e] != 0:
        return
    b = n // boundaries.count
    k = n % boundaries.count
    found = wp.vec3(NOWHERE)
    if boundaries.kind[k] != PLANE:
        found = deepest_point(boundaries, place, e, k, start[b], start[b + 1], weight)
    deepest[e, n] = found
