"""Matrices of particles, an array a component: ``(num_envs, 9, num_particles)``, row by row.

Of matrices that lie one after the other, 36 bytes each, the threads of a warp read nine words, and touch nine lines of
the cache with each of them. Component by component, neighbouring threads read and write neighbouring words. Each
component begins where a line does, or what a warp writes would begin and end amid the sectors that memory takes.

Data structures of the material point method (MPM).

``Model`` is constant, ``State`` is all that a checkpoint holds, ``Control`` is what a controller writes before a
substep and ``Scratch`` is rebuilt every substep. Arrays are batched: the leading dimension is the environment.
Per-particle constants have a leading dimension of 1 (shared) or ``num_envs`` (randomised); :func:`row` picks the one.

Symbols in kernels: ``e`` environment, ``p`` particle, ``i j k`` grid node, ``x`` position [m], ``u`` physical
velocity [m/s], ``C`` its affine matrix [1/s], ``F`` deformation gradient, ``J`` its determinant, ``tau`` Kirchhoff
stress [Pa], ``vk`` kinematic (prescribed) velocity [m/s], ``dx`` grid spacing [m], ``dt`` time step [s].
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import warp as wp

from piavatar_envs.core.arrays import make_struct, matrices_of, vec4l

wp.set_module_options({"enable_backward": False})


# Why an environment failed: bits of ``State.failure``.
FAILURE_NONFINITE = 1
FAILURE_OUT_OF_GRID = 2
FAILURE_CFL = 4  # too fast for the time step
FAILURE_ACTION = 8
FAILURE_BLOCKS = 16
FAILURE_NAMES: dict[int, str] = {
    FAILURE_NONFINITE: "nonfinite",
    FAILURE_OUT_OF_GRID: "out_of_grid",
    FAILURE_CFL: "cfl",
    FAILURE_ACTION: "action",
    FAILURE_BLOCKS: "blocks",
}

#: How the prescribed motion and the deformation gradient are kept apart (docs of :mod:`piavatar_envs.mpm.g2p`).
DECOUPLING: dict[str, int] = {"split": 0, "paper": 1, "none": 2, "no_stress": 3}
#: How particles reach the nodes (docs of :mod:`piavatar_envs.mpm.p2g`, ``tiles`` and ``shared_substep``).
PATHS = ("plain", "tiled", "block")
#: What is around a particle: perhaps a boundary or another field, so that it tells its nodes where it is; the latter.
CANDIDATE, NEAR_FIELD = wp.constant(1), wp.constant(2)
SPLIT = wp.constant(0)
PAPER = wp.constant(1)
NO_STRESS = wp.constant(3)


def failure_name(bits: int) -> str | None:
    """Human-readable cause of a failure: ``None`` if there is none, names joined by ``+`` if there are several."""
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
    material: wp.array2d(dtype=int)  # index into piavatar_envs.mpm.materials.MATERIALS
    field: wp.array(dtype=int)  # (num_particles,) velocity field
    seam: wp.array(dtype=float)  # (num_particles,) 1 where two fields of a subject grow together, else 0
    sensor: wp.array(dtype=int)  # (num_particles,) row of the contact sensor, -1 for none
    tiles: wp.array(dtype=wp.vec2i)  # (G + 1,) :func:`piavatar_envs.mpm.cuda.tiled_p2g.plan_tiles`


@wp.struct
class Contact:
    """Velocity fields and how they touch; see :mod:`piavatar_envs.mpm.contact`. ``S`` subjects own ``F`` fields."""

    num_fields: int
    num_subjects: int
    own_normals: int  # 1: the paper's rule, each field with its own normal
    gate: float  # largest gap between the surfaces of two fields that is contact [m]
    subject: wp.array(dtype=int)  # (F,) subject of a field
    trunk: wp.array(dtype=int)  # (F,) first field of the same subject, with which seams grow together
    friction: wp.array2d(dtype=float)  # (rows, F * F) Coulomb coefficient of a pair
    density: wp.array2d(dtype=float)  # (rows, F) reference density, mass to volume fraction [kg/m^3]


@wp.struct
class Sensors:
    """What contact did in this control step, and at the nodes in this substep."""

    accumulators: wp.array2d(dtype=wp.int64)  # (num_envs, 3 * entries) see :mod:`piavatar_envs.mpm.contact_sensors`
    boundary_impulse: wp.array2d(dtype=wp.vec3)  # (num_envs, S) impulse of the colliders on a subject [N s]
    boundary_moment: wp.array2d(dtype=wp.vec3)  # (num_envs, S) moment of that about the world's origin [N m s]
    pair_impulse: wp.array2d(dtype=wp.vec3)  # (num_envs, S * S) on a by b, only a < b [N s]
    part_impulse: wp.array3d(dtype=wp.vec3)  # (num_envs, sensors, S) on the particles of a sensor, by subject [N s]
    # (num_envs, records) change of velocity by other subjects and the one that did most of it; of shared blocks
    node: wp.array2d(dtype=wp.vec4)
    touched: wp.array2d(dtype=int)  # (num_envs, slots) not 0: ``node`` has changes in this slot, in this substep
    penetration: wp.array2d(dtype=float)  # (num_envs, S) deepest particle of a subject inside another [m]


@wp.struct
class Boundaries:
    """Analytic solids that the bodies stay out of, resting or moving as told, with Coulomb friction.

    ``B`` colliders; ``(rows, ...)`` arrays have 1 or ``num_envs`` rows. The kinds and what ``size`` means for each are
    in :mod:`piavatar_envs.mpm.colliders`. An empty array still holds one entry; ``count`` says how many count.
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
    """Where matter is: blocks of 4 x 4 x 4 nodes that hold some have a slot for their nodes' records.

    ``F`` fields, ``B`` blocks of the grid, ``S`` slots. The 64 records of slot ``s`` begin at ``64 s``.
    """

    fields: wp.array2d(dtype=int)  # (num_envs, B) bit f for matter of field f
    active: wp.array2d(dtype=int)  # (num_envs, F * B) slot of a field's block; means something where its bit is set
    owner: wp.array2d(dtype=int)  # (num_envs, S) field * B + block of a slot
    num_active: wp.array(dtype=int)  # (num_envs,) slots in use
    contact_blocks: wp.array2d(dtype=int)  # (num_envs, S // 2) blocks that have got a second field, as they got it
    num_contact_blocks: wp.array(dtype=int)  # (num_envs,) how many, also such as found no slot for it
    num_updated: wp.array(dtype=int)  # (num_envs,) slots whose records the last grid pass has written
    frozen: wp.array(dtype=int)  # (num_envs,) not 0: had failed when this was last looked at, see :func:`freeze`
    # (num_envs, S) not 0: a stencil that begins in this slot's block may lie in one of another field; of large bodies
    near_field: wp.array2d(dtype=int)
    contact_nodes: wp.array2d(
        dtype=int
    )  # (num_envs, 2 S) bits of nodes, see :mod:`piavatar_envs.mpm.sparse_grid`; of those, too
    # (num_envs, num_particles) TELLS and BESIDE, as the scatter has found them in this substep; of a CPU
    candidate: wp.array2d(dtype=wp.uint8)


@wp.struct
class Accumulators:
    """What particles add up on nodes, zero between substeps; see :mod:`piavatar_envs.mpm.grid_arrays`.

    ``(num_envs, 64 S)``; ``value`` and ``fixed``, of halves of records, ``(num_envs, 128 S)``.

    Either the floating-point or the integer arrays are in use, the others have one entry. Units: ``(rows, F)``.
    """

    is_fixed: int
    value: wp.array2d(dtype=wp.vec4)  # halves of records: mass, physical momentum; kinematic momentum, nothing
    fixed: wp.array2d(dtype=vec4l)  # the same in units
    offset: wp.array2d(dtype=wp.vec4)  # sum of w m (x_i - x_p), of w m of seam particles; near others and boundaries
    offset_fixed: wp.array2d(dtype=vec4l)
    mass_quantum: wp.array2d(dtype=float)  # [kg]
    momentum_quantum: wp.array2d(dtype=float)  # [kg m/s]
    candidates: wp.array2d(dtype=int)  # (num_envs, S) not 0: nodes of this slot were told where particles are and go


@wp.struct
class Arena:
    """What lies where in the shared memory of a CUDA block, in words; see :mod:`piavatar_envs.mpm.cuda.block_grid`."""

    numbers: int  # of the subblocks, two a word
    candidates: int  # bits of particles that tell their place
    near: int  # bytes of slots: what is near, see :mod:`piavatar_envs.mpm.cuda.block_grid`
    places: int  # of the subblocks: 8 slot + subblock in block, and bits of planes near boundaries, two a word
    subblocks: int
    kinematic: int  # of kinematic momenta, three a node
    capacity: int  # subblocks that the room has; one more takes what is not of this round
    partition: wp.array(
        dtype=wp.vec3i
    )  # (parts,) first particle, one after the last, bits of the fields that are theirs
    speed: wp.array2d(dtype=float)  # (num_envs, fields) at which momenta are counted [m/s], 0 for not known


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
class Kinematic:
    """Prescribed motion of particles, each of shape ``(num_envs, num_particles)``; see :class:`State`."""

    vk: wp.array2d(dtype=wp.vec3)
    spin: wp.array2d(dtype=wp.vec3)


@wp.func
def row(e: int, rows: int):
    """Row of a constant for environment ``e``: 0 if it is shared by all environments."""
    return wp.min(e, rows - 1)


@dataclass(frozen=True)
class Model:
    """Everything that does not change: grid, step, particle constants and boundaries.

    ``sound_speed`` is the fastest elastic wave of any particle [m/s]; ``moving_boundaries`` says whether any boundary
    may have a velocity; ``num_sensors`` counts the rows of the contact sensor; ``max_active_blocks`` the blocks with matter an
    environment can hold, by fields, marked anew after ``activation_interval`` substeps; ``scatter`` is one of :data:`PATHS`.
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
    control_dt: float
    sound_speed: float
    moving_boundaries: bool
    num_sensors: int
    max_active_blocks: int
    activation_interval: int
    path: str

    @property
    def num_blocks(self) -> int:
        """Grid blocks of one environment."""
        return int(self.grid.num_blocks)


@dataclass
class State:
    """What evolves: a checkpoint holds exactly this. Shapes ``(num_envs, num_particles)`` and ``(num_envs,)``.

    Matrices are arrays of their components, ``(num_envs, 9, num_particles)``; see :mod:`piavatar_envs.mpm.types`.
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
        """The prescribed motion."""
        return make_struct(Kinematic, vk=self.vk, spin=self.spin)

    def numpy(self) -> dict[str, np.ndarray]:
        """A copy of every array on the host, matrices as such: ``(num_envs, num_particles, 3, 3)``."""
        arrays = {field.name: getattr(self, field.name).numpy().copy() for field in fields(self)}
        return arrays | {name: matrices_of(arrays[name]) for name in ("C", "F")}


@dataclass
class Scratch:
    """Grid arrays, rebuilt every substep, and contact sensors.

    A node's records are where its field's block has its slot, see :class:`Blocks`; ``(num_envs, 64 S)``, halves of them
    ``(num_envs, 128 S)``.

    Attributes:
        blocks: which blocks hold matter in this control step, and their slots.
        sums: what particles have added up.
        velocity: vec4: halves of records, see :mod:`piavatar_envs.mpm.grid_arrays`: mass and physical velocity,
        kinematic
            velocity and nothing; the latter means nothing where no contact is at hand, but in the paper's variant.
        facing: vec4: what nodes of blocks with several fields say of normals, see
        :mod:`piavatar_envs.mpm.contact_normals`. sensors: what contact did in this control step.
        room: of bodies whose grid is in shared memory, see :mod:`piavatar_envs.mpm.cuda.block_grid`; a large one or
        not.
    """

    blocks: Blocks
    accumulators: Accumulators
    velocity: wp.array
    volume_gradient: wp.array
    sensors: Sensors
    arena: Arena
    large_arena: bool
