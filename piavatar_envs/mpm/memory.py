"""Memory of a simulation: number of active blocks, estimates, and allocation."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import warp as wp

from piavatar_envs.core.arrays import allocate_matrices, components_of, vec4l, whole_lines
from piavatar_envs.core.structs import make_struct
from piavatar_envs.mpm.bspline import BLOCK, BLOCK_NODES
from piavatar_envs.mpm.colliders import make_boundaries
from piavatar_envs.mpm.contact_sensors import senses_in_g2p
from piavatar_envs.mpm.cuda.block_grid import MOST_PARTICLES, plan_arena
from piavatar_envs.mpm.grid_arrays import choose_quanta
from piavatar_envs.mpm.sparse_grid import UNASSIGNED, max_contact_blocks, tracks_contact_nodes
from piavatar_envs.mpm.types import (
    DECOUPLING,
    Accumulators,
    Blocks,
    Grid,
    Model,
    Retained,
    Scratch,
    Sensors,
    State,
    Step,
)

#: Active blocks that a body may need, over those at rest. Random full-scale actions and shapes reached 1.2.
ACTIVE_MARGIN = 1.7
#: The same for a body with more particles than suit the block path.
LARGE_MARGIN = 2.2
#: Substeps between activations, which release the blocks that a fast body has left. In eight substeps nothing moves
#: further than two blocks.
ACTIVATION_INTERVAL = 8
#: The same on the tiled path, where activations take longer; and with a large body, whose margin holds what it leaves
#: behind at a grid spacing a substep.
TILED_INTERVAL, LARGE_INTERVAL = 16, 25
#: Warp's strides are 32-bit: the records of an environment, of up to 64 bytes, must take less than 2^31 bytes.
MAX_ACTIVE_BLOCKS = 2**31 // (64 * BLOCK**3)


def bound_active_blocks(max_active_blocks: int | None, field: np.ndarray, grid: Grid, num_fields: int) -> int:
    """Return the active blocks of an environment: as requested, at most what its particles can touch at once.

    Raises:
        ValueError: there is none, or their records exceed Warp's 32-bit strides.
    """
    count = np.bincount(field, minlength=num_fields)
    most = int(np.minimum(8 * count, grid.num_blocks).sum())
    active_blocks = most if max_active_blocks is None else min(max_active_blocks, most)
    if not 1 <= active_blocks < MAX_ACTIVE_BLOCKS:
        raise ValueError(
            f"{active_blocks} active blocks per environment: use at least 1 and less than {MAX_ACTIVE_BLOCKS}, by a "
            f"coarser dx or max_active_blocks"
        )
    return active_blocks


def estimate_active_blocks(rest: np.ndarray, field: np.ndarray | None, dx: float, margin: float | None = None) -> int:
    """Return how many active blocks bodies will need, from their particles at rest.

    Args:
        rest: positions of the particles [m], shape ``(num_particles, 3)``; relative positions of bodies are irrelevant.
        field: their velocity fields, shape ``(num_particles,)``; the first for all if not given.
        dx: grid spacing [m].
        margin: factor for other poses and shapes, and for motion between activations; ``ACTIVE_MARGIN`` or
            ``LARGE_MARGIN`` if not given.
    """
    field = np.zeros(len(rest), int) if field is None else field
    corners = np.array(np.meshgrid([0, 2], [0, 2], [0, 2])).reshape(3, -1).T
    needed = 0
    for index in np.unique(field):
        own = rest[field == index]
        times = margin
        if times is None:
            times = LARGE_MARGIN if len(own) > MOST_PARTICLES else ACTIVE_MARGIN
        base = np.floor(own / dx - 0.5).astype(int)
        base -= BLOCK * (base.min(axis=0) // BLOCK)
        of_base = np.bincount(np.ravel_multi_index(base.T, base.max(axis=0) + 1))
        base = np.stack(np.unravel_index(np.flatnonzero(of_base), base.max(axis=0) + 1), axis=1)  # each of them once
        counts = []
        for shift in np.ndindex(2, 2, 2):  # any alignment of the grid with the body
            touched = (base[:, None] + 2 * np.array(shift) + corners).reshape(-1, 3).T // BLOCK
            counts.append(np.count_nonzero(np.bincount(np.ravel_multi_index(touched, touched.max(axis=1) + 1))))
        needed += math.ceil(times * max(counts)) + 8
    return needed


def choose_activation_interval(path: str, field: np.ndarray) -> int:
    """Return the number of substeps between activations of blocks."""
    if path != "tiled":
        return ACTIVATION_INTERVAL
    return LARGE_INTERVAL if np.bincount(field).max() > MOST_PARTICLES else TILED_INTERVAL


def estimate_bytes(
    num_envs: int,
    num_particles: int,
    max_active_blocks: int,
    num_fields: int = 1,
    num_blocks: int = 0,
    path: str = "plain",
) -> int:
    """Estimate the device memory of state and scratch, where nothing is retained [bytes].

    120 B a particle; 80 B a node, 48 more in fixed point, 32 less with sums in shared memory, 32 more with several
    fields; and the map of blocks.
    """
    accumulators = 16 if path == "block" else (32 + 16) * (2 if path == "tiled" else 1)
    node = accumulators + 32 + (16 + 16 if num_fields > 1 else 0)
    active_blocks = max_active_blocks * (
        BLOCK**3 * node + (10 if num_fields > 1 else 4) + (0 if path == "block" else 4)
    )
    particles = 48 * num_particles + 72 * whole_lines(num_particles)  # four vectors and two matrices
    return num_envs * (particles + active_blocks + 4 * num_blocks * (1 + num_fields)) + 2**10


def check_memory(
    num_envs: int,
    num_particles: int,
    max_active_blocks: int,
    device: str,
    num_fields: int = 1,
    num_blocks: int = 0,
    path: str = "plain",
    more_bytes: int = 0,
) -> None:
    """Check that a batch fits into memory, with ``more_bytes`` that an environment needs besides state and scratch.

    Raises:
        ValueError: the estimate exceeds the free memory of a CUDA device.
    """
    target = wp.get_device(device)
    if not target.is_cuda:
        return
    need = estimate_bytes(num_envs, num_particles, max_active_blocks, num_fields, num_blocks, path)
    need += num_envs * more_bytes
    if need > target.free_memory:
        fits = int(num_envs * target.free_memory / need)
        raise ValueError(
            f"{num_envs} environments need {need / 2**30:.1f} GiB, {target} has {target.free_memory / 2**30:.1f} GiB "
            f"free; use num_envs <= {fits} or a coarser fidelity"
        )


def allocate(model: Model) -> tuple[State, Scratch]:
    """Allocate zeroed state (identity deformation gradient) and scratch."""
    particles = (model.num_envs, model.num_particles)
    C, F = (allocate_matrices(*particles, model.device) for _ in range(2))
    F.assign(components_of(np.broadcast_to(np.eye(3), (*particles, 3, 3))))
    state = State(
        x=_zeros(model, particles, wp.vec3),
        u=_zeros(model, particles, wp.vec3),
        C=C,
        F=F,
        vk=_zeros(model, particles, wp.vec3),
        spin=_zeros(model, particles, wp.vec3),
        failure=_zeros(model, model.num_envs, int),
    )
    records = (model.num_envs, int(BLOCK_NODES) * model.max_active_blocks)
    shared = records if model.contact.num_fields > 1 else (1, 1)
    velocity = _zeros(model, (records[0], 2 * records[1]), wp.vec4)
    arena, large_arena = plan_arena(model)
    scratch = Scratch(
        blocks=allocate_blocks(model),
        accumulators=allocate_accumulators(model, velocity),
        velocity=velocity,
        volume_gradient=_zeros(model, shared, wp.vec4),
        sensors=allocate_sensors(model, shared),
        arena=arena,
        large_arena=large_arena,
        positions=None if model.thin_colliders is None else _zeros(model, particles, wp.vec3),
        retained=allocate_retained(model),
        unforced=None if model.retained_share is None else without_forces(model),
    )
    return state, scratch


def without_forces(model: Model) -> Model:
    """Return a model without stress, gravity and colliders."""
    step = Step()
    step.dt, step.gravity, step.decoupling = model.step.dt, wp.vec3(0.0), DECOUPLING["no_stress"]
    return replace(model, step=step, boundaries=make_boundaries((), model.contact.num_fields, 1, model.device))


def allocate_retained(model: Model) -> Retained | None:
    """Allocate what particles retain; None where nothing is retained."""
    if model.retained_share is None:
        return None
    particles = (model.num_envs, model.num_particles)
    return make_struct(
        Retained,
        share=model.retained_share,
        u=_zeros(model, particles, wp.vec3),
        C=allocate_matrices(*particles, model.device),
    )


def _zeros(model: Model, shape: int | tuple[int, ...], dtype: type) -> wp.array:
    return wp.zeros(shape, dtype=dtype, device=model.device)


def allocate_blocks(model: Model) -> Blocks:
    """Allocate a sparse grid without active blocks."""
    n, count = model.num_envs, model.num_blocks
    return make_struct(
        Blocks,
        fields=_zeros(model, (n, count), int),
        active=_zeros(model, (n, model.contact.num_fields * count), int),
        owner=wp.full((n, model.max_active_blocks), int(UNASSIGNED), dtype=int, device=model.device),
        num_active=_zeros(model, n, int),
        contact_blocks=_zeros(model, (n, max_contact_blocks(model)), int),
        num_contact_blocks=_zeros(model, n, int),
        num_updated=_zeros(model, n, int),
        frozen=_zeros(model, n, int),
        near_field=_zeros(model, (n, model.max_active_blocks) if senses_in_g2p(model) else (1, 1), int),
        contact_nodes=_zeros(model, (n, 2 * model.max_active_blocks) if tracks_contact_nodes(model) else (1, 1), int),
        candidate=_zeros(model, (n, model.num_particles) if wp.get_device(model.device).is_cpu else (1, 1), wp.uint8),
    )


def allocate_accumulators(model: Model, velocity: wp.array) -> Accumulators:
    """Allocate zeroed accumulators; on the block path sums are written to the records of ``velocity``."""
    fixed, records = model.path == "tiled", (model.num_envs, int(BLOCK_NODES) * model.max_active_blocks)
    mass, momentum = choose_quanta(model.contact.density.numpy(), model.grid, model.step)
    floats, integers = ((1, 1), records) if fixed else (records, (1, 1))
    return make_struct(
        Accumulators,
        is_fixed=int(fixed),
        value=velocity if model.path == "block" else _zeros(model, (1, 1) if fixed else velocity.shape, wp.vec4),
        fixed=_zeros(model, (records[0], 2 * records[1]) if fixed else (1, 1), vec4l),
        offset=_zeros(model, floats, wp.vec4),
        offset_fixed=_zeros(model, integers, vec4l),
        mass_quantum=wp.array(mass.astype(np.float32), dtype=float, device=model.device),
        momentum_quantum=wp.array(momentum.astype(np.float32), dtype=float, device=model.device),
        candidates=_zeros(model, (1, 1) if model.path == "block" else (model.num_envs, model.max_active_blocks), int),
    )


def allocate_sensors(model: Model, records: tuple[int, int]) -> Sensors:
    """Allocate zeroed contact sensors, with ``records`` at the nodes."""
    n, subjects = model.num_envs, model.contact.num_subjects
    rows = max(1, model.num_sensors)
    entries = subjects * (2 + subjects + rows)
    # the block path clears these flags of a single field as well where G2P is a launch of its own
    flagged = model.contact.num_fields > 1 or model.retained_share is not None
    touched = (n, model.max_active_blocks) if flagged else (1, 1)
    return make_struct(
        Sensors,
        accumulators=_zeros(model, (n, 3 * entries), wp.int64),
        boundary_impulse=_zeros(model, (n, subjects), wp.vec3),
        boundary_moment=_zeros(model, (n, subjects), wp.vec3),
        pair_impulse=_zeros(model, (n, subjects * subjects), wp.vec3),
        part_impulse=_zeros(model, (n, rows, subjects), wp.vec3),
        node=_zeros(model, records, wp.vec4),
        touched=_zeros(model, touched, int),
        penetration=_zeros(model, (n, subjects), float),
        limited_sum=_zeros(model, (n, 2), wp.int64),
        limited=_zeros(model, n, float),
    )
