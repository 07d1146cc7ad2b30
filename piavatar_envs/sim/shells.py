"""Garments of a world as thin shells in MPM: their particles among those of the world, and their part of its step.

The particles of garments follow those of avatars and props. A garment has a velocity field of its own, with the
friction of its fabric, and belongs to the subject of its wearer: contact sensors count what it touches as the
wearer's, and not what it does to the wearer itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import warp as wp
from scipy import sparse

from piavatar_envs.avatar.avatar import Avatar
from piavatar_envs.cloth.garment import Garment
from piavatar_envs.cloth.mesh import ClothMesh
from piavatar_envs.cloth.shell import Holds, Shell, ShellMatter, check_edges, hold_weights
from piavatar_envs.cloth.types import ClothSettings
from piavatar_envs.config import ClothConfig, ConfigError, EnvConfig
from piavatar_envs.config.schema import UNCHANGED
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.colliders import Collider
from piavatar_envs.mpm.model import choose_num_substeps
from piavatar_envs.mpm.types import CFL_STABLE, Model, Scratch, State
from piavatar_envs.sim.bodies import Flesh
from piavatar_envs.sim.garments import WornCloth, is_graded
from piavatar_envs.sim.scene import Subjects, join
from piavatar_envs.sim.shapes import Shapes


def shell_matter(config: EnvConfig, garments: Sequence[Garment], dx: float) -> ShellMatter | None:
    """Return the particles of all garments; None unless they are simulated in MPM.

    Args:
        config: the solver, and what is drawn for every episode.
        garments: of all avatars.
        dx: grid spacing [m].

    Raises:
        ConfigError: settings that the solver does not support, or edges that are too long for the grid.
    """
    if not garments or config.cloth.solver != "mpm":
        return None
    remedy = ", or use cloth.solver='xpbd'"
    if config.physics.decoupling != "split":
        raise ConfigError(
            f"physics.decoupling={config.physics.decoupling!r}: cloth in MPM needs 'split'; set it{remedy}"
        )
    for name in ("cloth_mass_factor", "cloth_friction_factor"):
        if getattr(config.randomize, name) != UNCHANGED:
            raise ConfigError(f"randomize.{name}: cloth in MPM has the same in all episodes; leave it out{remedy}")
    try:
        check_edges(garments, dx)
    except ValueError as error:
        raise ConfigError(f"garments: {error}") from None
    matter = ShellMatter.of(garments, config.randomize.cloth_stiffness_factor[1])
    _check_substeps(config, garments[matter.garment[matter.wave.argmax()]], matter.wave.max(), dx)
    return matter


def _check_substeps(config: EnvConfig, garment: Garment, wave: float, dx: float) -> None:
    """Refuse a configured number of substeps in which a ``wave`` [m/s] of a garment goes too far.

    Raises:
        ConfigError: it does.
    """
    given = config.physics.num_substeps
    fewest = choose_num_substeps(config.physics.control_dt, dx, wave, CFL_STABLE)
    if given is not None and given < fewest:
        raise ConfigError(
            f"physics.num_substeps={given}: waves in the {garment.kind} (stretch {garment.fabric.stretch:g} N/m, "
            f"{garment.fabric.areal_density:g} kg/m^2) are as fast as {wave:.1f} m/s, and cloth in MPM needs at least "
            f"{fewest}; set it, or give the garment less `stretch`, or use cloth.solver='xpbd'"
        )


def with_shells(subjects: Subjects, garments: Sequence[Garment], matter: ShellMatter, dx: float) -> Subjects:
    """Return the matter of a world with the garments' particles after all others, in fields of their wearers' subjects.

    Fields of a subject are next to each other, so that later fields get other indices. ``dx`` is the grid spacing [m].
    """
    fields, count = subjects.fields, subjects.fields.num_fields
    wearer = [garment.wearer for garment in garments]
    owner = np.array([*fields.subject, *wearer])
    order = np.argsort(owner, kind="stable")  # garments after the wearer's own fields
    index = np.argsort(order)
    grip = [garment.fabric.friction for garment in garments]
    friction = np.empty((len(owner), len(owner)))
    friction[:count, :count] = fields.friction
    friction[count:] = np.array(grip)[:, None]
    friction[:, count:] = grip
    density = np.broadcast_to(np.asarray(fields.density, float), (count,))
    density = np.concatenate([density, matter.density(dx)])
    joined = join([subjects.matter, matter.points(dx)], len(subjects.matter.volume))
    own = len(matter.mass)
    seam, sensor = subjects.matter.seam, subjects.matter.sensor
    return replace(
        subjects,
        matter=replace(
            joined,
            field=index[np.concatenate([subjects.matter.fields, count + matter.garment])],
            seam=np.concatenate([seam, np.zeros(own, seam.dtype)]),
            sensor=np.concatenate([sensor, np.full(own, -1, sensor.dtype)]),
        ),
        fields=replace(
            fields,
            subject=tuple(owner[order].tolist()),
            friction=friction[np.ix_(order, order)],
            density=density[order],
            apart=tuple(index[count:].tolist()),
        ),
        colliders=tuple(_with_garments(collider, grip, order) for collider in subjects.colliders),
    )


def _with_garments(collider: Collider, grip: Sequence[float], order: np.ndarray) -> Collider:
    """Return a collider with the friction of garments, unless it has the same for all fields."""
    if np.ndim(collider.friction) == 0:
        return collider
    return replace(collider, friction=tuple(np.array([*collider.friction, *grip])[order]))


def bytes_of_shells(meshes: Sequence[ClothMesh]) -> int:
    """Estimate the memory of garments of an environment, without that of their particles [bytes]."""
    vertices, triangles = (sum(map(count, meshes)) for count in (lambda m: m.num_vertices, lambda m: len(m.faces)))
    return vertices * (2 * 12 + 2 * 4) + triangles * 4 * 12


class ShellGarments(WornCloth):
    """All garments of a world by :class:`~piavatar_envs.cloth.shell.Shell`, which moves with the bodies."""

    cloth: Shell

    def __init__(
        self,
        garments: Sequence[Garment],
        matter: ShellMatter,
        config: ClothConfig,
        flesh: Sequence[Flesh],
        avatars: Sequence[Avatar],
        shapes: Shapes,
        model: Model,
        state: State,
        scratch: Scratch,
        first: int,
    ) -> None:
        """Allocate the cloth.

        Args:
            garments: of :func:`~piavatar_envs.sim.garments.tailor`, at least one.
            matter: of these garments.
            config: settings of the solver.
            flesh: of the world, as all that follows.
            avatars: likewise.
            shapes: likewise.
            model: likewise.
            state: likewise.
            scratch: likewise.
            first: first particle of the cloth.
        """
        cloth = Shell(
            garments,
            matter,
            holds_of(garments, flesh, avatars, model.num_particles),
            model,
            state,
            scratch,
            first,
            ClothSettings(wind=config.wind),
            model.num_envs if is_graded(garments, flesh) else 1,
        )
        super().__init__(garments, cloth, flesh, avatars, shapes, model, state)

    def record_before_substep(self, graph: LaunchGraph) -> None:
        """Append the forces of the cloth on particles."""
        self.cloth.record_before_substep(graph)

    def record_end(self, graph: LaunchGraph) -> None:
        """Append: read positions and velocities of the cloth."""
        self.cloth.record_places(graph)

    def record_reset(self, graph: LaunchGraph, mask: wp.array) -> None:
        """Append the placement of garments in the masked environments; see :meth:`WornCloth.record_reset`."""
        super().record_reset(graph, mask)
        self.cloth.record_reset(graph, mask)


def holds_of(
    garments: Sequence[Garment], flesh: Sequence[Flesh], avatars: Sequence[Avatar], num_particles: int
) -> Holds:
    """Return the places of held vertices among the particles of their wearers, at rest in their configured shapes."""
    weights = []
    for garment in garments:
        own, avatar = flesh[garment.wearer], avatars[garment.wearer]
        points, _ = own.shaped(own.base_parameters)
        found = hold_weights(garment.draped[garment.held.vertices], points.rest[0].astype(np.float64))
        row, column = np.nonzero(found)
        shape = (len(found), num_particles)
        weights.append(sparse.csr_array((found[row, column], (row, column + avatar.body.first)), shape=shape))
    together = sparse.csr_array(sparse.vstack(weights))
    return Holds(np.zeros((together.shape[0], 3)), together)
