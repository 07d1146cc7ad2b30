"""Meshes of markers and colliders: unit meshes on the host, placed by one formula on the device.

A vertex has coordinates whose meaning depends on the kind of its marker: a point of the unit sphere or cube; of an
arrow, a point about its axis and which height it has; of a ring, how far along the part above the ground it is, and
where about the wire. A vertex of a hidden marker is NaN, so that its triangles are skipped while the mesh stays.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from piavatar_envs.core.kernel_cache import init_warp
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import fill
from piavatar_envs.mpm.types import row
from piavatar_envs.sim.markers import SIZES, Markers

wp.set_module_options({"enable_backward": False})

KINDS = tuple(SIZES)
BOX, CAPSULE = wp.constant(KINDS.index("box")), wp.constant(KINDS.index("capsule"))
RING, ARROW = wp.constant(KINDS.index("ring")), wp.constant(KINDS.index("arrow"))
_SPHERE_RINGS, _SPHERE_SEGMENTS = 20, 32
_ARROW_SEGMENTS = 24
_BOX_CELLS = 6
_RING_SEGMENTS, _WIRE_SEGMENTS = 48, 12
#: Radius and length of an arrow's head over the radius of its shaft; a head takes half of a short arrow.
HEAD_RADIUS, HEAD_LENGTH = 2.4, wp.constant(5.0)
#: Heights of an arrow's vertices: its tail, the foot of its head and its tip.
_TAIL, _NECK, _TIP = 0.0, 1.0, 2.0


@wp.struct
class MarkerMeshes:
    """Constants of the meshes of ``M`` markers with ``V`` vertices together."""

    local: wp.array(dtype=wp.vec3)  # (V,) see :mod:`piavatar_envs.render.markers`
    marker: wp.array(dtype=int)  # (V,) that a vertex belongs to
    column: wp.array(dtype=int)  # (M,) where the placed one is in Markers
    kind: wp.array(dtype=int)  # (M,) index into KINDS
    size: wp.array(dtype=wp.vec3)  # (M,) [m]; of a ring the third number is the height below which it is left out


@wp.func
def ring_point(size: wp.vec3, scale: float, local: wp.vec3, position: wp.vec3, rotation: wp.quat):
    """Return a vertex of a ring, from where it leaves the ground on one side, over its top, to the other [m]."""
    normal = wp.quat_rotate(rotation, wp.vec3(0.0, 0.0, 1.0))
    up = wp.vec3(0.0, 0.0, 1.0)
    if wp.abs(normal[2]) >= 0.9:
        up = wp.vec3(0.0, 1.0, 0.0)
    up = wp.normalize(up - wp.dot(up, normal) * normal)
    radius = scale * size[0]
    sine = wp.clamp((size[2] - position[2]) / wp.max(radius * up[2], 1.0e-9), -1.0, 1.0)
    angle = wp.asin(sine) + local[0] * (wp.pi - 2.0 * wp.asin(sine))
    out = wp.cos(angle) * wp.cross(up, normal) + wp.sin(angle) * up
    return position + (radius + size[1] * local[1]) * out - (size[1] * local[2]) * normal


@wp.func
def marker_point(kind: int, size: wp.vec3, scale: float, local: wp.vec3, position: wp.vec3, rotation: wp.quat):
    """Return a vertex of a marker in the world [m]."""
    if kind == RING:
        return ring_point(size, scale, local, position, rotation)
    at = (scale * size[0]) * local
    if kind == BOX:
        at = scale * wp.cw_mul(size, local)
    elif kind == CAPSULE:
        half = scale * size[1]
        at[2] += wp.where(local[2] >= 0.0, half, -half)
    elif kind == ARROW:
        length = scale * size[1]
        neck = length - wp.min(HEAD_LENGTH * size[0], 0.5 * length)
        height = neck * wp.min(local[2], 1.0) + (length - neck) * wp.max(local[2] - 1.0, 0.0)
        at = wp.vec3(size[0] * local[0], size[0] * local[1], height)
    return position + wp.quat_rotate(rotation, at)


@wp.kernel
def place_markers(
    envs: wp.array(dtype=int),
    meshes: MarkerMeshes,
    markers: Markers,
    first: int,
    # out
    vertices: wp.array2d(dtype=wp.vec3),
):
    """Write the vertices of the markers, from vertex ``first`` of every picture on; over ``(pictures, V)``."""
    i, v = wp.tid()
    if envs[i] < 0:
        return
    m = meshes.marker[v]
    e = row(envs[i], markers.position.shape[0])
    c = meshes.column[m]
    at = wp.vec3(wp.NAN, wp.NAN, wp.NAN)
    if markers.visible[row(e, markers.visible.shape[0]), c]:
        scale = markers.scale[row(e, markers.scale.shape[0]), c]
        at = marker_point(
            meshes.kind[m], meshes.size[m], scale, meshes.local[v], markers.position[e, c], markers.rotation[e, c]
        )
    vertices[i, first + v] = at


def unit_mesh(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return coordinates ``(V, 3)`` and triangles ``(T, 3)`` of a kind of marker; the same arrays on every call."""
    return _MESHES[kind]


def upload_meshes(
    kinds: Sequence[str], sizes: Sequence[Sequence[float]], device: str, columns: Sequence[int] | None = None
) -> MarkerMeshes:
    """Upload the meshes of markers, one after the other.

    Args:
        kinds: of the markers.
        sizes: of each [m], up to three numbers.
        device: the device to upload to.
        columns: of each among those that are placed; in the same order if not given.
    """
    columns = np.arange(len(kinds)) if columns is None else np.asarray(columns)
    locals_ = [unit_mesh(kind)[0] for kind in kinds]
    owner = np.repeat(np.arange(len(kinds), dtype=np.int32), [len(local) for local in locals_])
    padded = np.array([[*size, 0.0, 0.0, 0.0][:3] for size in sizes], np.float32).reshape(-1, 3)
    local = np.concatenate([*locals_, np.zeros((0, 3))]).astype(np.float32)
    return fill(
        MarkerMeshes(),
        local=wp.array(local, dtype=wp.vec3, device=device),
        marker=wp.array(owner, dtype=int, device=device),
        column=wp.array(columns.astype(np.int32), dtype=int, device=device),
        kind=wp.array(np.array([KINDS.index(kind) for kind in kinds], np.int32), dtype=int, device=device),
        size=wp.array(padded, dtype=wp.vec3, device=device),
    )


def placed_mesh(
    kind: str, size: Sequence[float], position: np.ndarray, rotation: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return world vertices ``(V, 3)`` float32 [m] and triangles ``(T, 3)`` of one marker, computed on the CPU.

    Args:
        kind: of the marker.
        size: of it [m]; of a ring with the height below which it is left out.
        position: of it [m].
        rotation: quaternion ``xyzw``.
    """
    init_warp()
    meshes = upload_meshes([kind], [size], "cpu")
    markers = fill(
        Markers(),
        position=wp.array(np.array([[position]], np.float32), dtype=wp.vec3, device="cpu"),
        rotation=wp.array(np.array([[rotation]], np.float32), dtype=wp.quat, device="cpu"),
        scale=wp.ones((1, 1), dtype=float, device="cpu"),
        visible=wp.array(np.ones((1, 1), bool), dtype=wp.bool, device="cpu"),
    )
    vertices = wp.zeros((1, len(meshes.local)), dtype=wp.vec3, device="cpu")
    graph = LaunchGraph("cpu")
    graph.launch(place_markers, vertices.shape, [wp.zeros(1, dtype=int, device="cpu"), meshes, markers, 0], [vertices])
    graph.run_eager()
    return vertices.numpy()[0], unit_mesh(kind)[1]


def turn_to_direction(direction: Sequence[float]) -> np.ndarray:
    """Return the quaternion ``xyzw`` that turns the z axis along a direction; the identity without a length."""
    direction = np.asarray(direction, np.float64)
    length = float(np.linalg.norm(direction))
    x, y, z = direction / length if length > 1e-9 else (0.0, 0.0, 1.0)
    if z < -0.999999:
        return np.array([1.0, 0.0, 0.0, 0.0])
    turn = np.array([-y, x, 0.0, 1.0 + z])
    return turn / np.linalg.norm(turn)


def _grid_faces(num_rings: int, num_segments: int) -> np.ndarray:
    """Return outward triangles between consecutive rings that rise along z."""
    ring, segment = np.meshgrid(np.arange(num_rings - 1), np.arange(num_segments), indexing="ij")
    following = (segment + 1) % num_segments
    a, b = ring * num_segments + segment, ring * num_segments + following
    c, d = a + num_segments, b + num_segments
    return np.concatenate([np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)]).astype(
        np.int32
    )


def _unit_sphere() -> tuple[np.ndarray, np.ndarray]:
    polar = np.linspace(np.pi, 0.0, _SPHERE_RINGS)
    angle = np.linspace(0.0, 2.0 * np.pi, _SPHERE_SEGMENTS, endpoint=False)
    radius, shape = np.sin(polar)[:, None], (_SPHERE_RINGS, _SPHERE_SEGMENTS)
    vertices = np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.broadcast_to(np.cos(polar)[:, None], shape)], axis=-1
    )
    return vertices.reshape(-1, 3), _grid_faces(_SPHERE_RINGS, _SPHERE_SEGMENTS)


def _unit_box() -> tuple[np.ndarray, np.ndarray]:
    """Return six gridded sides that share no vertices, so that edges are sharp and shadows are filled."""
    line = np.linspace(-1.0, 1.0, _BOX_CELLS + 1)
    u, v = (grid.ravel() for grid in np.meshgrid(line, line, indexing="ij"))
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(_BOX_CELLS), np.arange(_BOX_CELLS), indexing="ij"))
    corner = i * (_BOX_CELLS + 1) + j
    quad = np.stack([corner, corner + _BOX_CELLS + 1, corner + _BOX_CELLS + 2, corner + 1], axis=-1)
    vertices, faces = [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            side = np.empty((len(u), 3))
            side[:, axis], side[:, (axis + 1) % 3], side[:, (axis + 2) % 3] = sign, u, v
            order = quad if sign > 0.0 else quad[:, ::-1]
            offset = len(vertices) * len(u)
            vertices.append(side)
            faces.append(np.concatenate([order[:, [0, 1, 2]], order[:, [0, 2, 3]]]) + offset)
    return np.concatenate(vertices), np.concatenate(faces).astype(np.int32)


def _unit_ring() -> tuple[np.ndarray, np.ndarray]:
    along, around = np.meshgrid(
        np.linspace(0.0, 1.0, _RING_SEGMENTS + 1),
        np.linspace(0.0, 2.0 * np.pi, _WIRE_SEGMENTS, endpoint=False),
        indexing="ij",
    )
    vertices = np.stack([along, np.cos(around), np.sin(around)], axis=-1).reshape(-1, 3)
    return vertices, _grid_faces(_RING_SEGMENTS + 1, _WIRE_SEGMENTS)


def _unit_arrow() -> tuple[np.ndarray, np.ndarray]:
    """Return rings from the tail to the tip, doubled where an edge shall stay sharp."""
    radii = np.array([0.0, 0.0, 1.0, 1.0, 1.0, 1.0, HEAD_RADIUS, HEAD_RADIUS, 0.0, 0.0])
    heights = np.array([_TAIL] * 4 + [_NECK] * 4 + [_TIP] * 2)
    angle = np.linspace(0.0, 2.0 * np.pi, _ARROW_SEGMENTS, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rings = np.broadcast_to(heights[:, None, None], (len(heights), _ARROW_SEGMENTS, 1))
    vertices = np.concatenate([radii[:, None, None] * circle, rings], axis=-1).reshape(-1, 3)
    return vertices, _grid_faces(len(radii), _ARROW_SEGMENTS)


_SPHERE = _unit_sphere()
_MESHES = {"sphere": _SPHERE, "box": _unit_box(), "capsule": _SPHERE, "ring": _unit_ring(), "arrow": _unit_arrow()}
