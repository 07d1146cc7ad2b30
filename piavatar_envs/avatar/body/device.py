"""From a body in NumPy to the arrays that its drive reads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, PARENTS
from piavatar_envs.avatar.segment_sums import share_chunks
from piavatar_envs.avatar.skinning import in_order, pack
from piavatar_envs.avatar.types import Body

#: Entries of one chunk of a bone's particle list, which a warp sums on a GPU: few enough that one body keeps many warps
#: busy, so many that adding up the threads' sums costs little.
CHUNK = 256
#: In large bodies chunks are longer, so that there are about so many: what they sum to is added up in turn.
MOST_CHUNKS = 2048
#: Fewest tracking particles from which a rotation is fitted reliably.
MIN_TRACKERS = 18


@dataclass(frozen=True)
class BodyPoints:
    """A body as points in its rest pose (NumPy). ``rows`` is 1, or ``num_envs`` where shapes differ.

    Attributes:
        rest: rest positions [m], shape ``(rows, num_points, 3)``.
        mass: masses [kg], shape ``(rows, num_points)``.
        joints: rest joint positions [m], shape ``(rows, 22, 3)``.
        skin_joints: bones that move a point, shape ``(num_points, 4)`` int.
        skin_weights: their weights, descending, rows sum to one, shape ``(num_points, 4)``.
        bone: joint that a point tracks, -1 for flesh, shape ``(num_points,)``.
        inert: share of a change of commanded motion that a point misses (it jiggles), shape ``(rows, num_points)``.
    """

    rest: np.ndarray
    mass: np.ndarray
    joints: np.ndarray
    skin_joints: np.ndarray
    skin_weights: np.ndarray
    bone: np.ndarray
    inert: np.ndarray

    @property
    def num_points(self) -> int:
        """Number of points."""
        return self.rest.shape[1]


def bone_lists(points: BodyPoints, part: int) -> dict[str, np.ndarray]:
    """Chunked lists of the particles that each bone moves: chunk ``c`` holds ``entry_start[c] : entry_start[c + 1]``.

    The particles of a chunk are in one of the parts that the body has, of ``part`` particles each.
    """
    skin_joints, skin_weights = in_order(points.skin_joints, points.skin_weights)
    chunk_start, chunk_bone, entry_start, entries, weights = [0], [], [0], [], []
    chunk = max(CHUNK, 32 * -(-np.count_nonzero(skin_weights > 0.0) // (32 * MOST_CHUNKS)))
    for bone in range(NUM_JOINTS):
        point, slot = np.nonzero((skin_joints == bone) & (skin_weights > 0.0))
        borders = np.searchsorted(point, np.arange(0, points.num_points, part))
        for first, last in zip(borders, [*borders[1:], len(point)], strict=True):
            for begin in range(first, last, chunk):
                inside = slice(begin, min(begin + chunk, last))
                entries.append(point[inside])
                weights.append(skin_weights[point[inside], slot[inside]])
                entry_start.append(entry_start[-1] + len(point[inside]))
                chunk_bone.append(bone)
        chunk_start.append(len(chunk_bone))
    return {
        "chunk_start": np.array(chunk_start, np.int32),
        "chunk_bone": np.array(chunk_bone, np.int32),
        "entry_start": np.array(entry_start, np.int32),
        "entry": np.concatenate(entries).astype(np.int32),
        "entry_weight": np.concatenate(weights).astype(np.float32),
    }


def _joint_depths() -> list[int]:
    """Joints between each joint and the root."""
    depths: list[int] = []
    for parent in PARENTS:
        depths.append(0 if parent < 0 else depths[parent] + 1)
    return depths


def bone_masses(points: BodyPoints) -> tuple[np.ndarray, np.ndarray]:
    """Skinning-weighted mass [kg] ``(rows, 22)`` and centre of mass [m] ``(rows, 22, 3)`` of every bone at rest."""
    dense = np.zeros((points.num_points, NUM_JOINTS))
    for slot in range(4):
        np.add.at(dense, (np.arange(points.num_points), points.skin_joints[:, slot]), points.skin_weights[:, slot])
    weighted = points.mass[:, :, None] * dense
    mass = weighted.sum(1)
    center = np.einsum("rpb,rpi->rbi", weighted, points.rest.astype(np.float64))
    return mass, center / np.maximum(mass, 1e-12)[..., None]


def build_body(points: BodyPoints, first: int, device: str) -> Body:
    """Device arrays of a body whose particles start at ``first``.

    Raises:
        ValueError: a bone has too few tracking particles, or weights do not sum to one.
    """
    sums = points.skin_weights.sum(1)
    if np.abs(sums - 1.0).max() > 1e-4:
        raise ValueError(
            f"skinning weights of point {np.abs(sums - 1).argmax()} sum to {sums[np.abs(sums - 1).argmax()]}"
        )
    trackers = [np.nonzero(points.bone == bone)[0] for bone in range(NUM_JOINTS)]
    fewest = min(range(NUM_JOINTS), key=lambda b: len(trackers[b]))
    if len(trackers[fewest]) < MIN_TRACKERS:
        raise ValueError(f"bone {fewest} has {len(trackers[fewest])} tracking particles; {MIN_TRACKERS} are needed")
    bone_mass, center = bone_masses(points)

    def upload(value, dtype):
        scalar = np.int32 if dtype is int else np.float32
        return wp.array(np.ascontiguousarray(value, scalar), dtype=dtype, device=device)

    body = Body()
    body.first, body.count = first, points.num_points
    body.rest = upload(points.rest, wp.vec3)
    joints, weights = in_order(points.skin_joints, points.skin_weights)
    body.skin = upload(pack(joints, weights), wp.vec4)
    several = weights[:, 1] > 0.0
    body.alone = int(several.argmax()) if several.any() else points.num_points
    body.inert = upload(points.inert, float)
    body.rest_joint = upload(points.joints, wp.vec3)
    body.rest_center = upload(center, wp.vec3)
    body.bone_mass = upload(bone_mass, float)
    depths = _joint_depths()
    body.parent, body.depth, body.levels = upload(PARENTS, int), upload(depths, int), max(depths) + 1
    body.level_start = upload(np.searchsorted(depths, np.arange(body.levels + 1)), int)  # they are in order
    children = [sum(1 << child for child, parent in enumerate(PARENTS) if parent == b) for b in range(NUM_JOINTS)]
    body.children = upload(children, int)
    body.tracker_start = upload(np.cumsum([0, *map(len, trackers)]), int)
    body.tracker = upload(np.concatenate(trackers), int)
    set_lists(body, bone_lists(points, points.num_points), device)
    return body


def set_lists(body: Body, lists: dict[str, np.ndarray], device: str) -> None:
    """Upload what :func:`bone_lists` has found."""
    borders, bone = lists["entry_start"], lists["chunk_bone"]
    quarters = share_chunks(np.arange(len(bone)), borders[:-1], borders[1:], bone, device)
    body.quarters = wp.array(quarters, dtype=wp.vec4i, device=device)
    for name in ("chunk_start", "chunk_bone", "entry", "entry_weight"):
        setattr(body, name, wp.array(lists[name], dtype=float if name == "entry_weight" else int, device=device))
