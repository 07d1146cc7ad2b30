"""Smooth interpolation inside a body: harmonic functions on the graph of its particles (NumPy)."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

TOLERANCE = 1e-6  # of the residual, relative to the right-hand side
MAX_ITERATIONS = 2000


def adjacency(links: np.ndarray, points: np.ndarray) -> sparse.csr_matrix:
    """Symmetric matrix of link weights 1/length^2, which make it a Laplacian on scattered points.

    Args:
        links: pairs of linked points, shape ``(L, 2)``.
        points: positions [m], shape ``(P, 3)``.

    Returns:
        Matrix of shape ``(P, P)``.
    """
    first, second = links.T
    weight = 1.0 / np.maximum(np.sum((points[first] - points[second]) ** 2, axis=1), 1e-8)
    rows, columns = np.concatenate([first, second]), np.concatenate([second, first])
    return sparse.csr_matrix((np.concatenate([weight, weight]), (rows, columns)), shape=(len(points),) * 2)


def fill(links: np.ndarray, points: np.ndarray, values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Extend ``values`` from the known points to the others by solving Laplace's equation on the graph.

    Weighted averages of neighbours obey a maximum principle: weights stay in [0, 1] and keep their sum. Parts of
    the graph without a known point keep the values they came with.

    Args:
        links: pairs of linked points, shape ``(L, 2)``.
        points: positions [m], shape ``(P, 3)``.
        values: values at the known points and a first guess elsewhere, shape ``(P, K)``.
        known: which points are known, shape ``(P,)`` bool.

    Returns:
        Values, shape ``(P, K)`` float64.
    """
    graph = adjacency(links, points)
    count, part = connected_components(graph, directed=False)
    anchored = np.zeros(count, dtype=bool)
    anchored[part[known]] = True
    free = ~known & anchored[part]
    filled = np.array(values, dtype=np.float64)
    if free.any():
        laplacian = sparse.diags(np.asarray(graph.sum(axis=1)).ravel()) - graph
        inner = laplacian.tocsr()[free]
        filled[free] = _conjugate_gradient(inner[:, free], -(inner[:, ~free] @ filled[~free]), filled[free])
    return filled


def _conjugate_gradient(matrix: sparse.csr_matrix, right: np.ndarray, guess: np.ndarray) -> np.ndarray:
    """Conjugate gradients with a diagonal preconditioner, all columns at once; deterministic."""
    inverse_diagonal = 1.0 / matrix.diagonal()[:, None]
    solution = guess.copy()
    residual = right - matrix @ solution
    direction = z = inverse_diagonal * residual
    energy = np.sum(residual * z, axis=0)
    limit = TOLERANCE * max(np.linalg.norm(right), 1e-12)
    for _ in range(MAX_ITERATIONS):
        if np.linalg.norm(residual) <= limit:
            break
        image = matrix @ direction
        # a column that is already solved has a zero direction: leave it where it is
        step = energy / np.maximum(np.sum(direction * image, axis=0), 1e-300)
        solution += step * direction
        residual -= step * image
        z = inverse_diagonal * residual
        new_energy = np.sum(residual * z, axis=0)
        direction = z + (new_energy / np.maximum(energy, 1e-300)) * direction
        energy = new_energy
    return solution


def volume_ratios(links: np.ndarray, rest: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Local volume change of a smooth map, from the least-squares gradient over each point's links.

    Args:
        links: pairs of linked points, shape ``(L, 2)``.
        rest: positions before [m], shape ``(P, 3)``.
        moved: positions after [m], shape ``(P, 3)``.

    Returns:
        Determinants of the gradient, kept within [0.1, 10], shape ``(P,)``.
    """
    both = np.concatenate([links, links[:, ::-1]])
    edge = rest[both[:, 1]] - rest[both[:, 0]]
    change = (moved - rest)[both[:, 1]] - (moved - rest)[both[:, 0]]
    weight = 1.0 / np.maximum(np.sum(edge**2, axis=1), 1e-8)
    spread, shear = np.zeros((len(rest), 3, 3)), np.zeros((len(rest), 3, 3))
    np.add.at(spread, both[:, 0], np.einsum("l,li,lj->lij", weight, edge, edge))
    np.add.at(shear, both[:, 0], np.einsum("l,li,lj->lij", weight, change, edge))
    # Regularised, so that a point with few neighbours falls back to no change rather than to noise.
    gradient = np.eye(3) + shear @ np.linalg.inv(spread + 0.1 * np.eye(3))
    return np.clip(np.linalg.det(gradient), 0.1, 10.0)
