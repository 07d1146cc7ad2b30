"""Strain of flesh measured against its skinned places: the memory of ``F`` that no load explains fades.

The substep integrates the deformation gradient ``F`` from velocity gradients, and errors add up: in limbs that swing
for minutes ``F`` would come to differ from the deformation that the particles have. The paper defines it without
history, ``F = F_total (F^k)^-1`` (Han et al., arXiv 2606.21162). Both gradients can be measured at any time, fitted to
the neighbours that a particle has at rest by moving least squares (Lancaster and Salkauskas 1981). With differences
between neighbour and particle, of positions ``x``, skinned places ``L`` and rest positions ``X``, they are

    F_total = (sum dx dX^T) (sum dX dX^T)^-1,   F^k = (sum dL dX^T) (sum dX dX^T)^-1,

so that ``F = (sum dx dX^T) (sum dL dX^T)^-1``. Particles at their skinned places have ``F = I`` exactly in any pose.
After every control step ``F`` approaches this value at :data:`RATE`; contact and waves are much faster, and stay as
the solver integrates them.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.skinning import skinned_place
from piavatar_envs.avatar.torque_control.mass_matrix import I3
from piavatar_envs.avatar.types import Body
from piavatar_envs.core.arrays import matrix_at, set_vector, store_matrix, vector_at
from piavatar_envs.core.structs import make_struct
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Rate at which ``F`` approaches the measured value [1/s].
RATE = 1.0
#: Least volume of the skinned neighbourhood over that at rest: a folded one has no gradient.
LEAST_VOLUME = wp.constant(0.5)
#: Measured strain from which on the solver's is kept: contact crushes flesh, and its neighbours no longer measure it.
LARGEST_STRAIN = wp.constant(0.1)
#: Least ``det(K) / (tr(K) / 3)^3`` of ``K = sum dX dX^T``: neighbours in a plane or on a line fix no gradient.
LEAST_SPREAD = wp.constant(0.05)


@wp.struct
class Neighbours:
    """Neighbours of the particles of a body at rest: those of particle ``p`` are ``[start[p] : start[p + 1]]``."""

    particle: wp.array(dtype=int)
    start: wp.array(dtype=int)  # (particles + 1,)


def make_neighbours(links: np.ndarray, count: int, device: str) -> Neighbours:
    """Upload the neighbours of ``count`` particles, from pairs of them, shape ``(L, 2)``."""
    pairs = np.concatenate([links, links[:, ::-1]])
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    arrays = {"particle": pairs[:, 1], "start": np.searchsorted(pairs[:, 0], np.arange(count + 1))}
    uploaded = {name: wp.array(v.astype(np.int32), dtype=int, device=device) for name, v in arrays.items()}
    return make_struct(Neighbours, **uploaded)


@wp.kernel
def find_places(
    body: Body,
    place: wp.array2d(dtype=wp.mat44),
    failure: wp.array(dtype=int),
    # out
    at: wp.array2d(dtype=wp.vec3),
):
    """Write the skinned places of all particles [m], relative to the pelvis joint; over ``(num_envs, particles)``."""
    e, p = wp.tid()
    if failure[e] == 0:
        set_vector(at, e, p, skinned_place(body, place, e, p))


@wp.kernel
def correct_strain(
    body: Body,
    share: float,
    neighbours: Neighbours,
    x: wp.array2d(dtype=wp.vec3),
    at: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # in and out
    F: wp.array3d(dtype=float),
):
    """Move ``F`` of every particle by ``share`` towards the measured one; over ``(num_envs, particles)``."""
    e, p = wp.tid()
    if failure[e] != 0:
        return
    r = row(e, body.rest.shape[0])
    X = vector_at(body.rest, r, p)
    L = vector_at(at, e, p)
    now = vector_at(x, e, body.first + p)
    A = wp.mat33()
    B = wp.mat33()
    K = wp.mat33()
    for i in range(neighbours.start[p], neighbours.start[p + 1]):
        q = neighbours.particle[i]
        dX = vector_at(body.rest, r, q) - X
        A += wp.outer(vector_at(x, e, body.first + q) - now, dX)
        B += wp.outer(vector_at(at, e, q) - L, dX)
        K += wp.outer(dX, dX)
    size = wp.trace(K) / 3.0
    volume = wp.determinant(K)
    if volume < LEAST_SPREAD * size * size * size or wp.determinant(B) < LEAST_VOLUME * volume:
        return
    measured = A * wp.inverse(B)
    off = measured - I3
    trust = 1.0 - wp.sqrt(wp.ddot(off, off)) / LARGEST_STRAIN
    if trust > 0.0:
        before = matrix_at(F, e, body.first + p)
        store_matrix(F, e, body.first + p, before + (share * trust) * (measured - before))
