"""Interpolation of quantities of particles at other points of a body, without glueing limbs that touch; gradients."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

#: Particles looked at for each vertex, in turn: more only where too few of the nearest share the vertex's bones.
_CANDIDATES = (64, 256)
#: Pairs of vertices and particles that are looked at together, which bounds memory.
_MOST_PAIRS = 1_000_000
#: A particle with less than this share of the best candidate's overlap moves with other bones: leave it out.
_MIN_RELATIVE_OVERLAP = 0.05
#: Least ``det(K) / (tr(K) / 3)^3`` of ``K = sum dX dX^T``: neighbours in a plane or on a line fix no gradient.
_LEAST_SPREAD = 0.05


def interpolation_matrix(
    vertices: np.ndarray, vertex_weights: np.ndarray, particles: np.ndarray, particle_weights: np.ndarray, near: int
) -> sparse.csr_array:
    """Weigh the nearest particles that move with each vertex's own bones, ``(V, P)``, rows sum to one.

    The nearest particle to the inside of one thigh may lie in the other: distance alone would glue them together.
    ``overlap = sum_b w_vertex,b w_particle,b`` is zero between them.
    """
    num_neighbours = min(near, len(particles))
    tree = cKDTree(particles)
    neighbours = np.zeros((len(vertices), num_neighbours), dtype=np.int64)
    weights = np.zeros((len(vertices), num_neighbours))
    todo = np.arange(len(vertices))
    for count in (*_CANDIDATES, len(particles)):
        last, count, left = count >= len(particles), min(count, len(particles)), []
        for part in np.array_split(todo, 1 + len(todo) * count // _MOST_PAIRS):
            if last:  # a tree is slow where it has to sort all that it holds
                index = np.broadcast_to(np.arange(count), (len(part), count))
                distance = cdist(vertices[part], particles)
            else:
                distance, index = tree.query(vertices[part], k=np.arange(1, count + 1))
            overlap = np.einsum("vb,vcb->vc", vertex_weights[part], particle_weights[index])
            compatible = overlap > _MIN_RELATIVE_OVERLAP * np.maximum(overlap.max(axis=1, keepdims=True), 0.2)
            # One more than needed: the kernel falls to zero at the first particle left out, for smooth weights.
            done = (compatible.sum(axis=1) > num_neighbours) | last
            rows = part[done]
            if len(rows):
                neighbours[rows], weights[rows] = _select(
                    distance[done], index[done], overlap[done], compatible[done], num_neighbours
                )
            left.append(part[~done])
        todo = np.concatenate(left)
        if last or not len(todo):
            break
    rows = np.broadcast_to(np.arange(len(vertices))[:, None], neighbours.shape)
    return sparse.csr_array(
        (weights.ravel(), (rows.ravel(), neighbours.ravel())), shape=(len(vertices), len(particles))
    )


def _select(
    distance: np.ndarray, index: np.ndarray, overlap: np.ndarray, compatible: np.ndarray, num_neighbours: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return nearest compatible candidates of each row and their weights, both ``(rows, num_neighbours)``."""
    # A vertex that shares no bone with any candidate takes the nearest particles.
    compatible = np.where(compatible.any(axis=1, keepdims=True), compatible, True)
    overlap = np.where(compatible, np.maximum(overlap, 1e-6), 0.0)
    order = np.argsort(np.where(compatible, distance, np.inf), axis=1, kind="stable")[:, : num_neighbours + 1]
    distance, index, overlap = (np.take_along_axis(array, order, axis=1) for array in (distance, index, overlap))
    valid = overlap > 0.0
    support = np.max(np.where(valid, distance, 0.0), axis=1, keepdims=True) * (1.0 + 1e-6) + 1e-12
    weights = overlap * (1.0 - np.minimum(distance / support, 1.0) ** 2) ** 2
    weights, index = weights[:, :num_neighbours], index[:, :num_neighbours]
    return index, weights / weights.sum(axis=1, keepdims=True)


def rest_gradient(rest: np.ndarray, links: np.ndarray) -> tuple[list[sparse.csr_matrix], np.ndarray]:
    """Return the operators that give the gradient of a field at all particles, by moving least squares.

    Args:
        rest: rest positions [m], shape ``(P, 3)``.
        links: pairs of neighbours, shape ``(L, 2)``.

    Returns:
        Derivatives along x, y and z, each ``(P, P)`` [1/m], zero where neighbours fix no gradient; and where they do,
        ``(P,)`` bool.
    """
    count = len(rest)
    own, other = np.concatenate([links, links[:, ::-1]]).T
    apart = rest[other] - rest[own]
    products = (apart[:, :, None] * apart[:, None]).reshape(-1, 9).T
    spread = np.stack([np.bincount(own, product, count) for product in products], axis=1).reshape(-1, 3, 3)
    size = np.trace(spread, axis1=1, axis2=2) / 3.0
    known = np.linalg.det(spread) > _LEAST_SPREAD * size**3
    inverse = np.zeros_like(spread)
    inverse[known] = np.linalg.inv(spread[known])
    weight = np.einsum("li,lij->lj", apart, inverse[own])
    rows, columns = np.r_[own, own], np.r_[other, own]
    along = [
        sparse.csr_matrix((np.r_[weight[:, k], -weight[:, k]], (rows, columns)), shape=(count, count)) for k in range(3)
    ]
    return along, known
