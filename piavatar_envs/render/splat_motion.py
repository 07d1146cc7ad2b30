"""Splats that move with avatars: centres by the skin's formula, covariances and colours by the gradient of positions.

A splat's covariance becomes ``G S G^T`` with the local gradient ``G`` of the map from the rest pose to the present
positions of the particles around (as in Xie et al., "PhysGaussian", 2024, with ``F``; the deformation gradient of the
material does not see how a bone turns its flesh). Moving least squares gives it: with weights ``w_k`` and offsets
``Y_k`` of rest positions from their mean,

    G = sum_k x_k (w_k A^-1 Y_k)^T,   A = sum_k w_k Y_k Y_k^T,

which is exact for affine maps. The vectors in brackets are baked. Where the particles around lie in a plane or on a
line, the directions that they do not span turn with the bones. Singular values are kept within :data:`STRETCH`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.splats import SplatCloud, joined_colors
from piavatar_envs.avatar.skin import (
    Skin,
    SkinMotion,
    SkinSurface,
    SkinWorkspace,
    motion_of,
    record_skin,
    skin_workspace,
)
from piavatar_envs.avatar.skinning import blend_places
from piavatar_envs.core.arrays import vec6
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import fill
from piavatar_envs.render.scene import MovedSplats
from piavatar_envs.sim.bodies import Flesh
from piavatar_envs.sim.world import Simulation

wp.set_module_options({"enable_backward": False})

#: Least and greatest stretch of a splat.
STRETCH = (0.3, 3.0)
#: Spread of the particles around in a direction, over their largest, below which they do not span it.
LEAST_SPREAD = 0.01
#: Memory of a splat in a picture: its centre, covariance and rotation [bytes].
BYTES_OF_SPLAT = 4 * (3 + 6 + 4)
#: Splats whose stencils are computed together, which bounds memory.
_TOGETHER = 20_000
_POLAR_STEPS = wp.constant(5)
_LEAST, _MOST = wp.constant(STRETCH[0]), wp.constant(STRETCH[1])


@wp.struct
class SplatStencils:
    """Constants of ``S`` splats, whose gradients follow from the ``K`` particles each that move their centres."""

    slope: wp.array2d(dtype=wp.vec3)  # (K, S) gradient by the position of each of them [1/m]
    bound: wp.array(dtype=wp.mat33)  # (S,) projection on directions that turn with the bones; or no rows
    covariance: wp.array(dtype=vec6)  # (S,) at rest [m^2]


@wp.func
def blended_matrix(place: wp.array2d(dtype=wp.mat44), i: int, skin: wp.array(dtype=wp.vec4), s: int):
    """Return the matrix by which the bones turn the surroundings of a splat."""
    at = blend_places(place, i, skin, s, wp.vec3())
    x = blend_places(place, i, skin, s, wp.vec3(1.0, 0.0, 0.0)) - at
    y = blend_places(place, i, skin, s, wp.vec3(0.0, 1.0, 0.0)) - at
    z = blend_places(place, i, skin, s, wp.vec3(0.0, 0.0, 1.0)) - at
    return wp.matrix_from_cols(x, y, z)


@wp.func
def kept_stretch(sigma: float):
    """Return a singular value within the limits."""
    return wp.clamp(sigma, _LEAST, _MOST)


@wp.func
def size_of(m: wp.mat33):
    """Return the Frobenius norm of a matrix."""
    return wp.sqrt(wp.ddot(m, m))


@wp.func
def nearest_rotation(m: wp.mat33):
    """Return the rotation of a polar decomposition, of a matrix whose singular values are within some 1/30 and 30.

    After Higham ("Computing the polar decomposition - with applications", SIAM J. Sci. Stat. Comput. 7 (1986)).
    """
    q = m
    for _ in range(_POLAR_STEPS):
        inverse = wp.inverse(q)
        scale = wp.sqrt(size_of(inverse) / size_of(q))
        q = 0.5 * (scale * q + wp.transpose(inverse) / scale)
    return q


@wp.kernel
def turn_splats(
    envs: wp.array(dtype=int),
    surface: SkinSurface,
    motion: SkinMotion,
    workspace: SkinWorkspace,
    stencils: SplatStencils,
    first: int,
    # out
    covariances: wp.array2d(dtype=vec6),
    turns: wp.array2d(dtype=wp.quat),
):
    """Write covariances and rotations of splats, from ``first`` of every picture on; over ``(pictures, S)``."""
    i, s = wp.tid()
    e = envs[i]
    if e < 0:
        return
    # relative to one of the particles, for the slopes add up to zero, and places of the world are large
    turn = wp.mat33()
    origin = motion.x[e, motion.first + surface.used[surface.near[0, s]]]
    G = wp.mat33()
    for k in range(1, surface.near.shape[0]):
        place = motion.x[e, motion.first + surface.used[surface.near[k, s]]]
        G += wp.outer(place - origin, stencils.slope[k, s])
    if stencils.bound.shape[0] > 0:
        G += blended_matrix(workspace.place, i, surface.skin, s) * stencils.bound[s]
    # norms bound singular values, so that most matrices need no decomposition into these
    if wp.determinant(G) > 0.0 and size_of(G) < _MOST and size_of(wp.inverse(G)) * _LEAST < 1.0:
        turn = nearest_rotation(G)
    else:
        U, sigma, V = wp.svd3(G)
        if wp.determinant(U) * wp.determinant(V) < 0.0:
            # the smallest value, which comes last, takes the sign
            V = V * wp.diag(wp.vec3(1.0, 1.0, -1.0))
            sigma[2] = -sigma[2]
        kept = wp.diag(wp.vec3(kept_stretch(sigma[0]), kept_stretch(sigma[1]), kept_stretch(sigma[2])))
        G = U * kept * wp.transpose(V)
        turn = U * wp.transpose(V)
    c = stencils.covariance[s]
    C = G * wp.mat33(c[0], c[1], c[2], c[1], c[3], c[4], c[2], c[4], c[5]) * wp.transpose(G)
    covariances[i, first + s] = vec6(C[0, 0], C[0, 1], C[0, 2], C[1, 1], C[1, 2], C[2, 2])
    turns[i, first + s] = wp.normalize(wp.quat_from_matrix(turn))


def record_turns(
    graph: LaunchGraph,
    envs: wp.array,
    surface: SkinSurface,
    motion: SkinMotion,
    workspace: SkinWorkspace,
    stencils: SplatStencils,
    covariances: wp.array,
    turns: wp.array,
    first: int = 0,
) -> None:
    """Append the launch that writes covariances and rotations, after :func:`.skin.record_skin`, with its arguments."""
    inputs = [envs, surface, motion, workspace, stencils, first]
    graph.launch(turn_splats, (len(envs), len(stencils.covariance)), inputs, [covariances, turns])


@dataclass(frozen=True, eq=False)
class BoundSplats:
    """Splats of one avatar, bound to its bones and particles.

    Attributes:
        cloud: the splats in the rest pose, standing on the ground.
        skin: moves their centres.
        slope: gradient by the positions of the particles that move each splat [1/m], shape ``(S, K, 3)``.
        bound: projection on directions that the particles do not span, shape ``(S, 3, 3)``.
    """

    cloud: SplatCloud
    skin: Skin
    slope: np.ndarray
    bound: np.ndarray
    _uploaded: dict[str, SplatStencils] = field(default_factory=dict, init=False, repr=False)

    @staticmethod
    def of(
        asset: AvatarAsset,
        parameters: np.ndarray,
        rest_positions: np.ndarray,
        skin_joints: np.ndarray,
        skin_weights: np.ndarray,
    ) -> BoundSplats:
        """Bind the splats of a look.

        Args:
            asset: has them.
            parameters: of the body's shape.
            rest_positions: particles of that shape [m], shape ``(P, 3)``.
            skin_joints: joints that move each particle, shape ``(P, K)``.
            skin_weights: their weights, shape ``(P, K)``.

        Raises:
            ValueError: the asset has no splats.
        """
        body, splats = asset.shape_splats(parameters), asset.drawn.splats
        cloud = splats.cloud
        placed = SplatCloud(body.vertices, cloud.rotations, cloud.scales, cloud.opacities, cloud.sh)
        skin = Skin.baked(splats, body, rest_positions, skin_joints, skin_weights)
        return BoundSplats(placed, skin, *stencils_of(*skin.stencil, rest_positions))

    def upload(self, device: str) -> SplatStencils:
        """Return the constants on a device, uploaded once."""
        if device not in self._uploaded:
            self._uploaded[device] = self._upload(device)
        return self._uploaded[device]

    def _upload(self, device: str) -> SplatStencils:
        free = np.abs(self.bound).max(initial=0.0) == 0.0
        return fill(
            SplatStencils(),
            slope=_upload(self.slope.transpose(1, 0, 2), wp.vec3, device),
            bound=_upload(np.zeros((0, 3, 3)) if free else self.bound, wp.mat33, device),
            covariance=_upload(self.cloud.packed_covariances(), vec6, device),
        )


def stencils_of(near: np.ndarray, weights: np.ndarray, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return slopes and projections of :class:`BoundSplats`.

    Args:
        near: particles of each splat, shape ``(S, K)``.
        weights: their weights, rows sum to one, shape ``(S, K)``.
        rest: positions of the particles [m], shape ``(P, 3)``.
    """
    slope, bound = np.empty((*near.shape, 3), np.float32), np.empty((len(near), 3, 3), np.float32)
    for first in range(0, len(near), _TOGETHER):
        rows = slice(first, first + _TOGETHER)
        w, places = weights[rows], rest[near[rows]].astype(np.float64)
        offsets = places - (w[:, None] @ places)
        values, axes = np.linalg.eigh(offsets.transpose(0, 2, 1) @ (w[..., None] * offsets))
        spans = values > LEAST_SPREAD * values[:, 2:]
        inverse = np.where(spans, 1.0 / np.maximum(values, 1e-18), 0.0)
        slope[rows] = w[..., None] * ((offsets @ axes * inverse[:, None]) @ axes.transpose(0, 2, 1))
        bound[rows] = (axes * ~spans[:, None]) @ axes.transpose(0, 2, 1)
    return slope, bound


def _upload(values: np.ndarray, dtype: type, device: str) -> wp.array:
    return wp.array(np.ascontiguousarray(values, np.float32), dtype=dtype, device=device)


#: Splats that :func:`bound_splats` has bound.
_bound: WeakKeyDictionary[Flesh, BoundSplats] = WeakKeyDictionary()


def bound_splats(flesh: Flesh) -> BoundSplats:
    """Return the splats of an avatar, bound and uploaded once for all pictures of its simulation."""
    if flesh not in _bound:
        points, _ = flesh.shaped(flesh.base_parameters)
        given = flesh.asset, flesh.base_parameters, points.rest[0], points.skin_joints, points.skin_weights
        _bound[flesh] = BoundSplats.of(*given)
    return _bound[flesh]


class SplatMotion:
    """The splats of all avatars of a simulation that have such, in the environments of some pictures.

    Attributes:
        means: centres [m], ``(pictures, S)``.
        covariances: xx, xy, xz, yy, yz, zz [m^2], ``(pictures, S)``.
        turns: rotations from the rest pose, ``(pictures, S)``.
        bound: the splats by the index of the avatar.
        slices: which splats are an avatar's, by its index.
    """

    def __init__(self, simulation: Simulation, envs: wp.array) -> None:
        """Bind the splats, which takes seconds for hundreds of thousands.

        Args:
            simulation: the simulated world.
            envs: environment of each picture, ``(pictures,)`` int32 on its device; splats in that of a negative one
                stay where they are.
        """
        self.simulation, self.envs, self._device = simulation, envs, simulation.device
        self.bound: dict[int, BoundSplats] = {}
        self.slices: dict[int, slice] = {}
        first = 0
        for index, flesh in enumerate(simulation.flesh):
            if flesh.asset.drawn.splats is not None:
                self.bound[index] = bound_splats(flesh)
                self.slices[index] = slice(first, first + len(self.bound[index].cloud))
                first = self.slices[index].stop
        shape = (len(envs), first)
        self.means = wp.zeros(shape, dtype=wp.vec3, device=self._device)
        self.covariances = wp.zeros(shape, dtype=vec6, device=self._device)
        self.turns = wp.zeros(shape, dtype=wp.quat, device=self._device)

    @cached_property
    def opacities(self) -> np.ndarray:
        """Opacities of all splats, shape ``(S,)`` float32."""
        return np.concatenate([one.cloud.opacities for one in self.bound.values()] or [np.zeros(0, np.float32)])

    @cached_property
    def sh(self) -> np.ndarray:
        """Coefficients of their colours at rest, shape ``(S, K, 3)`` float32."""
        return joined_colors([one.cloud.sh for one in self.bound.values()])

    def __len__(self) -> int:
        return len(self.opacities)

    def record(self, graph: LaunchGraph) -> None:
        """Append the launches that write centres, covariances and rotations of all pictures from the present state."""
        for index, bound in self.bound.items():
            avatar, first = self.simulation.avatars[index], self.slices[index].start
            surface = bound.skin.upload(self._device)
            motion = motion_of(avatar, self.simulation.state.x)
            workspace = skin_workspace(surface, len(self.envs), self._device)
            record_skin(graph, self.envs, surface, motion, workspace, self.means, first)
            stencils = bound.upload(self._device)
            out = self.covariances, self.turns, first
            record_turns(graph, self.envs, surface, motion, workspace, stencils, *out)

    def moved(self, picture: int, avatar: int) -> MovedSplats:
        """Return the splats of an avatar in a picture, as they are now."""
        arrays = (self.means, self.covariances, self.turns)
        values = [array[picture].numpy()[self.slices[avatar]] for array in arrays]
        return MovedSplats(self.bound[avatar].cloud, *(value.copy() for value in values))
