"""Strain measured against the rest shape: the memory of ``F`` that no load explains fades.

The substep integrates the deformation gradient ``F`` from velocity gradients, and errors add up: in limbs that swing
for minutes, or a prop that spins, ``F`` would come to differ from the deformation that the particles have. Han et al.
(arXiv 2606.21162) define it without history, ``F = F_total (F^k)^-1``. Both gradients can be measured at any time,
fitted to the neighbours that a particle has at rest by moving least squares (Lancaster and Salkauskas 1981). With
differences between neighbour and particle, of positions ``x``, unstrained places ``L`` and rest positions ``X``, they
are

    F_total = (sum dx dX^T) (sum dX dX^T)^-1,   F^k = (sum dL dX^T) (sum dX dX^T)^-1,

so that ``F = (sum dx dX^T) (sum dL dX^T)^-1``. The unstrained places of flesh are its skinned ones, at which ``F = I``
exactly in any pose; those of a prop are its rest shape. After every control step ``F`` approaches this value at
:data:`RATE`; contact and waves are much faster, and stay as the solver integrates them.
"""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from piavatar_envs.core.arrays import matrix_at, store_matrix, vector_at
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import make_struct
from piavatar_envs.mpm.types import Model, State, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Rate at which ``F`` approaches the measured value [1/s].
RATE = 1.0
#: Least volume of the neighbourhood in its unstrained place over that at rest: a folded one has no gradient.
LEAST_VOLUME = wp.constant(0.5)
#: Measured strain from which on the solver's is kept: contact crushes matter, and its neighbours no longer measure it.
LARGEST_STRAIN = wp.constant(0.1)
#: Least ``det(K) / (tr(K) / 3)^3`` of ``K = sum dX dX^T``: neighbours in a plane or on a line fix no gradient.
LEAST_SPREAD = wp.constant(0.05)


@wp.struct
class Neighbours:
    """Neighbours of particles at rest: those of particle ``p`` are ``[start[p] : start[p + 1]]``."""

    particle: wp.array(dtype=int)
    start: wp.array(dtype=int)  # (particles + 1,)


def make_neighbours(links: np.ndarray, count: int, device: str) -> Neighbours:
    """Upload the neighbours of ``count`` particles, from pairs of them, shape ``(L, 2)``."""
    pairs = np.concatenate([links, links[:, ::-1]])
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    arrays = {"particle": pairs[:, 1], "start": np.searchsorted(pairs[:, 0], np.arange(count + 1))}
    uploaded = {name: wp.array(v.astype(np.int32), dtype=int, device=device) for name, v in arrays.items()}
    return make_struct(Neighbours, **uploaded)


def record_correction(
    graph: LaunchGraph,
    model: Model,
    state: State,
    neighbours: Neighbours,
    first: int,
    rest: wp.array,
    place: wp.array,
) -> None:
    """Append a control step's approach of ``F`` to the measured value.

    Args:
        graph: the launch graph to append to.
        model: the constants.
        state: the particles.
        neighbours: of the subject's particles.
        first: the subject's first particle.
        rest: its positions at rest [m], shape ``(1 or num_envs, count)``.
        place: its unstrained places [m], likewise.
    """
    inputs = [first, -math.expm1(-RATE * model.control_dt), neighbours, rest, place, state.x, state.failure]
    graph.launch(correct_strain, (model.num_envs, rest.shape[1]), inputs, [state.F])


@wp.kernel
def correct_strain(
    first: int,
    share: float,
    neighbours: Neighbours,
    rest: wp.array2d(dtype=wp.vec3),
    place: wp.array2d(dtype=wp.vec3),
    x: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # in and out
    F: wp.array3d(dtype=float),
):
    """Move ``F`` of every particle by ``share`` towards the measured one; over ``(num_envs, particles)``."""
    e, p = wp.tid()
    if failure[e] != 0:
        return
    r = row(e, rest.shape[0])
    s = row(e, place.shape[0])
    X = vector_at(rest, r, p)
    L = vector_at(place, s, p)
    now = vector_at(x, e, first + p)
    A = wp.mat33()
    B = wp.mat33()
    K = wp.mat33()
    for i in range(neighbours.start[p], neighbours.start[p + 1]):
        q = neighbours.particle[i]
        dX = vector_at(rest, r, q) - X
        A += wp.outer(vector_at(x, e, first + q) - now, dX)
        B += wp.outer(vector_at(place, s, q) - L, dX)
        K += wp.outer(dX, dX)
    size = wp.trace(K) / 3.0
    volume = wp.determinant(K)
    if volume < LEAST_SPREAD * size * size * size or wp.determinant(B) < LEAST_VOLUME * volume:
        return
    measured = A * wp.inverse(B)
    strain = 0.5 * (wp.transpose(measured) * measured - wp.identity(n=3, dtype=float))  # a turn is no strain
    trust = 1.0 - wp.sqrt(wp.ddot(strain, strain)) / LARGEST_STRAIN
    if trust > 0.0:
        before = matrix_at(F, e, first + p)
        store_matrix(F, e, first + p, before + (share * trust) * (measured - before))
