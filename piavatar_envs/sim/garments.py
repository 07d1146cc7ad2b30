"""Garments of a world: the surfaces that cloth touches, and cloth within the control step.

A control step moves the bodies first, then the cloth along with them, and at last the particles receive what the cloth
has given to the surfaces. Nothing but the cloth itself is carried from one step to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import warp as wp
from scipy import sparse

from piavatar_envs.avatar.avatar import Avatar
from piavatar_envs.avatar.skin import (
    Skin,
    SkinSurface,
    bone_surface,
    motion_of,
    record_skin,
    skin_bytes,
    skin_workspace,
    with_shape,
)
from piavatar_envs.cloth.garment import Garment
from piavatar_envs.cloth.mesh import ClothMesh
from piavatar_envs.cloth.obstacles import ObstacleSurfaces, Piece, bytes_of_obstacles
from piavatar_envs.cloth.proxy import ALL_PARTS, PROXY_VERTICES, proxy_of
from piavatar_envs.cloth.remesh import remesh
from piavatar_envs.cloth.solver import Cloth, Textile, bytes_of_cloth
from piavatar_envs.cloth.types import ClothSettings, ClothState
from piavatar_envs.config import ConfigError, EnvConfig, GarmentConfig
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.types import Model, State
from piavatar_envs.sim.bodies import Flesh
from piavatar_envs.sim.prop_geometry import PropPoints
from piavatar_envs.sim.prop_surface import SolidSurface, deform_prop
from piavatar_envs.sim.props import PropSet
from piavatar_envs.sim.shapes import Shapes

wp.set_module_options({"enable_backward": False})

#: Most vertices of a prop's surface that cloth touches as it is drawn; of a finer one so many remain.
MOST_PROP_VERTICES = 800


def worn_by(config: EnvConfig, flesh: Flesh) -> tuple[GarmentConfig, ...]:
    """Return the settings of an avatar's garments: its own, or those of the environment."""
    return config.garments if flesh.avatar.garments is None else flesh.avatar.garments


def tailor(config: EnvConfig, flesh: Sequence[Flesh]) -> list[Garment]:
    """Return the garments of all avatars, cut and draped on their configured shapes.

    Raises:
        ConfigError: a garment does not fit a body.
    """
    from piavatar_envs.cloth.tailor import make_garment  # not needed in a world without garments

    garments = []
    for index, own in enumerate(flesh):
        for layer, given in enumerate(worn_by(config, own)):
            wearer = own.asset, own.base_parameters, index, own.shape.randomize, layer
            try:
                garment = make_garment(given.kind, given.settings, given.cloth, *wearer)
            except (OSError, TypeError, ValueError) as error:
                raise ConfigError(f"garments: {error}") from None
            garments.append(garment if given.color is None else replace(garment, colors=None, source=None))
    return garments


class WornCloth:
    """All garments of a world, whatever solver moves them: how a reset places them, and what a checkpoint stores.

    Attributes:
        garments: in the order of their avatars.
        cloth: the garments, simulated.
        graded: whether random shapes change lengths.
        reacts_at_end: whether bodies receive impulses after the last substep.
    """

    reacts_at_end = False

    def __init__(
        self,
        garments: Sequence[Garment],
        cloth: Textile,
        flesh: Sequence[Flesh],
        avatars: Sequence[Avatar],
        shapes: Shapes,
        model: Model,
        state: State,
    ) -> None:
        """Upload what places the garments; nothing is placed until the first reset.

        Args:
            garments: of :func:`tailor`, at least one.
            cloth: of these garments.
            flesh: of the world, as all that follows.
            avatars: likewise.
            shapes: likewise.
            model: likewise.
            state: likewise.
        """
        self.garments, self.cloth, self._model, self._state = tuple(garments), cloth, model, state
        self.graded = is_graded(garments, flesh)
        self._worn = [
            _Worn(garment, flesh[garment.wearer], avatars[garment.wearer], shapes, state) for garment in garments
        ]
        self._chosen = wp.zeros(model.num_envs, dtype=int, device=model.device)
        draped = np.concatenate([garment.draped for garment in garments])
        edges = cloth.mesh.edges
        span = np.linalg.norm(draped[edges[:, 0]] - draped[edges[:, 1]], axis=1)
        self._edges = wp.array(edges.astype(np.int32), dtype=wp.vec2i, device=model.device)
        # length of the pattern over that in the drape
        self._ease = wp.array((cloth.mesh.length / span).astype(np.float32), dtype=float, device=model.device)

    def record_begin(self, graph: LaunchGraph) -> None:
        """Append the start of a control step, before the bodies move."""

    def record_before_substep(self, graph: LaunchGraph) -> None:
        """Append what precedes a substep of the bodies."""

    def record_end(self, graph: LaunchGraph) -> None:
        """Append the end of a control step, after the bodies have moved."""

    def record_reset(self, graph: LaunchGraph, mask: wp.array) -> None:
        """Append the placement of garments in the masked environments: draped, in the pose of the wearer, at rest.

        Garments on random shapes are graded, their edges by the same ratio as the distances in the drape.
        """
        state, n = self.cloth.state, self._model.num_envs
        graph.launch(lay_down, state.x.shape, [mask], [self._chosen, state])
        if self.graded:
            for worn, first in zip(self._worn, self.cloth.first, strict=False):
                inputs = [self._chosen, worn.surface, worn.motion.shape, int(first)]
                graph.launch(grade_places, (n, worn.count), inputs, [state.x])
            inputs = [mask, self._edges, self._ease, state.x]
            graph.launch(grade_lengths, self.cloth.length.shape, inputs, [self.cloth.length])
        for worn, first in zip(self._worn, self.cloth.first, strict=False):
            given = worn.surface, worn.motion, worn.workspace, state.x, int(first)
            record_skin(graph, self._chosen, *given)

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays of a checkpoint by name."""
        found = {f"cloth.{name}": array for name, array in self.cloth.arrays().items()}
        return found | ({"cloth.length": self.cloth.length} if self.graded else {})


def is_graded(garments: Sequence[Garment], flesh: Sequence[Flesh]) -> bool:
    """Return whether an avatar that wears a garment has random shapes."""
    return any(flesh[garment.wearer].shape.randomize for garment in garments)


class Garments(WornCloth):
    """All garments of a world by :class:`~piavatar_envs.cloth.solver.Cloth`, which follows the bodies.

    Attributes:
        surfaces: skins of all avatars and surfaces of all props.
    """

    reacts_at_end = True

    def __init__(
        self,
        garments: Sequence[Garment],
        config: EnvConfig,
        flesh: Sequence[Flesh],
        avatars: Sequence[Avatar],
        props: PropSet,
        shapes: Shapes,
        model: Model,
        state: State,
    ) -> None:
        """Allocate the cloth and the surfaces that it touches.

        Args:
            garments: of :func:`tailor`, at least one.
            config: of the environment.
            flesh: of the world, as all that follows.
            avatars: likewise.
            props: likewise.
            shapes: likewise.
            model: likewise.
            state: likewise.

        Raises:
            ConfigError: the cloth bends too stiffly for its substeps.
        """
        bodies = enumerate(zip(flesh, avatars, strict=True))
        pieces = [avatar_piece(index, *body, shapes, state) for index, body in bodies]
        pieces += [prop_piece(column, props, state) for column in range(len(props))]
        self.surfaces = ObstacleSurfaces(pieces, model)
        own, factors = config.cloth, config.randomize
        try:
            cloth = Cloth(
                garments,
                self.surfaces.obstacles,
                model.boundaries,
                ClothSettings(own.substeps, own.sweeps, wind=own.wind, self_collision=own.self_collision),
                num_envs=model.num_envs,
                control_dt=model.control_dt,
                gravity=tuple(model.step.gravity),
                device=model.device,
                rows=model.num_envs if is_graded(garments, flesh) else 1,
                factor=factors.cloth_stiffness_factor[1] / factors.cloth_mass_factor[0],
            )
        except ValueError as error:
            raise ConfigError(str(error)) from None
        super().__init__(garments, cloth, flesh, avatars, shapes, model, state)

    def record_begin(self, graph: LaunchGraph) -> None:
        """Append the start of a control step: the surfaces as they are before the bodies move."""
        self.surfaces.record_start(graph)

    def record_end(self, graph: LaunchGraph) -> None:
        """Append the end of a control step: cloth follows the surfaces, and particles receive its impulses."""
        self.surfaces.record_end(graph)
        self.cloth.record_step(graph, self._state.failure)
        self.surfaces.record_reaction(graph, self._state)


class _Worn:
    """A garment as its wearer's bones place it at a reset.

    Attributes:
        count: number of vertices.
        surface: its drape where shapes are fixed; else that of the mean shape, and its changes with the shape.
        motion: pose of the last reset, and the shape.
        workspace: of :func:`~piavatar_envs.avatar.skin.record_skin`.
    """

    def __init__(self, garment: Garment, flesh: Flesh, avatar: Avatar, shapes: Shapes, state: State) -> None:
        device, rest, deltas, shape = avatar.model.device, garment.draped, None, None
        if flesh.shape.randomize:
            deltas, shape = garment.shape_deltas, shapes.parameters(garment.wearer)
            given = flesh.base_parameters[:, None]
            halves = np.concatenate([np.maximum(-given, 0.0), np.maximum(given, 0.0)], axis=1)
            rest = rest - np.tensordot(halves.ravel(), deltas, axes=1)
        self.count = len(rest)
        self.surface = bone_surface(rest, garment.skin_joints, garment.skin_weights, device, deltas)
        self.motion = motion_of(avatar, state.x, avatar.placed, shape)
        self.workspace = skin_workspace(self.surface, avatar.model.num_envs, device)


def bytes_of_garments(
    meshes: Sequence[ClothMesh],
    flesh: Sequence[Flesh],
    points: Sequence[PropPoints],
    self_collision: bool = False,
    num_envs: int = 1,
    device: str = "cpu",
) -> int:
    """Estimate the memory of the garments of an environment and of what they touch [bytes]; 0 without garments.

    Args:
        meshes: of all garments.
        flesh: of all avatars.
        points: of all props.
        self_collision: whether garments keep apart from each other.
        num_envs: environments of the batch, which share what cloth works in.
        device: Warp device.
    """
    if not meshes:
        return 0
    surface = len(flesh) * PROXY_VERTICES + sum(min(len(own.vertices), MOST_PROP_VERTICES) for own in points)
    skins = sum(skin_bytes(len(own.points.rest[0])) for own in flesh) + len(meshes) * skin_bytes(0)
    slots = 2 if len(flesh) + len(points) > 1 else 1
    cloth = sum(bytes_of_cloth(own, slots, self_collision, num_envs, device) for own in meshes)
    return bytes_of_obstacles(surface) + skins + cloth


@wp.kernel
def lay_down(
    mask: wp.array(dtype=wp.bool),
    # out
    chosen: wp.array(dtype=int),
    state: ClothState,
):
    """Choose the masked environments, others are -1, and stop their cloth; over ``(num_envs, V)``."""
    e, i = wp.tid()
    if i == 0:
        chosen[e] = wp.where(mask[e], e, -1)
    if mask[e]:
        state.v[e, i] = wp.vec3(0.0)
        for slot in range(2):
            state.near[e, i, slot] = -1


@wp.kernel
def grade_places(
    chosen: wp.array(dtype=int),
    surface: SkinSurface,
    shape: wp.array2d(dtype=float),
    first: int,
    # out
    x: wp.array2d(dtype=wp.vec3),
):
    """Write a garment in the rest pose of chosen environments' shapes, from ``first`` on; over ``(num_envs, V)``."""
    e, i = wp.tid()
    if chosen[e] >= 0:
        x[e, first + i] = with_shape(surface, shape, e, i)


@wp.kernel
def grade_lengths(
    mask: wp.array(dtype=wp.bool),
    edges: wp.array(dtype=wp.vec2i),
    ease: wp.array(dtype=float),
    x: wp.array2d(dtype=wp.vec3),
    # out
    length: wp.array2d(dtype=float),
):
    """Set the rest lengths of the masked environments' edges, ``ease`` times those in ``x``; over ``(num_envs, M)``."""
    e, k = wp.tid()
    if mask[e]:
        length[e, k] = ease[k] * wp.length(x[e, edges[k][0]] - x[e, edges[k][1]])


def avatar_piece(index: int, flesh: Flesh, avatar: Avatar, shapes: Shapes, state: State) -> Piece:
    """Return the proxy skin of avatar ``index`` of a world, which its bones and particles deform."""
    device, n = avatar.model.device, avatar.model.num_envs
    proxy = proxy_of(flesh.asset)
    few, body = proxy.of(flesh.asset), flesh.asset.shape(flesh.base_parameters)
    points, _ = flesh.shaped(flesh.base_parameters)
    rest = type(body)(body.vertices[proxy.keep], body.joints)
    skin = Skin.baked(few, rest, points.rest[0], points.skin_joints, points.skin_weights)
    varies = flesh.shape.randomize
    surface = skin.upload(device, few if varies else None)
    motion = motion_of(avatar, state.x, shape=shapes.parameters(index) if varies else None)
    workspace, envs = skin_workspace(surface, n, device), _all(n, device)

    def record(graph: LaunchGraph, vertices: wp.array, first: int) -> None:
        record_skin(graph, envs, surface, motion, workspace, vertices, first)

    weights = _placed(skin.weights, avatar.body.first, avatar.model.num_particles)
    return Piece(rest.vertices, proxy.faces, proxy.part, weights, record)


def prop_piece(column: int, props: PropSet, state: State) -> Piece:
    """Return the surface of the prop in a ``column``, which its particles deform."""
    model, prop, points = props.model, props.props[column], props.points[column]
    vertices, faces = points.vertices, points.faces
    if len(np.unique(faces)) > MOST_PROP_VERTICES:
        found = remesh(vertices, faces, MOST_PROP_VERTICES)
        vertices, faces = vertices[found.keep], found.faces
    solid = SolidSurface(points.rest, vertices, faces)
    surface, envs = solid.upload(model.device), _all(model.num_envs, model.device)

    def record(graph: LaunchGraph, into: wp.array, first: int) -> None:
        tracked = props.state.position, props.state.rotation
        inputs = [envs, surface, prop.first, column, *tracked, state.x, first]
        graph.launch(deform_prop, (model.num_envs, len(vertices)), inputs, [into])

    weights = _placed(solid.weights(), prop.first, model.num_particles)
    return Piece(vertices, faces, np.full(len(vertices), ALL_PARTS), weights, record)


def _placed(weights: sparse.csr_array, first: int, num_particles: int) -> sparse.csr_array:
    """Return weights of a body's particles as weights of all, of which its own begin at ``first``."""
    parts = (weights.data, weights.indices + first, weights.indptr)
    return sparse.csr_array(parts, shape=(weights.shape[0], num_particles))


def _all(num_envs: int, device: str) -> wp.array:
    return wp.array(np.arange(num_envs, dtype=np.int32), dtype=int, device=device)
