"""Data structures of the material point method (MPM).

:class:`Model` is constant, :class:`State` is all that a checkpoint holds, :class:`Scratch` is rebuilt every substep.
Arrays are batched: the leading dimension is the environment. Per-particle constants have a leading dimension of 1
(the same for all environments) or ``num_envs`` (randomised); :func:`row` selects the row.

Symbols in kernels: ``e`` environment, ``p`` particle, ``i j k`` grid node, ``x`` position [m], ``u`` physical
velocity [m/s], ``C`` its affine matrix [1/s], ``F`` deformation gradient, ``J`` its determinant, ``tau`` Kirchhoff
stress [Pa], ``vk`` kinematic (prescribed) velocity [m/s], ``dx`` grid spacing [m], ``dt`` time step [s].
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import warp as wp

from piavatar_envs.core.arrays import matrices_of, vec4l
from piavatar_envs.core.structs import make_struct

wp.set_module_options({"enable_backward": False})


# Causes of a failed environment: bits of ``State.failure``.
FAILURE_NONFINITE = 1
FAILURE_OUT_OF_GRID = 2
FAILURE_CFL = 4  # too fast for the time step
FAILURE_ACTION = 8
FAILURE_BLOCKS = 16
FAILURE_FORCE = 32  # an external force that is not finite, or one too many
FAILURE_CLOTH = 64  # a garment's position or velocity that is not finite
FAILURE_NAMES: dict[int, str] = {
    FAILURE_NONFINITE: "nonfinite",
    FAILURE_OUT_OF_GRID: "out_of_grid",
    FAILURE_CFL: "cfl",
    FAILURE_ACTION: "action",
    FAILURE_BLOCKS: "blocks",
    FAILURE_FORCE: "force",
    FAILURE_CLOTH: "cloth",
}

#: Largest stable ``c dt / dx`` (measured 0.84 to 1.04, less near incompressibility).
CFL_STABLE = 0.84

#: How prescribed motion is kept out of the deformation gradient (:mod:`piavatar_envs.mpm.g2p`).
DECOUPLING: dict[str, int] = {"split": 0, "paper": 1, "none": 2, "no_stress": 3}
#: How particles reach the nodes: :mod:`piavatar_envs.mpm.p2g`, ``cuda.tiled_p2g``, ``cuda.block_substep``.
PATHS = ("plain", "tiled", "block")
#: Bits of ``Blocks.candidate``: the particle is a contact candidate; another field is active near it.
CANDIDATE, NEAR_FIELD = wp.constant(1), wp.constant(2)
SPLIT = wp.constant(0)
PAPER = wp.constant(1)
NO_STRESS = wp.constant(3)


def failure_name(bits: int) -> str | None:
    """Return the causes of a failure joined by ``+``, ``None`` if there is none.

    Args:
        bits: the code ``info["failure"]``, a sum of the keys of :data:`FAILURE_NAMES`; 0 for none.
    """
    names = [name for bit, name in FAILURE_NAMES.items() if bits & bit]
    return "+".join(names) or None


@wp.struct
class Grid:
    """Constants of the background grid; node ``(i, j, k)`` lies at ``origin + dx * (i, j, k)``."""

    origin: wp.vec3
    dx: float
    inv_dx: float
    nodes: wp.vec3i  # nodes along x, y, z
    blocks: wp.vec3i  # blocks of 4 x 4 x 4 nodes along x, y, z
    num_blocks: int


@wp.struct
class Step:
    """Constants of the time step."""

    dt: float
    gravity: wp.vec3
    decoupling: int


@wp.struct
class Particles:
    """Per-particle constants, each of shape ``(1 or num_envs, num_particles)``."""

    mass: wp.array2d(dtype=float)  # [kg]
    volume: wp.array2d(dtype=float)  # rest volume [m^3]
    mu: wp.array2d(dtype=float)  # shear modulus [Pa]
    lam: wp.array2d(dtype=float)  # first Lame parameter [Pa]
    retardation: wp.array2d(dtype=float)  # viscosity over modulus, of shear and of volume alike [s]
    material: wp.array2d(dtype=int)  # index into piavatar_envs.mpm.materials.MATERIALS
    field: wp.array(dtype=int)  # (num_particles,) velocity field
    seam: wp.array(dtype=float)  # (num_particles,) 1 where two fields of a subject merge, else 0
    sensor: wp.array(dtype=int)  # (num_particles,) row of the contact sensor, -1 for none
    share: wp.array(dtype=float)  # (num_particles,) share of the mass of all, as built
    tiles: wp.array(dtype=wp.vec2i)  # (G + 1,) :func:`piavatar_envs.mpm.cuda.tiled_p2g.plan_tiles`


@wp.struct
class Contact:
    """Contact parameters of ``F`` velocity fields, owned by ``S`` subjects; see :mod:`piavatar_envs.mpm.contact`."""

    num_fields: int
    num_subjects: int
    own_normals: int  # 1: the paper's rule, each field with its own normal
    gate: float  # largest gap between the surfaces of two fields that is contact [m]
    subject: wp.array(dtype=int)  # (F,) subject of a field
    trunk: wp.array(dtype=int)  # (F,) first field of the same subject, with which its other fields merge at seams
    friction: wp.array2d(dtype=float)  # (rows, F * F) Coulomb coefficient of a pair
    density: wp.array2d(dtype=float)  # (rows, F) reference density, mass to volume fraction [kg/m^3]


@wp.struct
class Sensors:
    """Contact over the control step, and at the nodes in this substep; live arrays."""

    accumulators: wp.array2d(dtype=wp.int64)  # (num_envs, 3 * entries) see :mod:`piavatar_envs.mpm.contact_sensors`
    boundary_impulse: wp.array2d(dtype=wp.vec3)  # (num_envs, S) impulse of the colliders on a subject [N s]
    boundary_moment: wp.array2d(dtype=wp.vec3)  # (num_envs, S) moment of that about the world's origin [N m s]
    pair_impulse: wp.array2d(dtype=wp.vec3)  # (num_envs, S * S) on a by b, only a < b [N s]
    part_impulse: wp.array3d(dtype=wp.vec3)  # (num_envs, sensors, S) on the particles of a sensor, by subject [N s]
    # (num_envs, records) change of velocity by other subjects, and the subject that did most of it; contact blocks only
    node: wp.array2d(dtype=wp.vec4)
    touched: wp.array2d(dtype=int)  # (num_envs, A) not 0: ``node`` has changes in this active block in this substep
    penetration: wp.array2d(dtype=float)  # (num_envs, S) deepest particle of a subject inside another [m]
    limited_sum: wp.array2d(dtype=wp.int64)  # (num_envs, 2) see :func:`piavatar_envs.mpm.contact_sensors.add_limited`
    limited: wp.array(dtype=float)  # (num_envs,) see :func:`piavatar_envs.mpm.contact_sensors.check_limited`


@wp.struct
class Boundaries:
    """Analytic colliders, fixed or moving, with Coulomb friction.

    ``B`` colliders; ``(rows, ...)`` arrays have 1 or ``num_envs`` rows. Kinds and the meaning of ``size`` are in
    :mod:`piavatar_envs.mpm.colliders`. Arrays have at least one entry; ``count`` is the number of colliders.
    """

    count: int
    kind: wp.array(dtype=int)  # (B,)
    size: wp.array(dtype=wp.vec3)  # (B,) [m]
    position: wp.array2d(dtype=wp.vec3)  # (rows, B) [m]
    rotation: wp.array2d(dtype=wp.quat)  # (rows, B) local to world
    velocity: wp.array2d(dtype=wp.vec3)  # (rows, B) of the solid's origin [m/s]
    spin: wp.array2d(dtype=wp.vec3)  # (rows, B) angular velocity [rad/s]
    friction: wp.array2d(dtype=float)  # (rows, fields * B), that of field f on collider b at f * B + b


@wp.struct
class Blocks:
    """Sparse grid: active blocks of 4 x 4 x 4 nodes, one for each velocity field near a block of the grid.

    ``F`` fields, ``B`` blocks of the grid, ``A`` active blocks. The 64 node records of active block ``a`` begin at
    ``64 a``. A contact block is a block of the grid that is active for several fields.
    """

    fields: wp.array2d(dtype=int)  # (num_envs, B) bit f: active for field f
    active: wp.array2d(dtype=int)  # (num_envs, F * B) active block of a field's block; valid where its bit is set
    owner: wp.array2d(dtype=int)  # (num_envs, A) field * B + block of an active block
    num_active: wp.array(dtype=int)  # (num_envs,) active blocks needed, possibly more than A
    contact_blocks: wp.array2d(dtype=int)  # (num_envs, A // 2) in the order of activation
    num_contact_blocks: wp.array(dtype=int)  # (num_envs,) contact blocks needed
    num_updated: wp.array(dtype=int)  # (num_envs,) active blocks whose records the last grid update has written
    frozen: wp.array(dtype=int)  # (num_envs,) not 0: failed when last checked, see :func:`freeze`
    # (num_envs, A) not 0: a stencil that begins in this active block may overlap another field; tiled path only
    near_field: wp.array2d(dtype=int)
    # (num_envs, 2 A) bits of nodes, see :mod:`piavatar_envs.mpm.sparse_grid`; tiled path only
    contact_nodes: wp.array2d(dtype=int)
    # (num_envs, num_particles) bits CANDIDATE and NEAR_FIELD, written by P2G; CPU only
    candidate: wp.array2d(dtype=wp.uint8)


@wp.struct
class Accumulators:
    """Sums of P2G at the nodes, zero between substeps; see :mod:`piavatar_envs.mpm.grid_arrays`.

    Shapes are ``(num_envs, 64 A)``, and ``(num_envs, 128 A)`` for ``value`` and ``fixed``, which hold halves of
    records. Either the floating-point or the fixed-point arrays are in use, the others have one entry. Quanta: ``(rows,
    F)``.
    """

    is_fixed: int
    value: wp.array2d(dtype=wp.vec4)  # halves of records: mass, physical momentum; kinematic momentum, nothing
    fixed: wp.array2d(dtype=vec4l)  # the same in quanta
    offset: wp.array2d(dtype=wp.vec4)  # sums of w m (x_i - x_p) and of w m over seam particles, of contact candidates
    offset_fixed: wp.array2d(dtype=vec4l)
    mass_quantum: wp.array2d(dtype=float)  # [kg]
    momentum_quantum: wp.array2d(dtype=float)  # [kg m/s]
    candidates: wp.array2d(dtype=int)  # (num_envs, A) not 0: contact candidates have added to this active block


@wp.struct
class Arena:
    """Layout of the shared memory of a CUDA block, in words; see :mod:`piavatar_envs.mpm.cuda.block_grid`."""

    numbers: int  # numbers of the subblocks, two a word
    candidates: int  # bits of the particles that are contact candidates
    near: int  # a byte an active block: bits of its slabs near colliders, and MAY_CONTACT
    places: int  # 8 active block + subblock in block, and bits of planes near colliders, two a word
    subblocks: int  # first halves of the node records
    kinematic: int  # kinematic momenta, three words a node
    capacity: int  # subblocks of a round; one more takes what belongs to other rounds
    # (partitions,) first particle, one after the last, bits of the fields
    partition: wp.array(dtype=wp.vec3i)
    speed: wp.array2d(dtype=float)  # (num_envs, fields) momentum quantum over mass quantum [m/s], 0 if not known


@wp.struct
class Moving:
    """Particle state as the transfers take it, vectors ``(num_envs, num_particles)``; see :class:`State`."""

    x: wp.array2d(dtype=wp.vec3)
    u: wp.array2d(dtype=wp.vec3)
    C: wp.array3d(dtype=float)
    F: wp.array3d(dtype=float)
    vk: wp.array2d(dtype=wp.vec3)
    spin: wp.array2d(dtype=wp.vec3)


@wp.struct
class Retained:
    """Velocities that particles retain in a substep; see :mod:`piavatar_envs.mpm.retention`."""

    share: wp.array(dtype=float)  # (num_particles,) of what is filtered from them
    u: wp.array2d(dtype=wp.vec3)  # (num_envs, num_particles) [m/s]
    C: wp.array3d(dtype=float)  # (num_envs, 9, num_particles) [1/s]


@wp.struct
class Kinematic:
    """Prescribed motion of particles, each of shape ``(num_envs, num_particles)``; see :class:`State`."""

    vk: wp.array2d(dtype=wp.vec3)
    spin: wp.array2d(dtype=wp.vec3)


@wp.func
def row(e: int, rows: int):
    """Return the row of a constant for environment ``e``: 0 if all environments share it."""
    return wp.min(e, rows - 1)


@dataclass(frozen=True)
class Model:
    """Constants of a simulation: grid, time step, particles, colliders and contact.

    Attributes:
        num_envs: environments.
        num_particles: particles of an environment.
        device: Warp device.
        grid: background grid.
        step: time step.
        particles: per-particle constants.
        boundaries: colliders.
        contact: velocity fields.
        num_substeps: substeps of a control step.
        reference_substeps: substeps whose damping of short waves further ones keep; None where each damps them.
        control_dt: control step [s].
        sound_speed: fastest elastic wave of any particle [m/s].
        moving_boundaries: whether a collider may have a velocity.
        num_sensors: rows of the contact sensor.
        max_active_blocks: most active blocks of an environment, over all fields.
        activation_interval: substeps between activations of blocks.
        path: path of P2G and G2P, one of :data:`PATHS`.
        thin_colliders: indices of the colliders of :mod:`piavatar_envs.mpm.thin_colliders`; None without any.
        retained_share: of each particle, shape ``(num_particles,)``, see :mod:`piavatar_envs.mpm.retention`; None where
            nothing is retained.
    """

    num_envs: int
    num_particles: int
    device: str
    grid: Grid
    step: Step
    particles: Particles
    boundaries: Boundaries
    contact: Contact
    num_substeps: int
    reference_substeps: int | None
    control_dt: float
    sound_speed: float
    moving_boundaries: bool
    num_sensors: int
    max_active_blocks: int
    activation_interval: int
    path: str
    thin_colliders: wp.array | None = None
    retained_share: wp.array | None = None

    @property
    def num_blocks(self) -> int:
        """Grid blocks of one environment."""
        return int(self.grid.num_blocks)


@dataclass
class State:
    """Evolving state, in live arrays: a checkpoint holds exactly this.

    Shapes are ``(num_envs, num_particles)`` and ``(num_envs,)``. Matrices are stored by component,
    ``(num_envs, 9, num_particles)``; see :mod:`piavatar_envs.core.arrays`.
    """

    x: wp.array  # position [m]
    u: wp.array  # physical velocity [m/s]
    C: wp.array  # its affine part, APIC's [1/s]
    F: wp.array  # deformation gradient
    vk: wp.array  # kinematic velocity of the last substep: part of the total velocity u + vk
    spin: wp.array  # kinematic spin in the last substep, by which the deformation turns [rad/s]
    failure: wp.array  # bits FAILURE_*; a failed environment is frozen until it is reset

    @property
    def kinematic(self) -> Kinematic:
        """The prescribed motion as a kernel argument."""
        return make_struct(Kinematic, vk=self.vk, spin=self.spin)

    def numpy(self) -> dict[str, np.ndarray]:
        """Copy every array to the host, matrices as ``(num_envs, num_particles, 3, 3)``."""
        arrays = {field.name: getattr(self, field.name).numpy().copy() for field in fields(self)}
        return arrays | {name: matrices_of(arrays[name]) for name in ("C", "F")}


@dataclass
class Scratch:
    """Grid arrays, rebuilt every substep, and contact sensors.

    Node records are addressed by active block, see :class:`Blocks`: ``(num_envs, 64 A)``, halves ``(num_envs, 128 A)``.

    Attributes:
        blocks: active blocks.
        accumulators: sums of P2G.
        velocity: vec4, halves of records (:mod:`piavatar_envs.mpm.grid_arrays`): mass and physical velocity; kinematic
            velocity, which is valid only near contact, or with the ``"paper"`` decoupling.
        volume_gradient: vec4, in contact blocks; see :mod:`piavatar_envs.mpm.contact_normals`.
        sensors: contact sensors.
        arena: shared memory of the block-per-environment path.
        large_arena: whether an arena takes a multiprocessor of its own.
        positions: of the particles before G2P [m]; None unless colliders are thin.
        retained: what particles retain in a substep; None where nothing is retained.
        unforced: the model without stress, gravity and colliders, for P2G of what is retained; None likewise.
    """

    blocks: Blocks
    accumulators: Accumulators
    velocity: wp.array
    volume_gradient: wp.array
    sensors: Sensors
    arena: Arena
    large_arena: bool
    positions: wp.array | None
    retained: Retained | None
    unforced: Model | None
