"""Surfaces that cloth touches, on the device: skins of avatars and surfaces of props, and what cloth does to them.

All surfaces of a world, its pieces, lie in one list of points: avatars in order, then props. In a control step the
bodies move first. Each point then goes from its place before that, ``start``, to its present one, ``end``, while cloth
takes its own substeps. Cloth sums the impulses and moments that it gives to the points; afterwards they go to the
particles beneath.

The position of a point is affine in those of the particles, with weights ``W`` whose rows sum to one. The transposed
weights take impulses ``J`` to particles, ``u_p += (W^T J)_p / m_p``. The particles' mean ``W x`` is not where the point
is, so a couple remains, which goes into their affine velocity (APIC):

    tau = W^T (M + (P - W x) x J),    C_p += skew(2 tau_p / (m_p dx^2)),

with the moment ``M`` about the point ``P``, because an affine velocity carries the angular momentum
``m dx^2 / 4 axial(C)`` (Jiang et al. 2015). Momentum and angular momentum are those that the cloth has lost.

Symbols in kernels: ``e`` environment, ``i`` point, ``p`` particle.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy import sparse

from piavatar_envs.core.arrays import matrix_at, store_matrix, vec6
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import fill
from piavatar_envs.mpm.types import Model, State, row

wp.set_module_options({"enable_backward": False})

#: Points of a piece from which a search for the nearest one begins.
POSTS = 48
#: Quantum of the sums of impulses [N s] and moments [N m s].
QUANTUM = 2.0**-40
_QUANTUM = wp.constant(wp.float64(QUANTUM))


@wp.struct
class Obstacles:
    """Surfaces of ``P`` pieces with ``N`` points and ``T`` triangles together."""

    start: wp.array2d(dtype=wp.vec3)  # (num_envs, N) before the control step [m]
    end: wp.array2d(dtype=wp.vec3)  # (num_envs, N) after it [m]
    start_normal: wp.array2d(dtype=wp.vec3)  # (num_envs, N) outward, unit
    end_normal: wp.array2d(dtype=wp.vec3)
    faces: wp.array(dtype=wp.vec3i)  # (T,)
    # neighbours of point i, ascending: ring[ring_start[i] : ring_start[i + 1]]
    ring_start: wp.array(dtype=int)
    ring: wp.array(dtype=int)
    # triangles of point i, ascending: fan[fan_start[i] : fan_start[i + 1]]
    fan_start: wp.array(dtype=int)
    fan: wp.array(dtype=int)
    part: wp.array(dtype=int)  # (N,) bits of body parts, see piavatar_envs.cloth.proxy; all of a prop's
    piece_start: wp.array(dtype=int)  # (P + 1,) first point of each piece
    # evenly spread points of piece s: post[post_start[s] : post_start[s + 1]]
    post_start: wp.array(dtype=int)
    post: wp.array(dtype=int)
    # (num_envs, N, 6) sums over the control step in quanta: impulse of the cloth, then its moment about ``end``
    impulse: wp.array3d(dtype=wp.int64)


@wp.struct
class Receivers:
    """Weights of the particles in the points' positions, by point and by particle."""

    # particles of point i: particle[point_start[i] : point_start[i + 1]]
    point_start: wp.array(dtype=int)
    particle: wp.array(dtype=int)
    weight: wp.array(dtype=float)
    used: wp.array(dtype=int)  # (U,) particles that points depend on
    # points of the n-th of them: point[used_start[n] : used_start[n + 1]]
    used_start: wp.array(dtype=int)
    point: wp.array(dtype=int)
    share: wp.array(dtype=float)  # the same weights in this order
    # workspace in the memory of the obstacles' ``start`` and ``start_normal``, which the next control step writes anew
    force: wp.array2d(dtype=wp.vec3)  # (num_envs, N) impulse [N s]
    couple: wp.array2d(dtype=wp.vec3)  # (num_envs, N) moment about the particles' mean [N m s]


@dataclass(frozen=True, eq=False)
class Piece:
    """One surface.

    Attributes:
        points: its rest pose, by which posts are chosen [m], shape ``(n, 3)``.
        faces: triangles, outward, shape ``(t, 3)``.
        part: bits of body parts, shape ``(n,)``.
        weights: of all particles of an environment in its points, rows sum to one, shape ``(n, num_particles)``.
        record: appends the launches that write its points into an array ``(num_envs, N)``, from an index on.
    """

    points: np.ndarray
    faces: np.ndarray
    part: np.ndarray
    weights: sparse.csr_array
    record: Callable[[LaunchGraph, wp.array, int], None]


class ObstacleSurfaces:
    """All surfaces of a world that cloth touches.

    Attributes:
        pieces: in order.
        obstacles: on the device, for the solver of the cloth.
    """

    def __init__(self, pieces: Sequence[Piece], model: Model) -> None:
        """Allocate the surfaces.

        Args:
            pieces: avatars in order, then props.
            model: constants of the continuum.
        """
        self.pieces, self._model = tuple(pieces), model
        self._first = np.cumsum([0, *(len(piece.points) for piece in pieces)])
        self.obstacles = allocate(self.pieces, model.num_envs, model.device)
        self._receivers = self._connect()

    def record_start(self, graph: LaunchGraph) -> None:
        """Append the launches that write where the surfaces are before a control step."""
        self._record(graph, self.obstacles.start, self.obstacles.start_normal)

    def record_end(self, graph: LaunchGraph) -> None:
        """Append the launches that write where the surfaces are after a control step."""
        self._record(graph, self.obstacles.end, self.obstacles.end_normal)

    def record_reaction(self, graph: LaunchGraph, state: State) -> None:
        """Append the launches that give the cloth's impulses to the particles, except in failed environments.

        Where the surfaces were before the step is lost.
        """
        n, model = self._model.num_envs, self._model
        graph.launch(sum_couples, (n, self._first[-1]), [state.x, state.failure, self.obstacles], [self._receivers])
        inputs = [self._receivers, model.particles.mass, model.grid.dx, state.failure]
        graph.launch(receive_impulses, (n, len(self._receivers.used)), inputs, [state.u, state.C])

    def _record(self, graph: LaunchGraph, points: wp.array, normals: wp.array) -> None:
        pieces = list(zip(self.pieces, self._first, strict=False))
        graph.parallel_for_each(pieces, lambda own, branch: own[0].record(branch, points, int(own[1])))
        graph.launch(find_normals, points.shape, [self.obstacles, points], [normals])

    def _connect(self) -> Receivers:
        device = self._model.device
        weights = sparse.csr_array(sparse.vstack([piece.weights for piece in self.pieces]))
        weights.eliminate_zeros()
        weights.sort_indices()
        back = sparse.csr_array(weights.T)
        back.sort_indices()
        used = np.flatnonzero(np.diff(back.indptr))
        return fill(
            Receivers(),
            point_start=_integers(weights.indptr, device),
            particle=_integers(weights.indices, device),
            weight=wp.array(weights.data.astype(np.float32), dtype=float, device=device),
            used=_integers(used, device),
            used_start=_integers(np.append(back.indptr[used], back.nnz), device),
            point=_integers(back.indices, device),
            share=wp.array(back.data.astype(np.float32), dtype=float, device=device),
            force=self.obstacles.start,
            couple=self.obstacles.start_normal,
        )


def allocate(pieces: Sequence[Piece], num_envs: int, device: str) -> Obstacles:
    """Return the surfaces of pieces on a device, all of whose points and normals are zero."""
    start = np.cumsum([0, *(len(piece.points) for piece in pieces)])
    count = int(start[-1])
    faces = np.concatenate([piece.faces + first for piece, first in zip(pieces, start, strict=False)])
    half = np.concatenate([faces[:, [a, b]] for a in range(3) for b in range(3) if a != b])
    ring_start, ring = _lists(np.unique(half, axis=0), count)
    corners = np.stack([faces.ravel(), np.repeat(np.arange(len(faces)), 3)], axis=1)
    fan_start, fan = _lists(corners, count)
    posts = [spread(piece.points) + first for piece, first in zip(pieces, start, strict=False)]
    lists = {
        "ring_start": ring_start,
        "ring": ring,
        "fan_start": fan_start,
        "fan": fan,
        "part": np.concatenate([piece.part for piece in pieces]),
        "piece_start": start,
        "post_start": np.cumsum([0, *map(len, posts)]),
        "post": np.concatenate(posts),
    }
    vectors = ("start", "end", "start_normal", "end_normal")
    return fill(
        Obstacles(),
        faces=wp.array(faces.astype(np.int32), dtype=wp.vec3i, device=device),
        impulse=wp.zeros((num_envs, count, 6), dtype=wp.int64, device=device),
        **{name: _integers(values, device) for name, values in lists.items()},
        **{name: wp.zeros((num_envs, count), dtype=wp.vec3, device=device) for name in vectors},
    )


def bytes_of_obstacles(points: int) -> int:
    """Return the memory of so many points in an environment, without what skins work in [bytes]."""
    return points * (4 * 12 + 6 * 8)


def spread(points: np.ndarray, count: int = POSTS) -> np.ndarray:
    """Return indices of ``count`` evenly spread points, each the farthest from those before it; fewer of few points."""
    chosen = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


def _lists(pairs: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the second members of pairs by the first, ascending: ``(count + 1,)`` starts and the members."""
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    return np.searchsorted(pairs[:, 0], np.arange(count + 1)), pairs[:, 1]


def _integers(values: np.ndarray, device: str) -> wp.array:
    return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)


@wp.kernel
def find_normals(
    obstacles: Obstacles,
    points: wp.array2d(dtype=wp.vec3),
    # out
    normals: wp.array2d(dtype=wp.vec3),
):
    """Write the unit normals of points, the mean of their triangles' by area; over ``(num_envs, N)``."""
    e, i = wp.tid()
    total = wp.vec3()
    for k in range(obstacles.fan_start[i], obstacles.fan_start[i + 1]):
        f = obstacles.faces[obstacles.fan[k]]
        a = points[e, f[0]]
        total += wp.cross(points[e, f[1]] - a, points[e, f[2]] - a)
    normals[e, i] = total / wp.max(wp.length(total), 1.0e-20)


@wp.kernel
def sum_couples(
    x: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # in and out
    obstacles: Obstacles,
    # out
    receivers: Receivers,
):
    """Read and clear the impulses on the points, and move their moments to the particles' mean; ``(num_envs, N)``."""
    e, i = wp.tid()
    sums = vec6()
    for n in range(6):
        sums[n] = float(_QUANTUM * wp.float64(obstacles.impulse[e, i, n]))
        obstacles.impulse[e, i, n] = wp.int64(0)
    if failure[e] != 0:
        return
    force = wp.vec3(sums[0], sums[1], sums[2])
    couple = wp.vec3(sums[3], sums[4], sums[5])
    if wp.length_sq(force) > 0.0:
        place = obstacles.end[e, i]
        arm = wp.vec3()
        for k in range(receivers.point_start[i], receivers.point_start[i + 1]):
            arm += receivers.weight[k] * (place - x[e, receivers.particle[k]])
        couple += wp.cross(arm, force)
    receivers.force[e, i] = force
    receivers.couple[e, i] = couple


@wp.kernel
def receive_impulses(
    receivers: Receivers,
    mass: wp.array2d(dtype=float),
    dx: float,
    failure: wp.array(dtype=int),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
    C: wp.array3d(dtype=float),
):
    """Add the impulses and couples of points to the velocities of their particles; over ``(num_envs, U)``."""
    e, n = wp.tid()
    if failure[e] != 0:
        return
    force = wp.vec3()
    couple = wp.vec3()
    for k in range(receivers.used_start[n], receivers.used_start[n + 1]):
        i = receivers.point[k]
        force += receivers.share[k] * receivers.force[e, i]
        couple += receivers.share[k] * receivers.couple[e, i]
    if wp.length_sq(force) + wp.length_sq(couple) > 0.0:
        p = receivers.used[n]
        m = mass[row(e, mass.shape[0]), p]
        u[e, p] = u[e, p] + force / m
        store_matrix(C, e, p, matrix_at(C, e, p) + wp.skew((2.0 / (m * dx * dx)) * couple))
