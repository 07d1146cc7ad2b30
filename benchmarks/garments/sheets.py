"""Sheets of cloth and surfaces of obstacles, without a body."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.asset import vertex_normals
from piavatar_envs.cloth.fabric import Fabric
from piavatar_envs.cloth.garment import NO_WEARER, Garment, Held
from piavatar_envs.cloth.mesh import ClothMesh
from piavatar_envs.cloth.obstacles import QUANTUM, Obstacles
from piavatar_envs.cloth.solver import Cloth
from piavatar_envs.cloth.types import ClothSettings
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import fill
from piavatar_envs.mpm.types import Boundaries

#: Of most tests: 0.2 kg/m^2, 200 N/m, and hardly any bending.
LINEN = Fabric(0.2, 200.0, 1e-6, drag=0.0, skin_drag=0.0)


def lattice(width: float, height: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points ``(V, 2)`` in ``[0, width] x [0, height]`` and triangles of a triangular lattice of rows in x."""
    columns, rows = max(1, round(width / spacing)), max(1, round(height / (spacing * np.sqrt(0.75))))
    points, row = [], []
    for j in range(rows + 1):
        even = np.arange(columns + 1) / columns
        x = width * (even if j % 2 == 0 else np.concatenate([[0.0], even[:-1] + 0.5 / columns, [1.0]]))
        row.append(sum(len(r) for r in row) + np.arange(len(x)))
        points.append(np.stack([x, np.full(len(x), j * height / rows)], axis=1))
    points = np.concatenate(points)
    faces = []
    for a, b in pairwise(row):
        i = k = 0
        while i < len(a) - 1 or k < len(b) - 1:  # advance in the row whose next point is further left
            if k == len(b) - 1 or (i < len(a) - 1 and points[a[i + 1], 0] <= points[b[k + 1], 0]):
                faces.append([a[i], a[i + 1], b[k]])
                i += 1
            else:
                faces.append([a[i], b[k + 1], b[k]])
                k += 1
    return points, np.array(faces, np.int32)


def mesh_of(points: np.ndarray, faces: np.ndarray) -> ClothMesh:
    """Return the mesh whose pattern is ``points``, in the plane or in space."""
    return ClothMesh.build(faces, lambda pairs: np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1))


def flat_sheet(width: float, height: float, spacing: float, z: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return points ``(V, 3)`` of a sheet around the z axis, and its triangles."""
    points, faces = lattice(width, height, spacing)
    return np.c_[points - [width / 2, height / 2], np.full(len(points), z)], faces


def hanging_sheet(width: float, height: float, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points of a sheet in the xz plane below z = 0, its triangles and the vertices of its upper border."""
    points, faces = lattice(width, height, spacing)
    points = np.c_[points[:, 0], np.zeros(len(points)), -points[:, 1]]
    return points, faces, np.flatnonzero(points[:, 2] > -1e-9)


def garment(
    points: np.ndarray,
    faces: np.ndarray,
    fabric: Fabric = LINEN,
    *,
    held: Sequence[int] = (),
    wearer: int = NO_WEARER,
    thickness: float = 0.004,
    sees: int = -1,
    start: np.ndarray | None = None,
) -> Garment:
    """Return a sheet cut as ``points``, which lies at ``start``; held vertices need a :func:`frame` as their wearer."""
    held = np.asarray(held, np.int32)
    places = Held.none()
    if len(held):
        p = points[held]
        weights = np.c_[1.0 - p[:, 0] - p[:, 1], p[:, 0], p[:, 1]]
        places = Held(held, np.zeros(len(held), np.int32), weights, p[:, 2])
        wearer, sees = 0, 0
    return Garment(
        "sheet", wearer, mesh_of(points, faces), points if start is None else start, places,
        np.full(len(points), sees, np.int32), thickness, fabric,
    )  # fmt: skip


def frame() -> tuple[np.ndarray, np.ndarray]:
    """Return a triangle in the xy plane at the origin, whose weights and offset are the coordinates of a point."""
    return np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.array([[0, 1, 2]])


def plane(half: float = 1.0, cells: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Return a square in the xy plane around the origin, facing up."""
    side = np.linspace(-half, half, cells + 1)
    points = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    i = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    n = cells + 1
    faces = np.concatenate([np.c_[i, i + n, i + n + 1], np.c_[i, i + n + 1, i + 1]])
    return np.c_[points, np.zeros(len(points))], faces


def sphere(radius: float = 0.1, rings: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Return a sphere around the origin."""
    from scipy.spatial import ConvexHull

    n = 4 * rings * rings
    z = 1.0 - (2.0 * np.arange(n) + 1.0) / n  # Fibonacci's lattice
    turn = np.arange(n) * np.pi * (3.0 - np.sqrt(5.0))
    points = np.c_[np.sqrt(1.0 - z**2) * np.cos(turn), np.sqrt(1.0 - z**2) * np.sin(turn), z]
    faces = ConvexHull(points).simplices
    a, b, c = (points[faces[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return radius * points, faces


def surfaces(*pieces: tuple[np.ndarray, np.ndarray], num_envs: int = 1, device: str = "cpu") -> Obstacles:
    """Return obstacles that rest; see :func:`move`."""
    first = np.cumsum([0, *(len(points) for points, _ in pieces)])
    faces = np.concatenate([face + at for (_, face), at in zip(pieces, first, strict=False)])
    sides = np.unique(np.concatenate([faces[:, [a, b]] for a in range(3) for b in range(3) if a != b]), axis=0)
    fans = np.c_[faces.ravel(), np.repeat(np.arange(len(faces)), 3)]
    fans = fans[np.lexsort((fans[:, 1], fans[:, 0]))]
    posts = [np.arange(a, b, max(1, (b - a) // 48)) for a, b in pairwise(first)]
    lists = {
        "ring_start": np.searchsorted(sides[:, 0], np.arange(first[-1] + 1)),
        "ring": sides[:, 1],
        "fan_start": np.searchsorted(fans[:, 0], np.arange(first[-1] + 1)),
        "fan": fans[:, 1],
        "part": np.ones(first[-1]),
        "piece_start": first,
        "post_start": np.cumsum([0, *map(len, posts)]),
        "post": np.concatenate(posts),
    }
    shape = (num_envs, int(first[-1]))
    o = fill(
        Obstacles(),
        faces=wp.array(faces.astype(np.int32), dtype=wp.vec3i, device=device),
        impulse=wp.zeros((*shape, 6), dtype=wp.int64, device=device),
        **{name: wp.array(values.astype(np.int32), dtype=int, device=device) for name, values in lists.items()},
        **{
            name: wp.zeros(shape, dtype=wp.vec3, device=device)
            for name in ("start", "end", "start_normal", "end_normal")
        },
    )
    for _ in range(2):
        move(o, np.concatenate([points for points, _ in pieces]))
    return o


def move(o: Obstacles, points: np.ndarray) -> None:
    """Let the obstacles move on to ``points``, ``(N, 3)`` or ``(num_envs, N, 3)``, in the next control step."""
    faces = o.faces.numpy().reshape(-1, 3)
    points = np.broadcast_to(points, (o.end.shape[0], *np.shape(points)[-2:]))
    wp.copy(o.start, o.end)
    wp.copy(o.start_normal, o.end_normal)
    o.end.assign(points.astype(np.float32))
    o.end_normal.assign(np.stack([vertex_normals(each, faces) for each in points]).astype(np.float32))


def booked(o: Obstacles, e: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the impulse on the obstacles since the sums were cleared, and its moment about the origin; clear them."""
    books = o.impulse.numpy()[e] * QUANTUM
    moment = books[:, 3:].sum(axis=0) + np.cross(o.end.numpy()[e].astype(float), books[:, :3]).sum(axis=0)
    o.impulse.zero_()
    return books[:, :3].sum(axis=0), moment


class Run:
    """Cloth without a body, and its step."""

    def __init__(
        self,
        *garments: Garment,
        obstacles: Obstacles | None = None,
        boundaries: Boundaries | None = None,
        num_envs: int = 1,
        gravity: Sequence[float] = (0.0, 0.0, -9.81),
        device: str = "cpu",
        rows: int = 1,
        **settings,
    ) -> None:
        if obstacles is None and any(len(each.held.vertices) for each in garments):
            obstacles = surfaces(frame(), num_envs=num_envs, device=device)
        self.obstacles = obstacles
        self.cloth = Cloth(
            garments, obstacles, boundaries, ClothSettings(**settings), num_envs=num_envs, gravity=gravity,
            device=device, rows=rows,
        )  # fmt: skip
        self.failure = wp.zeros(num_envs, dtype=int, device=device)
        self.graph = LaunchGraph(device)
        self.cloth.record_step(self.graph, self.failure)

    def steps(self, count: int) -> Run:
        """Take control steps."""
        for _ in range(count):
            self.graph.run()
        return self

    def get(self, name: str = "x", e: int = 0) -> np.ndarray:
        """Return positions or velocities in double precision."""
        return getattr(self.cloth.state, name).numpy()[e].astype(float)

    def put(self, **values: np.ndarray) -> Run:
        """Write positions or velocities of all environments."""
        for name, value in values.items():
            array = getattr(self.cloth.state, name)
            array.assign(np.broadcast_to(value, (*array.shape, 3)).astype(np.float32))
        return self

    @property
    def mass(self) -> np.ndarray:
        """Masses of the vertices [kg]."""
        return self.cloth.mass[0]

    def momentum(self, e: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Return momentum and angular momentum about the origin."""
        p = self.mass[:, None] * self.get("v", e)
        return p.sum(axis=0), np.cross(self.get("x", e), p).sum(axis=0)

    def speed(self) -> float:
        """Return the root mean square of the velocity [m/s]."""
        return float(np.sqrt((self.get("v") ** 2).sum(axis=1).mean()))
