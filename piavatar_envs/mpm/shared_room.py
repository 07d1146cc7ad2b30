"""Which worlds have their grids in shared memory, in what parts, and what lies where there.

The bodies of an environment have CUDA blocks of their own where they share no velocity field: until contact they have
nothing to do with each other.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.mpm.shared_grid import BLOCK_BRICKS, BRICK_WORDS, HEADER, KINEMATIC_BRICK_WORDS, PLACES
from piavatar_envs.mpm.types import Model, Room

#: Words of a room of which two fit into a multiprocessor, and of one that takes it all; with what stores take of it.
SMALL_ROOM, LARGE_ROOM = 27_008, 54_272
#: Threads of their CUDA blocks.
SMALL_THREADS, LARGE_THREADS = 320, 640
#: Slots of a part up to which the small one does: they are more than will be used, and half of their nodes.
MOST_SLOTS_SMALL = 210
#: Particles of a part up to which its CUDA block has no more to do than others have time for.
MOST_PARTICLES = 8192
#: Particles of an environment, which are listed in half words.
MOST_LISTED = 2**16


def parts_of(field: np.ndarray) -> list[tuple[int, int, int]]:
    """The shortest runs of particles that share no velocity field, each for a CUDA block of its own.

    Args:
        field: velocity fields of the particles, shape ``(num_particles,)``.

    Returns:
        First particle, one after the last, and bits of the fields, of every part.
    """
    last = {int(f): int(np.flatnonzero(field == f)[-1]) for f in np.unique(field)}
    parts, first, end = [], 0, 0
    for p, f in enumerate(field.tolist()):
        end = max(end, last[f])
        if p == end:
            parts.append((first, p + 1, int(np.bitwise_or.reduce(1 << np.unique(field[first : p + 1])))))
            first = p + 1
    return parts


def most_particles(field: np.ndarray) -> int:
    """Particles of the largest part."""
    return max(end - first for first, end, _ in parts_of(field))


def suits_shared(device: str, field: np.ndarray, max_slots: int) -> bool:
    """Whether environments with such particles may have CUDA blocks of their own, and enough shared memory."""
    target = wp.get_device(device)
    few = most_particles(field) <= MOST_PARTICLES and len(field) <= MOST_LISTED
    if not (target.is_cuda and target.arch >= 80 and few):
        return False
    tables = int(BLOCK_BRICKS) * max_slots + len(field) // 32 + max_slots // 4
    fits = 4 * tables < LARGE_ROOM and int(BLOCK_BRICKS) * max_slots < int(PLACES)
    return target.max_shared_memory_per_block >= 227 * 1024 and fits


def has_large_room(model: Model, parts: list[tuple[int, int, int]]) -> bool:
    """Whether rooms of these ``parts`` take a multiprocessor each: nodes need it, or there are enough of them.

    A large room has more threads, and what they add up are integers: the result is the same.
    """
    share = max(end - first for first, end, _ in parts) / model.num_particles
    if share * model.max_slots > MOST_SLOTS_SMALL:
        return True
    return model.num_envs * len(parts) <= wp.get_device(model.device).sm_count


def plan_room(model: Model) -> tuple[Room, bool]:
    """Where things lie in a room, and whether it is a large one."""
    room = Room()
    if model.scatter != "shared":
        return room, False
    parts = parts_of(model.particles.field.numpy())
    large = has_large_room(model, parts)
    room.numbers = int(HEADER)
    room.told = room.numbers + int(BLOCK_BRICKS) * model.max_slots // 2
    room.near = room.told + -(-model.num_particles // 32)
    room.places = _multiple_of_4(room.near + -(-model.max_slots // 4))
    room.bricks = _multiple_of_4(room.places + int(BLOCK_BRICKS) * model.max_slots // 2)
    words = int(BRICK_WORDS) + int(KINEMATIC_BRICK_WORDS)
    room.capacity = ((LARGE_ROOM if large else SMALL_ROOM) - room.bricks) // words - 1
    room.kinematic = room.bricks + int(BRICK_WORDS) * (room.capacity + 1)
    room.part = wp.array(np.array(parts, np.int32), dtype=wp.vec3i, device=model.device)
    room.speed = wp.zeros((model.num_envs, model.contact.num_fields), dtype=float, device=model.device)
    return room, large


def _multiple_of_4(words: int) -> int:
    return -(-words // 4) * 4
