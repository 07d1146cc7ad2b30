"""Strain measured against the rest shape: what the grid does not see of deformation fades.

The substep integrates the deformation gradient ``F`` from velocity gradients, and errors add up: in limbs that swing
for minutes ``F`` would come to differ from the deformation that the particles have. Han et al.
(arXiv 2606.21162) define it without history, ``F = F_total (F^k)^-1``. Both gradients can be measured at any time,
fitted to the neighbours that a particle has at rest by moving least squares (Lancaster and Salkauskas 1981). With
differences between neighbour and particle, of positions ``x``, unstrained places ``L`` and rest positions ``X``, they
are

    F_total = (sum dx dX^T) (sum dX dX^T)^-1,   F^k = (sum dL dX^T) (sum dX dX^T)^-1,

so that ``F = (sum dx dX^T) (sum dL dX^T)^-1``. The unstrained places of flesh are its skinned ones, at which ``F = I``
exactly in any pose. After every control step ``F`` approaches this value at
:data:`RATE`; contact and waves are much faster, and stay as the solver integrates them.

Displacements that alternate from particle to particle have no gradient, so that no stress opposes them: hourglass
modes. They are taken back at the same rate (Ganzenmüller, "An hourglass control algorithm for Lagrangian Smooth
Particle Hydrodynamics", 2015): every pair of neighbours moves towards the distance that its deformation gradients give
it,

    e = dx - (F_p + F_q) / 2 dL,

each by its share of the pair's mass, so that their centre of mass stays. A uniform deformation has no ``e``. No
velocity changes, and affine velocities take the angular momentum of the moves.
"""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from piavatar_envs.core.arrays import matrix_at, set_vector, store_matrix, vector_at
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import make_struct
from piavatar_envs.mpm.types import Grid, Model, State, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Rate at which ``F`` approaches the measured value, and hourglass modes are taken back [1/s].
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
    first, second = np.concatenate([links, links[:, ::-1]]).astype(np.int64).T
    pairs = np.sort(first * count + second)
    start = np.append(0, np.cumsum(np.bincount(first, minlength=count)))
    arrays = {"particle": pairs % count, "start": start}
    uploaded = {name: wp.array(v.astype(np.int32), dtype=int, device=device) for name, v in arrays.items()}
    return make_struct(Neighbours, **uploaded)


class MeasuredStrain:
    """Strain of one subject against its rest shape.

    Attributes:
        neighbours: of its particles.
    """

    def __init__(self, model: Model, links: np.ndarray, first: int, count: int) -> None:
        """Upload the neighbours.

        Args:
            model: the constants.
            links: pairs of neighbouring particles, by index in the subject, shape ``(L, 2)``.
            first: the subject's first particle.
            count: its particles.
        """
        self.model, self.first = model, first
        self.neighbours = make_neighbours(links, count, model.device)
        self._way = wp.zeros((model.num_envs, count), dtype=wp.vec3, device=model.device)
        self._trust = wp.zeros((model.num_envs, count), dtype=float, device=model.device)

    def record(self, graph: LaunchGraph, state: State, rest: wp.array, place: wp.array) -> None:
        """Append the end of a control step: correct ``F``, then positions, by a control step's share.

        Args:
            graph: the launch graph to append to.
            state: the particles.
            rest: the subject's positions at rest [m], shape ``(1 or num_envs, count)``.
            place: its unstrained places [m], likewise.
        """
        share, dim, failure = -math.expm1(-RATE * self.model.control_dt), self._way.shape, state.failure
        inputs = [self.first, share, self.neighbours, rest, place, state.x, failure]
        graph.launch(correct_strain, dim, inputs, [state.F, self._trust])
        mass = self.model.particles.mass
        inputs = [self.first, share, self.neighbours, place, mass, state.x, state.F, self._trust, failure]
        graph.launch(find_hourglass_modes, dim, inputs, [self._way])
        inputs = [self.first, self.model.grid, self._way, state.u, state.vk, failure]
        graph.launch(move_particles, dim, inputs, [state.x, state.C])


@wp.func
def trust_in(F: wp.mat33):
    """Return how far neighbours measure matter of deformation gradient ``F``, 0 to 1; a turn is no strain."""
    strain = 0.5 * (wp.transpose(F) * F - wp.identity(n=3, dtype=float))
    return wp.max(0.0, 1.0 - wp.sqrt(wp.ddot(strain, strain)) / LARGEST_STRAIN)


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
    # out
    trust: wp.array2d(dtype=float),
):
    """Move ``F`` of every particle by ``share`` towards the measured one, and write how far neighbours measure it.

    Over ``(num_envs, particles)``.
    """
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
    own = matrix_at(F, e, first + p)
    if not (volume < LEAST_SPREAD * size * size * size or wp.determinant(B) < LEAST_VOLUME * volume):
        measured = A * wp.inverse(B)
        pull = share * trust_in(measured)
        if pull > 0.0:
            own += pull * (measured - own)
            store_matrix(F, e, first + p, own)
    trust[e, p] = trust_in(own)


@wp.kernel
def find_hourglass_modes(
    first: int,
    share: float,
    neighbours: Neighbours,
    place: wp.array2d(dtype=wp.vec3),
    mass: wp.array2d(dtype=float),
    x: wp.array2d(dtype=wp.vec3),
    F: wp.array3d(dtype=float),
    trust: wp.array2d(dtype=float),
    failure: wp.array(dtype=int),
    # out
    way: wp.array2d(dtype=wp.vec3),
):
    """Write by how much every particle has to move [m], ``share`` of the whole; over ``(num_envs, particles)``."""
    e, p = wp.tid()
    if failure[e] != 0:
        return
    s = row(e, place.shape[0])
    r = row(e, mass.shape[0])
    L = vector_at(place, s, p)
    now = vector_at(x, e, first + p)
    own = matrix_at(F, e, first + p)
    own_trust = trust[e, p]
    m = mass[r, first + p]
    count = neighbours.start[p + 1] - neighbours.start[p]
    total = wp.vec3()
    for i in range(neighbours.start[p], neighbours.start[p + 1]):
        q = neighbours.particle[i]
        other = matrix_at(F, e, first + q)
        apart = vector_at(x, e, first + q) - now - 0.5 * (own + other) * (vector_at(place, s, q) - L)
        # symmetric in the two particles, but for the mass of the other one
        mean_count = 0.5 * float(count + neighbours.start[q + 1] - neighbours.start[q])
        other_mass = mass[r, first + q]
        total += (wp.min(own_trust, trust[e, q]) * other_mass / (mean_count * (m + other_mass))) * apart
    set_vector(way, e, p, share * total)


@wp.func
def affine_after_move(grid: Grid, C: wp.mat33, way: wp.vec3, velocity: wp.vec3):
    """Return the affine velocity that keeps the angular momentum of a particle that is moved by ``way`` [m].

    Of ``m way x velocity``, the grid gets ``m (dx^2/4) eps C`` (Jiang et al. 2015, quadratic weights).
    """
    return C - wp.skew((2.0 / (grid.dx * grid.dx)) * wp.cross(way, velocity))


@wp.kernel
def move_particles(
    first: int,
    grid: Grid,
    way: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    vk: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # in and out
    x: wp.array2d(dtype=wp.vec3),
    C: wp.array3d(dtype=float),
):
    """Move every particle by its ``way`` [m] without angular momentum; over ``(num_envs, particles)``."""
    e, p = wp.tid()
    if failure[e] != 0:
        return
    q = first + p
    own = vector_at(way, e, p)
    affine = affine_after_move(grid, matrix_at(C, e, q), own, vector_at(u, e, q) + vector_at(vk, e, q))
    set_vector(x, e, q, vector_at(x, e, q) + own)
    store_matrix(C, e, q, affine)
