"""The cloth of a world: all garments of an environment as one mesh, advanced by one launch per control step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from piavatar_envs.cloth.contact import Touches
from piavatar_envs.cloth.garment import NO_WEARER, Garment
from piavatar_envs.cloth.kernels import THREADS, Constants, Pattern, Workspace, advance_kernel, rows_of
from piavatar_envs.cloth.mesh import ClothMesh, joined
from piavatar_envs.cloth.obstacles import Obstacles
from piavatar_envs.cloth.self_contact import allocate_self_contacts, bytes_of_self_contact
from piavatar_envs.cloth.types import ClothSettings, ClothState, Fabrics
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import fill
from piavatar_envs.mpm.colliders import make_boundaries
from piavatar_envs.mpm.types import FAILURE_CLOTH, Boundaries

#: Arrays of :class:`~piavatar_envs.cloth.types.Fabrics`, by the attributes of a fabric.
FABRIC_FIELDS = ("areal_density", "stretch", "bending", "friction", "drag", "skin_drag")


class Textile:
    """All garments of a world on a device, their vertices one garment after another: what every solver needs of them.

    Attributes:
        garments: in this order.
        mesh: of all garments together.
        first: first vertex of each garment, and the number of vertices, shape ``(G + 1,)``.
        state: positions, velocities and nearest points.
        length: rest lengths of the edges of ``mesh`` [m], shape ``(rows, M)``.
        fabric: properties of the garments, ``(rows, G)`` each; written to at a reset if they differ by environment.
        settings: numerical parameters.
    """

    def __init__(
        self,
        garments: Sequence[Garment],
        settings: ClothSettings | None,
        num_envs: int,
        control_dt: float,
        device: str,
        rows: int,
        first_face: np.ndarray,
    ) -> None:
        """Upload the garments, draped and at rest; ``first_face`` has the first triangle of each wearer's piece."""
        self.garments, self.settings = tuple(garments), settings or ClothSettings()
        self.num_envs, self.control_dt, self.device = num_envs, control_dt, device
        self.mesh = joined([garment.mesh for garment in garments])
        self.first = np.cumsum([0, *(garment.mesh.num_vertices for garment in garments)])
        draped = np.concatenate([garment.draped for garment in garments])
        shape = (num_envs, self.mesh.num_vertices)
        self.state = fill(
            ClothState(),
            x=self._vectors(np.broadcast_to(draped, (*shape, 3))),
            v=wp.zeros(shape, dtype=wp.vec3, device=device),
            near=wp.full((*shape, 2), -1, dtype=int, device=device),
        )
        self.fabric = Fabrics()
        for name in FABRIC_FIELDS:
            values = np.array([[getattr(garment.fabric, name) for garment in garments]])
            setattr(self.fabric, name, self._floats(np.repeat(values, rows, axis=0)))
        self._pattern = self._upload(rows, first_face)
        self.length = self._pattern.length

    @property
    def mass(self) -> np.ndarray:
        """Masses of the vertices [kg], shape ``(rows, V)``; 0 of held ones, which count as the wearer's."""
        density = self.fabric.areal_density.numpy().astype(np.float64)
        free = self._pattern.held.numpy() < 0
        return np.where(free, self.mesh.area * np.repeat(density, np.diff(self.first), axis=1), 0.0)

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays that a checkpoint stores, by name."""
        return {"x": self.state.x, "v": self.state.v, "near": self.state.near}

    def _upload(self, rows: int, first_face: np.ndarray) -> Pattern:
        mesh, garments = self.mesh, self.garments
        garment = np.repeat(np.arange(len(garments)), np.diff(self.first))
        held = [each.held for each in garments]
        held_vertex = np.concatenate([each.vertices + at for each, at in zip(held, self.first, strict=False)])
        index = np.full(mesh.num_vertices, -1)
        index[held_vertex] = np.arange(len(held_vertex))
        fans = np.concatenate([np.roll(mesh.faces, -shift, axis=1) for shift in range(3)])
        fans = fans[np.argsort(fans[:, 0], kind="stable")]
        integers = {
            "color_start": mesh.color_start,
            "edge_garment": garment[mesh.edges[:, 0]],
            "garment": garment,
            "bending_start": mesh.bending_start,
            "bending_column": mesh.bending_column,
            "fan_start": np.searchsorted(fans[:, 0], np.arange(mesh.num_vertices + 1)),
            "sees": np.concatenate([each.sees for each in garments]),
            "wearer": np.array([each.wearer for each in garments]),
            "held": index,
            "held_vertex": held_vertex,
            "held_triangle": np.concatenate([first_face[each.wearer] + each.held.face for each in garments]),
        }
        floats = {
            "slackness": mesh.length**2 / mesh.edge_area,
            "area": mesh.area,
            "inverse_area": np.where(index < 0, 1.0 / mesh.area, 0.0),
            "bending_value": mesh.bending_value,
            "thickness": np.array([each.thickness for each in garments]),
            "held_offset": np.concatenate([each.offset for each in held]),
        }
        return fill(
            Pattern(),
            edges=wp.array(mesh.edges, dtype=wp.vec2i, device=self.device),
            length=self._floats(np.repeat(mesh.length[None], rows, axis=0)),
            fan=wp.array(np.ascontiguousarray(fans[:, 1:]), dtype=wp.vec2i, device=self.device),
            held_weights=self._vectors(np.concatenate([each.weights for each in held])),
            **{name: self._integers(values) for name, values in integers.items()},
            **{name: self._floats(values) for name, values in floats.items()},
        )

    def _integers(self, values: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=self.device)

    def _floats(self, values: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(values, np.float32), dtype=float, device=self.device)

    def _vectors(self, values: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.vec3, device=self.device)


def fastest_bending(garment: Garment, factor: float = 1.0) -> float:
    """Return the highest frequency of bending of a garment [rad/s], its stiffness over its mass times ``factor``."""
    fabric, held = garment.fabric, garment.held.vertices
    stiffest = garment.mesh.stiffest_bending(held) if fabric.bending > 0.0 else 0.0
    return float(np.sqrt(factor * fabric.bending / fabric.areal_density * stiffest))


def longest_substep(every: int, frequency: float) -> float:
    """Return the longest substep in which waves of a ``frequency`` [rad/s] do not grow [s].

    A force is that in the middle of ``every`` substeps, for which it stays. The step maps place and velocity linearly;
    by its trace and determinant, waves grow where ``every (every + 1) (frequency dt)^2`` is more than 4.
    """
    return 2.0 / (np.sqrt(every * (every + 1)) * max(frequency, 1e-12))


def fewest_substeps(frequency: float, control_dt: float) -> int:
    """Return how many substeps a control step [s] needs at least if forces are evaluated in each of them."""
    return int(np.ceil(control_dt / longest_substep(1, frequency)))


class Cloth(Textile):
    """All garments of a world, advanced by small steps of extended position-based dynamics; see :class:`Textile`."""

    def __init__(
        self,
        garments: Sequence[Garment],
        obstacles: Obstacles | None = None,
        boundaries: Boundaries | None = None,
        settings: ClothSettings | None = None,
        *,
        num_envs: int = 1,
        control_dt: float = 1.0 / 30.0,
        gravity: Sequence[float] = (0.0, 0.0, -9.81),
        device: str = "cpu",
        rows: int = 1,
        factor: float = 1.0,
    ) -> None:
        """Upload the garments, draped and at rest.

        Forces are evaluated more often than in the settings where stiff bending needs it.

        Args:
            garments: at least one.
            obstacles: surfaces that they touch; None for none.
            boundaries: floor and other colliders; None for none.
            settings: numerical parameters; the usual ones if None.
            num_envs: environments.
            control_dt: control step [s].
            gravity: acceleration [m/s^2].
            device: Warp device.
            rows: 1 for the same lengths and fabrics in all environments, else ``num_envs``.
            factor: greatest one on bending stiffness over mass that a reset may write.

        Raises:
            ValueError: a garment is worn by a piece that the obstacles lack, or its bending needs more substeps.
        """
        self._obstacles = no_obstacles(num_envs, device) if obstacles is None else obstacles
        self._boundaries = make_boundaries([], 1, 1, device) if boundaries is None else boundaries
        pieces = len(self._obstacles.piece_start) - 1
        for garment in garments:
            if garment.wearer >= pieces:
                raise ValueError(f"a {garment.kind} is worn by piece {garment.wearer}; the obstacles have {pieces}")
        super().__init__(garments, settings, num_envs, control_dt, device, rows, first_faces(self._obstacles))
        self._constants = self._make_constants(gravity, factor)
        self._workspace, self._touches = self._allocate()
        enabled = self.settings.self_collision
        self._self_contacts = allocate_self_contacts(self.mesh, rows_of(num_envs, device), device, enabled)

    def record_step(self, graph: LaunchGraph, failure: wp.array, failure_bit: int = FAILURE_CLOTH) -> None:
        """Append the launch that advances the cloth by a control step.

        Failed environments are not advanced. What cloth gives to the obstacles is added to their ``impulse``.

        Args:
            graph: to append to.
            failure: causes of failures, shape ``(num_envs,)`` int32.
            failure_bit: that is set where a position or a velocity is not finite.
        """
        threads = self.threads
        inputs = [self._pattern, self._constants, self.fabric, self._boundaries, failure_bit]
        changed = [self._obstacles, self.state, self._workspace, self._touches, self._self_contacts, failure]
        kernel = advance_kernel(self.settings.self_collision)
        graph.launch(kernel, (rows_of(self.num_envs, self.device), threads), inputs, changed, block_dim=threads)

    @property
    def threads(self) -> int:
        """Threads of an environment: a CUDA block, one on a CPU."""
        return THREADS if wp.get_device(self.device).is_cuda else 1

    def _make_constants(self, gravity: Sequence[float], factor: float) -> Constants:
        settings = self.settings
        dt, frequency = self.control_dt / settings.substeps, [fastest_bending(own, factor) for own in self.garments]
        every = [n for n in range(1, settings.forces_every + 1) if dt <= longest_substep(n, max(frequency))]
        if not every:
            garment = self.garments[int(np.argmax(frequency))]
            raise ValueError(
                f"cloth.substeps={settings.substeps} are too few for the bending of the {garment.kind} "
                f"(bending {garment.fabric.bending:g} N m, {garment.fabric.areal_density:g} kg/m^2, edges of "
                f"{1e3 * garment.mesh.length.mean():.0f} mm{_by(factor)}), which needs at least "
                f"{fewest_substeps(max(frequency), self.control_dt)}; set it, or give the garment less `bending` or a "
                "longer `edge`"
            )
        return fill(
            Constants(),
            settings,
            forces_every=every[-1],
            dt=dt,
            gravity=wp.vec3(*map(float, gravity)),
            wind=wp.vec3(*map(float, settings.wind)),
            keep=1.0 - settings.damping,
        )

    def _allocate(self) -> tuple[Workspace, Touches]:
        n, vertices = rows_of(self.num_envs, self.device), self.mesh.num_vertices
        held = len(self._pattern.held_vertex)
        # garments without a wearer touch every piece in the second slot
        alone = len(self._obstacles.piece_start) - 1 <= 1 and all(each.wearer != NO_WEARER for each in self.garments)
        slots = 1 if alone else 2

        def vectors(count: int) -> wp.array:
            return wp.zeros((n, count), dtype=wp.vec3, device=self.device)

        def floats(count: int) -> wp.array:
            return wp.zeros((n, count), dtype=float, device=self.device)

        workspace = fill(
            Workspace(),
            multiplier=floats(self.mesh.num_edges),
            softness=floats(len(self.garments)),
            **{name: vectors(vertices) for name in ("acceleration", "correction")},
            **{name: vectors(held) for name in ("pull", "held_impulse", "held_moment")},
        )
        touches = fill(
            Touches(),
            slots=slots,
            triangle=wp.full((n, slots * vertices), -1, dtype=int, device=self.device),
            weights=wp.zeros((n, slots * vertices), dtype=wp.vec2, device=self.device),
            near_collider=wp.zeros((n, vertices), dtype=int, device=self.device),
            **{name: vectors(slots * vertices) for name in ("point", "way", "normal", "impulse", "moment")},
        )
        return workspace, touches


def _by(factor: float) -> str:
    """Return a part of a message that names a factor on bending stiffness over mass, if there is one."""
    return "" if factor == 1.0 else f", times up to {factor:.3g} by `randomize`"


def bytes_of_cloth(
    mesh: ClothMesh, slots: int, self_collision: bool = False, num_envs: int = 1, device: str = "cpu"
) -> int:
    """Return the memory of a garment in an environment of a batch, with ``slots`` contacts a vertex [bytes].

    Lengths of edges that differ by environment are included; the few held vertices are not.
    """
    state, motion, contact = 2 * 12 + 2 * 4, 2 * 12 + 4, 5 * 12 + 2 * 4 + 4
    apart = bytes_of_self_contact(mesh) if self_collision else 0
    row = mesh.num_vertices * (motion + slots * contact) + 4 * mesh.num_edges + apart
    own = mesh.num_vertices * state + 4 * mesh.num_edges
    return own + -(-row * rows_of(num_envs, device) // num_envs)


def first_faces(obstacles: Obstacles) -> np.ndarray:
    """Return the first triangle of each piece, and the number of triangles, shape ``(P + 1,)``."""
    corner = obstacles.faces.numpy().reshape(-1, 3)[:, 0]
    return np.array([np.count_nonzero(corner < first) for first in obstacles.piece_start.numpy()])


def no_obstacles(num_envs: int, device: str) -> Obstacles:
    """Return the obstacles of a world without any."""
    o = Obstacles()
    for name in ("start", "end", "start_normal", "end_normal"):
        setattr(o, name, wp.zeros((num_envs, 0), dtype=wp.vec3, device=device))
    o.faces = wp.zeros(0, dtype=wp.vec3i, device=device)
    for name in ("ring", "fan", "part", "post"):
        setattr(o, name, wp.zeros(0, dtype=int, device=device))
    for name in ("ring_start", "fan_start", "piece_start", "post_start"):
        setattr(o, name, wp.zeros(1, dtype=int, device=device))
    o.impulse = wp.zeros((num_envs, 0, 6), dtype=wp.int64, device=device)
    return o
