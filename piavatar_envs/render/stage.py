"""The stage: all surfaces of a simulation, computed on its device for any number of its environments.

What stands there never changes: avatars, soft props, the scene's colliders, the task's markers, then garments. Only
vertices do.
They take 12 bytes each per picture, and the particles right beneath a skin as much: some 0.23 MB per picture of the
embedded body, 0.24 GB of 1,024. All else is shared by the pictures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.textures import Textures
from piavatar_envs.avatar.skin import Skin, motion_of, record_skin, skin_bytes, skin_workspace
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import fill
from piavatar_envs.render.garments import Drapery, garment_names
from piavatar_envs.render.markers import MarkerMeshes, place_markers, unit_mesh, upload_meshes
from piavatar_envs.render.scene import PALETTE, PROP, Color
from piavatar_envs.render.splat_motion import BYTES_OF_SPLAT, SplatMotion
from piavatar_envs.render.splats import SplatPainter
from piavatar_envs.render.surfaces import MeshPart, Surfaces
from piavatar_envs.render.wearing import worn_asset
from piavatar_envs.sim.markers import Markers, MarkerSpec, allocate_markers
from piavatar_envs.sim.prop_surface import SolidSurface, deform_prop
from piavatar_envs.sim.world import Simulation

if TYPE_CHECKING:
    from piavatar_envs.cloth.garment import Garment

wp.set_module_options({"enable_backward": False})

#: Kinds of colliders that are drawn; planes are not.
_DRAWN_COLLIDERS = ("sphere", "box", "capsule")
#: Memory of a vertex in a picture [bytes].
BYTES_OF_VERTEX = 12
#: The name of the markers among the subjects.
MARKERS = "markers"


@dataclass(frozen=True, eq=False)
class Part:
    """One mesh on the stage.

    Attributes:
        name: of the avatar, prop or collider; :data:`MARKERS` of a marker.
        kind: ``"avatar"``, ``"prop"``, ``"garment"``, or the kind of the collider or marker.
        vertices: which of the stage's are its own.
        faces: triangles, counted from its first vertex, shape ``(T, 3)`` int32.
        color: sRGB in [0, 1].
        colors: sRGB of the vertices instead, shape ``(V, 3)`` uint8.
        textures: of the base colour instead, where a view has them.
        subject: its label, an index into :attr:`Stage.subjects`.
    """

    name: str
    kind: str
    vertices: slice
    faces: np.ndarray
    color: Color
    colors: np.ndarray | None
    textures: Textures | None
    subject: int

    @property
    def num_vertices(self) -> int:
        """Return the number of its vertices."""
        return self.vertices.stop - self.vertices.start


def bytes_of_stage(simulation: Simulation, markers: Sequence[MarkerSpec] = ()) -> int:
    """Return the memory of a picture's vertices and splats, and of what skins work in, at most [bytes].

    Args:
        simulation: the simulated world.
        markers: what the task shows besides.
    """
    assets = _drawn_assets(simulation)
    bodies = [(asset.drawn, len(own.points.rest[0])) for asset, own in zip(assets, simulation.flesh, strict=True)]
    vertices = sum(len(drawn.vertices) for drawn, _ in bodies)
    vertices += sum(len(solid.vertices) for solid in simulation.props.points)
    kinds = [solid.kind for solid in simulation.subjects.colliders[: len(simulation.subjects.collider_names)]]
    kinds = [kind for kind in kinds if kind in _DRAWN_COLLIDERS] + [spec.kind for spec in markers]
    vertices += sum(len(unit_mesh(kind)[0]) for kind in kinds)
    clouds = [(drawn.splats, particles) for drawn, particles in bodies if drawn.splats is not None]
    splats = sum(len(splats.cloud) for splats, _ in clouds)
    skins = sum(skin_bytes(particles) for _, particles in (*bodies, *clouds))
    return BYTES_OF_VERTEX * vertices + BYTES_OF_SPLAT * splats + skins + _drapery(simulation).bytes_of_picture


def _garments(simulation: Simulation) -> Sequence[Garment]:
    """Return the garments of a simulation."""
    return () if simulation.garments is None else simulation.garments.garments


def _drapery(simulation: Simulation) -> Drapery:
    """Return the drawn surfaces of all garments of a simulation."""
    return Drapery(_garments(simulation), [flesh.asset for flesh in simulation.flesh])


def _drawn_assets(simulation: Simulation) -> list[AvatarAsset]:
    """Return the assets of all avatars as they are drawn under their garments."""
    garments = _garments(simulation)
    if not garments:
        return [flesh.asset for flesh in simulation.flesh]
    return [
        worn_asset(flesh, [own for own in garments if own.wearer == index])
        for index, flesh in enumerate(simulation.flesh)
    ]


@wp.kernel
def choose_shown(drawn: wp.array[wp.bool], envs: wp.array[int], shown: wp.array[int]):
    """Write the environments of pictures that change, and -1 for the others; over ``(pictures,)``."""
    i = wp.tid()
    shown[i] = wp.where(drawn[i], envs[i], -1)


class Stage:
    """Surfaces of a simulation in the environments of some pictures.

    A task whose markers move writes :attr:`markers` before the stage is recorded::

        stage = Stage(simulation, task.marker_specs())
        task.record_markers(env, graph, stage.markers)
        stage.record(graph)

    Attributes:
        num_pictures: number of pictures, the first dimension of :attr:`vertices`.
        envs: environment of each picture, ``(num_pictures,)`` int32.
        parts: what stands there, in the order of the vertices.
        subjects: names by label: the ground, avatars, props, colliders, all markers together, and every garment.
        skins, solids: the surfaces of every avatar and prop.
        splats: the splats of all avatars that are drawn as such; None without any.
        vertices: in the world [m], ``(num_pictures, vertices)``; NaN of a marker that is hidden.
        markers: of all environments, where they are; written by the task.
    """

    def __init__(
        self, simulation: Simulation, markers: Sequence[MarkerSpec] = (), envs: Sequence[int] | None = None
    ) -> None:
        """Bake the surfaces, which takes a second for a body that this process has not drawn yet.

        Args:
            simulation: the simulated world.
            markers: what the task shows besides.
            envs: environments to show, one per picture; all if not given.
        """
        self.simulation, self.device = simulation, simulation.device
        chosen = np.arange(simulation.num_envs) if envs is None else np.asarray(envs)
        self.num_pictures = len(chosen)
        self.envs = wp.array(chosen.astype(np.int32), dtype=int, device=self.device)
        self._shown = wp.zeros_like(self.envs)
        self._every = wp.full(self.num_pictures, True, dtype=wp.bool, device=self.device)
        self.parts: list[Part] = []
        names = simulation.subjects.names
        boundaries = simulation.subjects.colliders[: len(simulation.subjects.collider_names)]
        self._colliders = [i for i, solid in enumerate(boundaries) if solid.kind in _DRAWN_COLLIDERS]
        solids = tuple(simulation.subjects.collider_names[i] for i in self._colliders)
        worn = garment_names(_garments(simulation), names)
        self.subjects = ("ground", *names, *solids, *([MARKERS] if markers else []), *worn)
        self._assets, self._drapery = _drawn_assets(simulation), _drapery(simulation)
        self.skins = [self._bake(index) for index in range(len(simulation.avatars))]
        self.solids = [SolidSurface(own.rest, own.vertices, own.faces) for own in simulation.props.points]
        self._list_parts(names, markers)
        count = self.parts[-1].vertices.stop if self.parts else 0
        self.vertices = wp.zeros((self.num_pictures, count), dtype=wp.vec3, device=self.device)
        self.markers = allocate_markers(markers, simulation.num_envs, self.device)
        self._specs = tuple(markers)
        splats = SplatMotion(simulation, self._shown)
        self.splats = splats if splats.bound else None

    @cached_property
    def surfaces(self) -> Surfaces:
        """The surfaces for a painter, on the device: one colouring for all pictures.

        Of avatars that are drawn as splats, only the shadow of the body's skin.
        """
        meshes = []
        for index, part in enumerate(self.parts):
            drawn = self.splats is None or index not in self.splats.bound
            given = part.num_vertices, part.faces, part.color, part.colors, part.textures
            meshes.append(MeshPart(*given, subject=part.subject, is_drawn=drawn))
        return Surfaces.build(meshes, self.device)

    def layers(self, height: int, width: int) -> list[SplatPainter]:
        """Return what a painter of such pictures has to draw over the surfaces: nothing, or the splats."""
        if self.splats is None:
            return []
        labels = np.zeros(len(self.splats), np.uint8)
        for avatar, own in self.splats.slices.items():
            labels[own] = self.parts[avatar].subject
        own = self.splats
        given = own.opacities, own.sh, self.num_pictures, height, width, self.device
        return [SplatPainter(*given, motion=(own.means, own.covariances, own.turns), subjects=labels)]

    def select(self, envs: Sequence[int]) -> None:
        """Show these environments from now on, as many as there are pictures."""
        self.envs.assign(np.asarray(envs, np.int32))

    def _bake(self, avatar: int) -> Skin:
        """Return the skin of an avatar, with the weights of its configured shape."""
        flesh = self.simulation.flesh[avatar]
        points, _ = flesh.shaped(flesh.base_parameters)
        asset = self._assets[avatar]
        skinning = points.rest[0], points.skin_joints, points.skin_weights
        return Skin.baked(asset.drawn, asset.shape_drawn(flesh.base_parameters), *skinning, points.correctives)

    def _list_parts(self, names: Sequence[str], markers: Sequence[MarkerSpec]) -> None:
        """Lay the meshes of all parts one after the other."""
        simulation, avatars = self.simulation, len(self.simulation.avatars)
        for index, asset in enumerate(self._assets):
            drawn = asset.drawn
            color = PALETTE[index % len(PALETTE)]
            given = len(drawn.vertices), drawn.faces, color, drawn.colors_of(index), drawn.textures
            self._add(1 + index, "avatar", *given)
        for subject, solid in enumerate(self.solids, 1 + avatars):
            self._add(subject, "prop", len(solid.vertices), solid.faces, PROP)
        for subject, collider in enumerate(self._colliders, 1 + len(names)):
            kind = simulation.subjects.colliders[collider].kind
            local, faces = unit_mesh(kind)
            self._add(subject, kind, len(local), faces, PROP)
        for spec in markers:
            local, faces = unit_mesh(spec.kind)
            self._add(1 + len(names) + len(self._colliders), spec.kind, len(local), faces, spec.color)
        first = len(self.subjects) - len(self._drapery.meshes)
        for subject, mesh in enumerate(self._drapery.meshes, first):
            color = tuple(float(value) / 255.0 for value in mesh.colors[0])
            self._add(subject, "garment", mesh.num_vertices, mesh.faces, color, mesh.colors, mesh.textures)

    def _add(
        self, subject: int, kind: str, count: int, faces: np.ndarray, color: Color, colors: np.ndarray | None = None,
        textures: Textures | None = None,
    ) -> None:  # fmt: skip
        """Append a part; names are not unique, because a prop may be called as the markers are."""
        first = self.parts[-1].vertices.stop if self.parts else 0
        name = self.subjects[subject]
        self.parts.append(Part(name, kind, slice(first, first + count), faces, color, colors, textures, subject))

    def record(self, graph: LaunchGraph, drawn: wp.array | None = None) -> None:
        """Append the launches that write the vertices of pictures from the present state.

        Args:
            graph: the graph to append to.
            drawn: pictures whose vertices change, ``(num_pictures,)`` bool; all if not given.
        """
        drawn = self._every if drawn is None else drawn
        graph.launch(choose_shown, self.num_pictures, [drawn, self.envs], [self._shown])
        if self.splats is not None:
            self.splats.record(graph)
        graph.parallel(self._launches)

    @cached_property
    def _launches(self) -> LaunchGraph:
        """The launches for surfaces, which all graphs share with what they work in."""
        graph = LaunchGraph(self.device)
        first = iter([part.vertices.start for part in self.parts])
        for avatar in range(len(self.skins)):
            self._record_skin(graph, avatar, next(first))
        props, x = self.simulation.props, self.simulation.state.x
        for column, (prop, solid) in enumerate(zip(props.props, self.solids, strict=True)):
            inputs = [self._shown, solid.upload(self.device), prop.first, column, props.state.position]
            inputs += [props.state.rotation, x, next(first)]
            graph.launch(deform_prop, (self.num_pictures, len(solid.vertices)), inputs, [self.vertices])
        if self._colliders:
            solids = [self.simulation.subjects.colliders[i] for i in self._colliders]
            meshes = upload_meshes([s.kind for s in solids], [s.size for s in solids], self.device, self._colliders)
            self._record_solids(graph, meshes, self._placed_colliders(), next(first))
        if self._specs:
            meshes = upload_meshes([s.kind for s in self._specs], [s.size for s in self._specs], self.device)
            own = self.parts[len(self.parts) - len(self._drapery.meshes) - len(self._specs)]
            self._record_solids(graph, meshes, self.markers, own.vertices.start)
        if self._drapery.meshes:
            cloth, begin = self.simulation.garments.cloth.state.x, self.parts[-1].vertices.stop
            begin -= self._drapery.num_vertices
            self._drapery.record(graph, self._shown, cloth, self.vertices, begin, self.device)
        return graph

    def _record_skin(self, graph: LaunchGraph, index: int, first: int) -> None:
        """Append the skin of an avatar."""
        simulation, avatar, flesh = self.simulation, self.simulation.avatars[index], self.simulation.flesh[index]
        varies = flesh.shape.randomize
        surface = self.skins[index].upload(self.device, self._assets[index] if varies else None)
        shape = simulation.shapes.parameters(index) if varies else None
        motion = motion_of(avatar, simulation.state.x, shape=shape)
        workspace = skin_workspace(surface, self.num_pictures, self.device)
        record_skin(graph, self._shown, surface, motion, workspace, self.vertices, first)

    def _placed_colliders(self) -> Markers:
        """Return the live arrays of all colliders, as markers."""
        boundaries = self.simulation.model.boundaries
        shape = (1, boundaries.position.shape[1])
        return fill(
            Markers(),
            position=boundaries.position,
            rotation=boundaries.rotation,
            scale=wp.ones(shape, dtype=float, device=self.device),
            visible=wp.array(np.ones(shape, bool), dtype=wp.bool, device=self.device),
        )

    def _record_solids(self, graph: LaunchGraph, meshes: MarkerMeshes, placed: Markers, first: int) -> None:
        """Append the launch that places the meshes of colliders or markers."""
        shape = (self.num_pictures, len(meshes.local))
        graph.launch(place_markers, shape, [self._shown, meshes, placed, first], [self.vertices])
