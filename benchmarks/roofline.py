"""How fast a substep could be: what it must move, add up and launch, against what the device can do.

The counts are of the scheme, not of an implementation: each is the least that P2G, one grid pass and G2P need, with
particles read and written once a substep, every node's sums written once and read once, velocities alike.

    bytes    P (120 + 28 + 96) + N (4 * 32)   state and constants in, state out; sums and velocities of nodes
    flop     P * 1800 + N * 60                counted in the kernels' source, stress and both stencils; +- a third
    additions  27 * cells                     of 32-byte records, when all particles of a cell are summed first
    launch   of a captured graph's kernels, one after the other

``P`` particles, ``N`` nodes with mass, a node of two velocity fields counts twice. The largest of the four times is the
bound. It is a yardstick, not a law: state that fits into the second-level cache can beat the first, a scatter that sums
whole blocks before it writes the third.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from piavatar_envs.mpm.types import Model, State

#: x, u, vk, spin (3 floats each), C, F (9 each); x, u, C, F are written; mass, volume, mu, lam, material, field, seam.
STATE_BYTES, WRITTEN_BYTES, CONSTANT_BYTES = 120, 96, 28
NODE_BYTES = 32  # mass, physical momentum, kinematic momentum, seam
STENCIL = 27
WORDS = 7  # of a record that are added to, 4 bytes each
FLOP_PER_PARTICLE, FLOP_PER_NODE = 1800.0, 60.0


@dataclass(frozen=True)
class Peaks:
    """What a device can do.

    Attributes:
        name: of the device, as it calls itself.
        bandwidth: of its memory [byte/s], from the data sheet.
        flops: in single precision [1/s], from the data sheet.
        additions: of 32-byte records to nodes [1/s], from the prototypes: 300,000 particles inside a body, which
            lie in 64,283 cells, in 25 us, the particles of a cell summed first.
        launch: least time of a node of a captured graph [s], from the prototypes.
    """

    name: str
    bandwidth: float
    flops: float
    additions: float
    launch: float


H200 = Peaks("NVIDIA H200", 4.8e12, 67.0e12, 64_283 * STENCIL / 25.0e-6, 1.25e-6)


@dataclass(frozen=True)
class Counts:
    """What there is in a batch, read off its particles.

    Attributes:
        particles: of all environments.
        cells: that hold particles, each field's by themselves.
        nodes: with mass, likewise.
        blocks: of 4 x 4 x 4 nodes with mass, whatever their fields.
        shared_nodes: on which more than one field has mass.
    """

    particles: int
    cells: int
    nodes: int
    blocks: int
    shared_nodes: int


def count(model: Model, state: State, most_envs: int = 16) -> Counts:
    """Counts of a batch; of a large one, those of ``most_envs`` evenly chosen environments times the rest."""
    chosen = np.unique(np.linspace(0, model.num_envs - 1, min(most_envs, model.num_envs)).astype(int))
    x, field = state.x.numpy(), model.particles.field.numpy()
    origin, size = np.array(model.grid.origin, float), np.array(model.grid.nodes)
    fields = range(model.contact.num_fields)
    cells = nodes = blocks = shared = 0
    for env in chosen:
        base = np.floor((x[env] - origin) / model.grid.dx - 0.5).astype(np.int64)
        meets = np.zeros(size, np.int8)
        for f in fields:
            own = np.unique(base[field == f], axis=0)
            mine = np.zeros(size, bool)
            for offset in np.ndindex(3, 3, 3):
                mine[tuple((own + offset).T)] = True
            cells, nodes = cells + len(own), nodes + int(mine.sum())
            meets += mine
        shared += int((meets > 1).sum())
        blocks += len(np.unique(np.argwhere(meets > 0) // 4, axis=0))
    share = model.num_envs / len(chosen)
    per_batch = (round(share * value) for value in (cells, nodes, blocks, shared))
    return Counts(model.num_envs * model.num_particles, *per_batch)


def bound(counts: Counts, launches: float, peaks: Peaks = H200) -> dict[str, Any]:
    """Least time of a substep on a device, and what sets it.

    Args:
        counts: of the batch.
        launches: kernels a substep.
        peaks: of the device.

    Returns:
        A row's ``roofline``: counts, ``bytes``, ``flop``, ``additions`` (``atomics``: their words), ``launches``, the
        time of each ``*_us``, ``bound_ms`` and the name of the largest in ``bound_by``.
    """
    moved = counts.particles * (STATE_BYTES + CONSTANT_BYTES + WRITTEN_BYTES) + counts.nodes * 4 * NODE_BYTES
    flop = counts.particles * FLOP_PER_PARTICLE + counts.nodes * FLOP_PER_NODE
    additions = counts.cells * STENCIL
    times = {
        "memory": moved / peaks.bandwidth,
        "arithmetic": flop / peaks.flops,
        "additions": additions / peaks.additions,
        "launch": launches * peaks.launch,
    }
    largest = max(times, key=lambda name: times[name])
    return {
        "of": peaks.name,
        "cells": counts.cells,
        "nodes": counts.nodes,
        "shared_nodes": counts.shared_nodes,
        "blocks": counts.blocks,
        "bytes": moved,
        "flop": flop,
        "additions": additions,
        "atomics": additions * WORDS,
        "launches": launches,
        **{f"{name}_us": 1e6 * seconds for name, seconds in times.items()},
        "bound_ms": 1e3 * times[largest],
        "bound_by": largest,
    }


#: Kernels of bodies whose grid is in shared memory, see :mod:`piavatar_envs.mpm.cuda.block_substep`.
SUBSTEPS = ("substep_in_small_room", "substep_in_large_room")
NODE_PASSES = ("nodes_in_small_room", "nodes_in_large_room")


def kernel_bytes(kernel: str, model: Model, counts: Counts) -> int | None:
    """Bytes that one launch of a kernel must move; None where no formula is known.

    Constants that all environments share, and chunk lists of a body, stay in the cache and are not counted.
    """
    particles, nodes = counts.particles, counts.nodes
    constants = CONSTANT_BYTES if model.particles.mass.shape[0] > 1 else 0
    sums = nodes * NODE_BYTES * (2 if model.scatter == "runs" else 1)  # in fixed point a number has two words
    # state and constants in; sums read and written where particles are
    scatter = particles * (STATE_BYTES + constants) + 2 * sums
    formulas = {
        "particles_to_grid": scatter,
        "runs_to_grid": scatter,
        # mass and physical momentum in and cleared, physical velocities out; more where contact is at hand
        "update_grid": 2 * sums // (2 if model.scatter == "runs" else 1) + nodes * NODE_BYTES // 2,
        # x, F, vk, spin and physical velocities in; x, u, C, F out
        "grid_to_particles": particles * (72 + WRITTEN_BYTES) + nodes * NODE_BYTES // 2,
        # a body's grid stays in shared memory: what the scatter reads, and x, F, vk and spin once more; x, u, C, F out
        **dict.fromkeys(SUBSTEPS, particles * (STATE_BYTES + constants + 72 + WRITTEN_BYTES)),
        # velocities or sums out
        **dict.fromkeys(NODE_PASSES, particles * (STATE_BYTES + constants) + nodes * NODE_BYTES),
        # x, u in; vk, spin, pull, lean out; of flesh that is not inert and bodies that are held
        "drive_particles": particles * 6 * 12,
        # x, u, pull in; u out
        "apply_corrections": particles * 4 * 12,
        "sum_moments": particles * 2 * 12,  # x, u
        "attach_flesh": particles * 5 * 12,  # x, u, vk in; u, vk out
        "sum_corrections": particles * 3 * 12,  # x, pull, lean
    }
    return formulas.get(kernel)


def kernel_additions(kernel: str, counts: Counts) -> int | None:
    """Records that one launch of a kernel adds to nodes if it adds each particle's by itself; None for others."""
    scatters = ("particles_to_grid", "runs_to_grid")
    scatters += (*SUBSTEPS, *NODE_PASSES)
    return counts.particles * STENCIL if kernel in scatters else None
