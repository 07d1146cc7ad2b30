"""Particles of soft props: closed solids filled on a lattice, with the surface for pictures.

Particles sit in the cells of a regular lattice that fits the solid's bounding box, each at the centroid of its matter.
A few point masses turn more easily than the solid they stand for (eight in a cube by a quarter), so the lattice is
stretched until its second moments, and with them the inertia, are the solid's.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp
from scipy.spatial import cKDTree

from piavatar_envs.avatar.body.asset import mesh_volume
from piavatar_envs.avatar.body.sampling import ClosedSurface
from piavatar_envs.core.extras import missing
from piavatar_envs.core.reading import reading
from piavatar_envs.mpm.colliders import COLLIDER_KINDS, solid_distance

wp.set_module_options({"enable_backward": False})

MESH_FORMATS = (".glb", ".obj", ".off", ".ply", ".stl")
MIN_PARTICLES = 8
MAX_CELLS = 200_000  # of the lattice around a solid
MIN_CELLS = 2  # along each axis, because one layer has no orientation
SUBDIVISIONS = 3  # points per axis and cell that measure the part of it inside
OVERLAP_SAMPLES = 20_000  # of the box in which parts of a mesh may overlap
MIN_FILL = 0.3  # share of a cell that must be inside for a particle of its own
MAX_MISSED = 0.25  # share of a mesh's volume that the lattice may miss or count twice
CORE, CORE_ERROR, MOST_BALLS = 0.5, 0.1, 32  # the core is deeper than 1 - CORE of the greatest depth; error, balls
DIAGONAL = 1.8  # of a cell of the lattice of particles
SEGMENTS = 32  # around a round surface
RINGS = 8  # from a pole to the equator
SQUARES = 6  # along each edge of a box


@dataclass(frozen=True, eq=False)
class PropPoints:
    """Particles and surface of a prop in a frame about its centre of mass; arrays are read-only.

    Attributes:
        rest: particles [m], shape ``(P, 3)`` float32.
        volume: their volumes [m^3], which add up to the solid's, shape ``(P,)`` float64.
        vertices: surface for pictures [m], shape ``(V, 3)`` float32.
        faces: its triangles, outward, shape ``(T, 3)`` int32.
        core: balls that fill its innermost part, centre and radius [m], shape ``(B, 4)`` float32.
    """

    rest: np.ndarray
    volume: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray
    core: np.ndarray

    @property
    def core_reach(self) -> float:
        """Greatest distance of a point of the core from the centre of mass [m]."""
        return float((np.linalg.norm(self.core[:, :3], axis=1) + self.core[:, 3]).max())

    def __post_init__(self):
        for array in vars(self).values():
            array.setflags(write=False)

    def __len__(self) -> int:
        return len(self.rest)


@dataclass(frozen=True, eq=False)
class _Solid:
    """A solid in a frame about its centre of mass; ``spread`` is the mean of ``x x^T`` over it [m^2]."""

    name: str
    distance: Callable[[np.ndarray], np.ndarray]  # signed, negative inside [m]
    volume: float
    spread: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray


def sphere(radius: float, spacing: float) -> PropPoints:
    """Fill a ball with particles.

    Args:
        radius: its radius [m].
        spacing: spacing of the particles [m]; a smaller ball still has eight.

    Raises:
        ValueError: a length is not positive, or the lattice is too large.
    """
    _check_lengths("sphere", radius=radius, spacing=spacing)
    distance = primitive_distance("sphere", (radius, 0.0, 0.0))
    spread = np.eye(3) * radius**2 / 5.0
    volume = 4.0 / 3.0 * np.pi * radius**3
    return _particles(_Solid("sphere", distance, volume, spread, *round_surface(radius, 0.0)), spacing)


def box(half_size: Sequence[float], spacing: float) -> PropPoints:
    """Fill a box with particles.

    Args:
        half_size: half edges along x, y and z [m].
        spacing: spacing of the particles [m]; a shorter edge still has two.

    Raises:
        ValueError: a length is not positive, or the lattice is too large.
    """
    half = np.asarray(half_size, dtype=np.float64)
    if half.shape != (3,):
        raise ValueError(f"box half_size={half_size!r} must be three lengths [m], along x, y and z")
    _check_lengths("box", spacing=spacing, **{f"half_size[{axis}]": length for axis, length in enumerate(half)})
    distance = primitive_distance("box", half)
    return _particles(_Solid("box", distance, 8.0 * half.prod(), np.diag(half**2) / 3.0, *box_surface(half)), spacing)


def capsule(radius: float, half_length: float, spacing: float) -> PropPoints:
    """Fill a capsule along z with particles.

    Args:
        radius: radius of the cylinder and of the half balls at its ends [m].
        half_length: half the length of the cylinder [m].
        spacing: spacing of the particles [m]; a thinner capsule still has two across.

    Raises:
        ValueError: a length is not positive, or the lattice is too large.
    """
    _check_lengths("capsule", radius=radius, half_length=half_length, spacing=spacing)
    distance = primitive_distance("capsule", (radius, half_length, 0.0))
    tube, ends = 2.0 * np.pi * radius**2 * half_length, 4.0 / 3.0 * np.pi * radius**3
    # a half ball has its centroid at 3/8 of the radius from the flat side, and a mean square of a fifth of radius^2
    across = tube * radius**2 / 4.0 + ends * radius**2 / 5.0
    along = tube * half_length**2 / 3.0
    along += ends * (radius**2 / 5.0 + half_length**2 + 0.75 * radius * half_length)
    spread = np.diag([across, across, along]) / (tube + ends)
    return _particles(
        _Solid("capsule", distance, tube + ends, spread, *round_surface(radius, half_length)),
        spacing,
    )


def mesh(path: str | Path, spacing: float, scale: float = 1.0) -> PropPoints:
    """Fill the solid of a watertight mesh with particles; only the triangles of the file are read.

    Args:
        path: the file, in one of :data:`MESH_FORMATS`.
        spacing: spacing of the particles [m].
        scale: length of the file's unit [m], 0.001 for millimetres.

    Raises:
        ImportError: the optional package trimesh is missing.
        FileNotFoundError: there is no such file.
        ValueError: the file is not a closed mesh of a known format, or the solid is too thin for the spacing.
    """
    path = Path(path)
    _check_lengths(path.name, spacing=spacing, scale=scale)
    shape = _load(path)
    shape.apply_scale(scale)
    extent = float(np.abs(shape.vertices).max())
    if not extent < float(np.finfo(np.float32).max):
        raise ValueError(
            f"{path.name} has a vertex {extent:.3g} m from its origin, which is no number in single precision; export "
            "it again, or use a smaller size"
        )
    parts = _orient_parts(shape)
    if not shape.volume > 0.0:
        raise ValueError(f"{path.name} encloses no volume; export a solid, not a sheet")
    volume, centre, spread = shape.volume, shape.center_mass, _spread(shape.moment_inertia, shape.volume)
    excess = _excess(shape.vertices, parts)
    if len(excess):
        volume, centre, spread = _without(volume, centre, spread, excess)
    shape.apply_translation(-centre)
    vertices, faces = shape.vertices.astype(np.float32), shape.faces.astype(np.int32)
    surface = ClosedSurface(vertices, faces)
    return _particles(_Solid(path.name, surface.distance, float(volume), spread, vertices, faces), spacing)


def _spread(inertia: np.ndarray, volume: float) -> np.ndarray:
    """Return the mean of ``x x^T`` about the centre of mass [m^2], of a moment of inertia of density one."""
    return (0.5 * np.trace(inertia) * np.eye(3) - inertia) / volume


def _orient_parts(shape) -> list[np.ndarray]:
    """Turn the closed parts of a ``trimesh.Trimesh`` outward, but for cavities, and return the faces of each.

    A part that faces inward is a cavity if it lies in a solid part; elsewhere it is a part that was left inside out.
    """
    import trimesh

    labels = trimesh.graph.connected_component_labels(shape.face_adjacency, node_count=len(shape.faces))
    if shape.volume < 0.0:
        shape.invert()
    faces = np.array(shape.faces)
    belongs = [labels == label for label in range(labels.max() + 1)]
    inward = [mesh_volume(shape.vertices, faces[mine]) < 0.0 for mine in belongs]
    if any(inward):
        solid = np.any([mine for mine, hole in zip(belongs, inward, strict=True) if not hole], axis=0)
        outward = ClosedSurface(shape.vertices, faces[solid])
        for mine in (mine for mine, hole in zip(belongs, inward, strict=True) if hole):
            corners = shape.vertices[np.unique(faces[mine])]
            if (outward.distance(corners) > 0.0).any():
                faces[mine] = faces[mine][:, ::-1]
        shape.faces = faces
    return [faces[mine] for mine in belongs]


def _excess(vertices: np.ndarray, parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return where closed parts overlap: samples ``(S, 4)`` of position [m] and of volume counted too often [m^3].

    The sum of signed volumes counts a point once for every solid part around it, less once for every cavity.
    """
    boxes = [(vertices[np.unique(part)].min(axis=0), vertices[np.unique(part)].max(axis=0)) for part in parts]
    shared = [
        (np.maximum(a[0], b[0]), np.minimum(a[1], b[1]))
        for index, a in enumerate(boxes)
        for b in boxes[:index]
        if (np.maximum(a[0], b[0]) < np.minimum(a[1], b[1])).all()
    ]
    if not shared:
        return np.empty((0, 4))
    low, high = np.min([box[0] for box in shared], axis=0), np.max([box[1] for box in shared], axis=0)
    # additive recurrence of the root of x^4 = x + 1, which fills a box evenly and is aligned with no face
    steps = 1.2207440846057596 ** -np.arange(1.0, 4.0)
    points = low + (high - low) * ((0.5 + np.arange(OVERLAP_SAMPLES)[:, None] * steps) % 1.0)
    around = np.zeros(len(points))
    for part, (least, most) in zip(parts, boxes, strict=True):
        near = np.flatnonzero(((points > least) & (points < most)).all(axis=1))
        if len(near):
            sign = np.sign(mesh_volume(vertices, part))
            around[near] += sign * (ClosedSurface(vertices, part[:, :: int(sign)]).distance(points[near]) < 0.0)
    extra = around - (around > 0.0)
    found = extra != 0.0
    weight = (high - low).prod() / OVERLAP_SAMPLES * extra[found, None]
    return np.concatenate([points[found], weight], axis=1)


def _without(volume: float, centre: np.ndarray, spread: np.ndarray, excess: np.ndarray) -> tuple:
    """Return the volume [m^3], centre of mass [m] and spread [m^2] of a solid without what was counted too often."""
    points, share = excess[:, :3], excess[:, 3]
    total = volume - share.sum()
    middle = (volume * centre - share @ points) / total
    second = volume * (spread + np.outer(centre, centre)) - np.einsum("s,si,sj->ij", share, points, points)
    return total, middle, second / total - np.outer(middle, middle)


def _load(path: Path):
    """Load a file as a ``trimesh.Trimesh`` of closed parts, each of one orientation."""
    try:
        import trimesh
    except ImportError as error:
        raise missing("a prop from a mesh", "trimesh", "props") from error
    if path.suffix.lower() not in MESH_FORMATS:
        raise ValueError(f"{path.name}: unknown mesh format {path.suffix!r}; use one of {', '.join(MESH_FORMATS)}")
    if not path.is_file():
        raise FileNotFoundError(f"no mesh at {path}")
    with reading(path.name, f"a readable {path.suffix} mesh"):
        # a stream, not a path: no materials or buffers are looked up next to it
        stream, kind = io.BytesIO(path.read_bytes()), path.suffix.lower()[1:]
        loaded = trimesh.load(stream, file_type=kind, force="mesh", process=True, skip_materials=True)
        # once more without texture coordinates, which split vertices along their seams
        faces = getattr(loaded, "faces", np.empty((0, 3), np.int64))
        shape = trimesh.Trimesh(loaded.vertices, faces, process=True)  # validate would turn a cavity inside out
        shape.update_faces(shape.nondegenerate_faces())
    if len(shape.faces) == 0:
        raise ValueError(f"{path.name} has no triangles; export a solid, not points, curves or an empty scene")
    if not shape.is_watertight:
        bad = (np.bincount(shape.edges_unique_inverse) != 2).sum()
        raise ValueError(f"{path.name} is not watertight ({bad} edges without two sides); close it and export it again")
    if not shape.is_winding_consistent:
        raise ValueError(f"{path.name} has triangles of both orientations; make its normals consistent")
    return shape


@wp.kernel
def _primitive_distance_kernel(
    kind: int,
    size: wp.vec3,
    points: wp.array(dtype=wp.vec3),
    # out
    distance: wp.array(dtype=float),
):
    """Store the signed distance of every point; over ``(points,)``."""
    i = wp.tid()
    distance[i] = solid_distance(kind, size, points[i])[3]


def primitive_distance(kind: str, size: Sequence[float]) -> Callable[[np.ndarray], np.ndarray]:
    """Return the signed distance of a collider's shape, ``(N, 3)`` to ``(N,)`` [m], evaluated on the CPU."""

    def distance(points: np.ndarray) -> np.ndarray:
        where = wp.array(np.asarray(points, np.float32), dtype=wp.vec3, device="cpu")
        out = wp.empty(len(points), dtype=float, device="cpu")
        inputs = [COLLIDER_KINDS[kind], wp.vec3(*map(float, size)), where]
        wp.launch(_primitive_distance_kernel, len(points), inputs, [out], device="cpu")
        return out.numpy()

    return distance


def _check_lengths(name: str, **lengths: float) -> None:
    """Refuse lengths that are not positive and finite.

    Raises:
        ValueError: there is one.
    """
    for key, value in lengths.items():
        if not (np.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} {key}={value} must be positive and finite; lengths are in metres")


def _particles(solid: _Solid, spacing: float) -> PropPoints:
    """Fill a solid with particles whose volumes and second moments add up to the solid's.

    Raises:
        ValueError: the lattice is too large, or too coarse for the solid.
    """
    places, share, caught = _lattice(solid, spacing)
    if len(places) < MIN_PARTICLES or abs(caught / solid.volume - 1.0) > MAX_MISSED:
        raise ValueError(
            f"{solid.name} is too thin for spacing={spacing:g} m: {len(places)} particles (at least {MIN_PARTICLES}) "
            f"with {caught / solid.volume:.0%} of its volume; use a larger size, or a finer physics.fidelity for a "
            f"spacing under {0.5 * spacing:g} m"
        )
    rest = _stretched(places, share, solid.spread)
    beyond = solid.distance(rest) > 0.0
    rest[beyond] = places[beyond]
    core = core_balls(solid.distance, rest, spacing)
    # differs a little from the centre of a coarsely sampled mesh; the surface moves with the particles
    centre = share @ rest
    surface = (solid.vertices - centre).astype(np.float32)
    return PropPoints(
        (rest - centre).astype(np.float32), share * solid.volume, surface, solid.faces, core - np.append(centre, 0.0)
    )


def core_balls(distance: Callable[[np.ndarray], np.ndarray], places: np.ndarray, spacing: float) -> np.ndarray:
    """Return balls that fill the core of a solid: all that is deeper than a share of the greatest depth.

    Centres are among the particles, the centre of mass and, in thin solids, the middles between particles. The deepest
    is the first; of the others, the one whose ball stands out most from those so far is the next.

    Args:
        distance: signed distance from the surface, negative inside, ``(N, 3)`` to ``(N,)`` [m].
        places: particles about the centre of mass [m], shape ``(P, 3)``.
        spacing: of the particles [m].

    Returns:
        Centres and radii [m], shape ``(B, 4)`` float32.
    """
    places = np.vstack([np.zeros(3), places])
    depth = -distance(places).astype(float)
    if depth.max() < 2.0 * spacing:
        pairs = cKDTree(places).query_pairs(DIAGONAL * spacing, output_type="ndarray")
        middles = places[pairs].mean(axis=1)
        places, depth = np.vstack([places, middles]), np.append(depth, -distance(middles))
    deepest = depth.max()
    places, radius = places[depth > (1.0 - CORE) * deepest], depth[depth > (1.0 - CORE) * deepest]
    radius -= (1.0 - CORE) * deepest
    chosen, out = [int(radius.argmax())], np.full(len(radius), np.inf)
    while len(chosen) < MOST_BALLS:
        last = chosen[-1]
        out = np.minimum(out, np.linalg.norm(places - places[last], axis=1) + radius - radius[last])
        if out.max() <= CORE_ERROR * deepest:
            break
        chosen.append(int(out.argmax()))
    return np.column_stack([places, radius])[chosen].astype(np.float32)


def _lattice(solid: _Solid, spacing: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return particles [m] ``(P, 3)``, their shares of the volume ``(P,)``, and the volume of all cells [m^3]."""
    low, high = (end(solid.vertices, axis=0).astype(np.float64) for end in (np.min, np.max))
    counts = np.maximum(np.round((high - low) / spacing), MIN_CELLS)
    if counts.prod() > MAX_CELLS:
        larger = spacing * (counts.prod() / MAX_CELLS) ** (1.0 / 3.0)
        raise ValueError(
            f"{solid.name} at spacing={spacing:g} m has {counts.prod():.3g} cells (at most {MAX_CELLS}); "
            f"use a smaller size, which of a mesh in millimetres is 0.001, or a coarser physics.fidelity for a spacing "
            f"above {larger:.2g} m"
        )
    edge = (high - low) / counts
    cells = np.stack(np.meshgrid(*[np.arange(n) + 0.5 for n in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    centres = low + cells * edge
    steps = (np.arange(SUBDIVISIONS) + 0.5) / SUBDIVISIONS - 0.5
    offsets = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3) * edge
    fine = centres[:, None, :] + offsets
    distance = solid.distance(centres)
    inside = np.repeat(distance[:, None] < 0.0, len(offsets), axis=1)
    # a point nearer to the centre than the surface is on the centre's side, so only the others need a query
    unsure = np.abs(distance)[:, None] <= np.linalg.norm(offsets, axis=1)
    inside[unsure] = solid.distance(fine[unsure]) < 0.0
    caught = inside.mean() * (high - low).prod()
    kept = np.flatnonzero(inside.mean(axis=1) >= MIN_FILL)
    if len(kept) == 0:
        return np.empty((0, 3)), np.empty(0), caught
    # a cell without a particle adds its matter to the nearest particle
    owner = np.full(len(centres), -1)
    owner[kept] = np.arange(len(kept))
    owner, points = np.repeat(owner, inside.sum(axis=1)), fine[inside]
    owner[owner < 0] = cKDTree(centres[kept]).query(points[owner < 0])[1]
    count = np.bincount(owner)
    places = np.stack([np.bincount(owner, points[:, axis]) for axis in range(3)], axis=1) / count[:, None]
    # a centroid outside the solid, as between two fingers, moves to the nearest point inside
    gap = solid.distance(places) >= 0.0
    places[gap] = points[cKDTree(points).query(places[gap])[1]]
    return places, count / count.sum(), caught


def _stretched(places: np.ndarray, share: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Map places about their mean ``(P, 3)`` so that the mean of ``x x^T`` is ``spread`` [m^2].

    The symmetric one of all such linear maps moves the points least.
    """
    centred = places - share @ places
    root = _power(np.einsum("p,pi,pj->ij", share, centred, centred), 0.5)
    back = _power(root, -1.0)
    return centred @ (back @ _power(root @ spread @ root, 0.5) @ back)


def _power(matrix: np.ndarray, exponent: float) -> np.ndarray:
    """Return a power of a symmetric matrix, its eigenvalues bounded away from zero."""
    values, axes = np.linalg.eigh(matrix)
    return (axes * np.maximum(values, 1e-12 * values[-1]) ** exponent) @ axes.T


def round_surface(radius: float, half_length: float) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate a capsule along z, or a ball if ``half_length`` [m] is zero.

    Returns:
        Vertices [m] ``(V, 3)`` float32 and outward triangles ``(T, 3)`` int32.
    """
    quarter = np.linspace(0.0, 0.5 * np.pi, RINGS + 1)[1:]  # from the pole, which is one vertex
    lower = quarter if half_length > 0.0 else quarter[:-1]  # a ball has one equator
    height = np.concatenate([half_length + radius * np.cos(quarter), -half_length - radius * np.cos(lower[::-1])])
    width = radius * np.sin(np.concatenate([quarter, lower[::-1]]))
    angle = 2.0 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    across = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = np.empty((len(height), SEGMENTS, 3))
    rings[..., :2] = width[:, None, None] * across
    rings[..., 2] = height[:, None]
    pole = [0.0, 0.0, half_length + radius]
    vertices = np.concatenate([rings.reshape(-1, 3), [pole], np.negative([pole])])

    here = np.arange(SEGMENTS)
    there = np.roll(here, -1)
    top, bottom = len(vertices) - 2, len(vertices) - 1
    faces = [np.stack([np.full(SEGMENTS, top), here, there], axis=1)]
    for ring in range(len(height) - 1):
        a, b = here + ring * SEGMENTS, there + ring * SEGMENTS
        faces += [np.stack([a, a + SEGMENTS, b], axis=1), np.stack([b, a + SEGMENTS, b + SEGMENTS], axis=1)]
    last = (len(height) - 1) * SEGMENTS
    faces.append(np.stack([np.full(SEGMENTS, bottom), last + there, last + here], axis=1))
    return vertices.astype(np.float32), np.concatenate(faces).astype(np.int32)


def box_surface(half_size: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate a box, with separate vertices for every side so that edges are shaded sharp.

    Returns:
        Vertices [m] ``(V, 3)`` float32 and outward triangles ``(T, 3)`` int32.
    """
    ticks = np.linspace(-1.0, 1.0, SQUARES + 1)
    i, j = np.meshgrid(np.arange(SQUARES), np.arange(SQUARES), indexing="ij")
    a = (i * (SQUARES + 1) + j).ravel()
    b, c, d = a + SQUARES + 1, a + SQUARES + 2, a + 1
    squares = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    vertices, faces = [], []
    for axis in range(3):
        for sign in (1.0, -1.0):
            side = np.empty((SQUARES + 1, SQUARES + 1, 3))
            side[..., axis] = sign
            side[..., (axis + 1) % 3] = sign * ticks[:, None]  # the sign makes the side face outward
            side[..., (axis + 2) % 3] = ticks[None, :]
            faces.append(squares + len(vertices) * (SQUARES + 1) ** 2)
            vertices.append(side.reshape(-1, 3))
    corners = np.concatenate(vertices) * np.asarray(half_size, dtype=np.float64)
    return corners.astype(np.float32), np.concatenate(faces).astype(np.int32)
