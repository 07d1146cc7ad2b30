"""Constants of a body on the device, from a body in NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.pose_correctives import PoseCorrectives
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, PARENTS
from piavatar_envs.avatar.correctives import upload_correctives
from piavatar_envs.avatar.segment_sums import PARTITION_SIZE, Partitions, share_chunks
from piavatar_envs.avatar.skinning import in_order, pack
from piavatar_envs.avatar.types import Body

#: Entries of one chunk of a bone's particle list, which a warp sums on a GPU: few enough that one body keeps many warps
#: busy, enough that adding up the threads' sums costs little.
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
        velocity_lag: share of a change of commanded motion that a point misses, shape ``(rows, num_points)``.
        correctives: displacements of the rest pose that depend on the pose; none if not given.
    """

    rest: np.ndarray
    mass: np.ndarray
    joints: np.ndarray
    skin_joints: np.ndarray
    skin_weights: np.ndarray
    bone: np.ndarray
    velocity_lag: np.ndarray
    correctives: PoseCorrectives | None = None

    @property
    def num_points(self) -> int:
        """Return the number of points."""
        return self.rest.shape[1]


def bone_lists(points: BodyPoints, part: int) -> dict[str, np.ndarray]:
    """List the particles that each bone moves in chunks: chunk ``c`` holds ``entry_start[c] : entry_start[c + 1]``.

    The particles of a chunk are in one partition of the body, of ``part`` particles each.
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
    """Count the joints between each joint and the root."""
    depths: list[int] = []
    for parent in PARENTS:
        depths.append(0 if parent < 0 else depths[parent] + 1)
    return depths


def bone_masses(points: BodyPoints) -> tuple[np.ndarray, np.ndarray]:
    """Return skinning-weighted mass [kg] ``(rows, 22)`` and centre of mass [m] ``(rows, 22, 3)`` of bones at rest."""
    dense = np.zeros((points.num_points, NUM_JOINTS))
    for slot in range(4):
        np.add.at(dense, (np.arange(points.num_points), points.skin_joints[:, slot]), points.skin_weights[:, slot])
    weighted = points.mass[:, :, None] * dense
    mass = weighted.sum(1)
    center = np.einsum("rpb,rpi->rbi", weighted, points.rest.astype(np.float64))
    return mass, center / np.maximum(mass, 1e-12)[..., None]


def build_body(points: BodyPoints, first: int, device: str, num_envs: int = 1) -> Body:
    """Upload a body whose particles start at ``first``, in ``num_envs`` environments.

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
    body.correctives = upload_correctives(points.correctives, body.alone, num_envs, device)
    body.velocity_lag = upload(points.velocity_lag, float)
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
    """Upload the lists of :func:`bone_lists`."""
    borders, bone = lists["entry_start"], lists["chunk_bone"]
    quarters = share_chunks(np.arange(len(bone)), borders[:-1], borders[1:], bone, device)
    body.quarters = wp.array(quarters, dtype=wp.vec4i, device=device)
    for name in ("chunk_start", "chunk_bone", "entry", "entry_weight"):
        setattr(body, name, wp.array(lists[name], dtype=float if name == "entry_weight" else int, device=device))


def partition_size(device: str, count: int) -> int:
    """Return the particles of a partition of a body of ``count``; on a CPU all."""
    return PARTITION_SIZE if wp.get_device(device).is_cuda else count


def partition_body(points: BodyPoints, body: Body, device: str) -> tuple[Body, Partitions]:
    """Return the body with chunks that are each in one partition, and these partitions."""
    size = partition_size(device, points.num_points)
    divided, parts = Body(), Partitions()
    for name in Body.vars:
        setattr(divided, name, getattr(body, name))
    lists = bone_lists(points, size)
    set_lists(divided, lists, device)
    begin, end, bone = lists["entry_start"][:-1], lists["entry_start"][1:], lists["chunk_bone"]
    part = lists["entry"][begin] // size
    found = [np.flatnonzero(part == i) for i in range(-(-points.num_points // size))]
    quarters = [share_chunks(own, begin[own], end[own], bone[own], device) for own in found]
    parts.size = size
    parts.start = wp.array(np.cumsum([0, *map(len, quarters)]).astype(np.int32), dtype=int, device=device)
    parts.quarters = wp.array(np.concatenate(quarters), dtype=wp.vec4i, device=device)
    entry = np.stack([lists["entry"] % size, lists["entry_weight"].view(np.int32)], axis=1)
    parts.entry = wp.array(entry.astype(np.int32), dtype=wp.vec2i, device=device)
    return divided, parts
