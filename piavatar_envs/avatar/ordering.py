"""In which order a body's particles lie in memory: neighbours in the body should be neighbours there.

Threads that work together then ask for the same nodes of the grid, or blend the same bones.
"""

from __future__ import annotations

import numpy as np

from piavatar_envs.avatar.skeleton import NUM_JOINTS

SMALL_BODY = 8192  # particles up to which they are in the order of their bones
BOXES = (128, 64, 32)  # particles that lie together in larger ones, as many as P2G takes together or a warp has


def order_of_body(
    positions: np.ndarray, bone: np.ndarray, skin_joints: np.ndarray, skin_weights: np.ndarray
) -> np.ndarray:
    """Order ``(P,)`` of the particles of a body: by their bones if it is small, else in compact boxes.

    Args:
        positions: in the rest pose [m], shape ``(P, 3)``.
        bone: of which bone a particle is one's own, -1 for flesh, shape ``(P,)``.
        skin_joints: the bones that move it, shape ``(P, K)``.
        skin_weights: by which weights, 0 for none, shape ``(P, K)``.
    """
    if len(positions) <= SMALL_BODY:
        return order_by_bones(bone, skin_joints, skin_weights)
    return order_in_boxes(positions)


def order_along_curve(positions: np.ndarray, spacing: float) -> np.ndarray:
    """Order of the particles along Morton's curve, ``(P,)``: what is close in memory is close in the body.

    Threads and cache lines then share grid nodes and bones.
    """
    cells = ((positions - positions.min(axis=0)) / spacing).astype(np.uint64)
    code = np.zeros(len(cells), np.uint64)
    for bit, axis in np.ndindex(16, 3):
        code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def order_by_bones(bone: np.ndarray, skin_joints: np.ndarray, skin_weights: np.ndarray) -> np.ndarray:
    """Order ``(P,)`` in which bones' own particles come first, then those that one bone moves, two, and so on.

    Of as many bones those of the same ones follow each other, as they did. Threads that work together then blend as
    many bones, and mostly the same: one that blends four makes 31 others wait. Neighbours of large bodies are alike
    anyway, see :func:`order_in_boxes`.
    """
    moves = np.sort(np.where(skin_weights > 0.0, skin_joints, NUM_JOINTS), axis=1)
    return np.lexsort((*moves.T[::-1], (skin_weights > 0.0).sum(axis=1), bone < 0))


def order_in_boxes(positions: np.ndarray) -> np.ndarray:
    """Order ``(P,)`` in which each ``BOXES[0]`` particles have a compact box of their own, each ``BOXES[1]`` in it, ...

    Boxes are halved along their longest edge; in the smallest, particles stay as they are. The P2G of large bodies
    takes so many together and adds up on the nodes of the box around them, which a curve's jumps would make large.
    """

    def halve(inside: np.ndarray, level: int) -> list[np.ndarray]:
        while level < len(BOXES) and len(inside) <= BOXES[level]:
            level += 1
        if level == len(BOXES):
            return [np.sort(inside)]
        along = positions[inside, np.ptp(positions[inside], axis=0).argmax()]
        order = inside[np.argsort(along, kind="stable")]
        lower = BOXES[level] * -(-len(order) // (2 * BOXES[level]))
        return halve(order[:lower], level) + halve(order[lower:], level)

    return np.concatenate(halve(np.arange(len(positions)), 0))
