"""A surface without a skeleton, in an A- or T-pose, to which the embedded body is registered."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.character import HEIGHTS, Character, Surface, body_of, with_skeleton
from piavatar_envs.avatar.body.closed_skin import read_soup
from piavatar_envs.avatar.body.registration import Registered, register
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.body.sources import embedded
from piavatar_envs.avatar.gltf import read_gltf
from piavatar_envs.avatar.gltf_surfaces import read_surfaces
from piavatar_envs.core.extras import missing
from piavatar_envs.core.reading import reading
from piavatar_envs.core.result_cache import digest_of, kept

#: Endings of files that only this source reads.
SUFFIXES = (".obj", ".ply", ".stl", ".off")
_GLTF = (".glb", ".gltf")
#: All formats that it reads.
FORMATS = (*SUFFIXES, *_GLTF)
#: Greatest mean distance between the surface and the registered body, over the height.
MOST_RESIDUAL = 0.015
#: Units that a height is tried in [m].
UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001}
#: Our axes from those of a file in which y points up.
Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
#: Colour of surfaces without one.
_CLAY = (219, 194, 176)


def build(path: str, height: float | None = None, up: str | None = None, skeleton: str | None = None) -> AvatarAsset:
    """Return the body of a surface.

    Args:
        path: of the file.
        height: of the body [m]; by default the file's own, in metres, centimetres or millimetres.
        up: axis that points up, ``"y"`` or ``"z"``; found by the proportions of a person if not given.
        skeleton: mesh of a skeleton, or a folder of its parts, in the file's coordinates.

    Raises:
        FileNotFoundError: there is no such file.
        ImportError: trimesh is not installed, which other files than glTF need.
        ValueError: the file cannot be read, has no person's height, or the body does not fit to it.
    """
    character = read_character(path, height, up)
    return with_skeleton(body_of(character), character, skeleton)


def read_character(path: str, height: float | None = None, up: str | None = None) -> Character:
    """Return the surface with joints and weights of the registered body; arguments and errors as for :func:`build`."""
    name = Path(path).name
    vertices, faces, colors = _load(Path(path))
    if up not in (None, "y", "z"):
        raise ValueError(f"up={up!r} is no axis that points up; use y or z")
    found = []
    for axis in [up] if up else _possible_ups(vertices, Path(path).suffix.lower()):
        matrix = Y_UP if axis == "y" else np.eye(3)
        upright = vertices @ matrix.T
        scaled, note = in_metres(name, upright, height)
        matrix = matrix * (np.ptp(scaled[:, 2]) / np.ptp(upright[:, 2]))
        found.append((_registered(name, scaled, faces), scaled, matrix, (f"{axis} points up", *note)))
    registered, scaled, matrix, notes = min(found, key=lambda one: one[0].residual)
    tall = float(np.ptp(scaled[:, 2]))
    if registered.residual > MOST_RESIDUAL:
        raise ValueError(
            f"{name}: the body does not fit to the surface, which is {100.0 * registered.residual * tall:.1f} cm away "
            f"from it on average, more than {100.0 * MOST_RESIDUAL * tall:.1f}; use a standing person in an A- or "
            "T-pose, name the axis that points up, or give the file a skeleton and use the source glb"
        )
    turn = _facing(registered)
    return Character(
        name=name,
        vertices=scaled @ turn,
        faces=faces.astype(np.int32),
        weights=registered.weights,
        joints=registered.joints @ turn,
        colors=colors,
        surfaces=(Surface(name, 0, len(faces)),),
        shape_names=(),
        shape_deltas=np.zeros((0, 2, len(vertices), 3)),
        shape_joints=np.zeros((0, 2, NUM_JOINTS, 3)),
        notes=(*notes, f"the registered body is {100.0 * registered.residual * tall:.2f} cm away on average"),
        placement=(turn.T @ matrix, np.zeros(3)),
    )


def _load(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, triangles and sRGB colours of a file, in its own unit and axes."""
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"{path.name}: unknown mesh format {path.suffix!r}; use one of {', '.join(FORMATS)}")
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    vertices, faces, colors = (_load_gltf if path.suffix.lower() in _GLTF else _load_other)(path)
    if not len(faces):
        raise ValueError(
            f"{path.name} has no triangles; export a surface, not points, curves or an empty scene, or use the source "
            "gaussian for splats"
        )
    if not np.isfinite(vertices).all():
        raise ValueError(f"{path.name} has vertices that are not finite; export it again")
    return vertices, faces, colors.reshape(len(vertices), 3)


def _load_gltf(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, triangles and colours of a glTF file; skins and held things are surfaces as any other."""
    surfaces = read_surfaces(read_gltf(path))
    counts = [len(places) for places in surfaces.places]
    starts = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    faces = [start + own for start, own in zip(starts, surfaces.faces, strict=False)]
    return (
        np.concatenate([np.zeros((0, 3)), *surfaces.places]),
        np.concatenate([np.zeros((0, 3), np.int64), *faces]),
        np.concatenate([np.zeros((0, 3), np.uint8), *(piece.colors for piece in surfaces.pieces)]),
    )


def _load_other(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, triangles and colours of a file that trimesh reads."""
    try:
        import trimesh
    except ImportError as error:
        raise missing("an avatar from a mesh", "trimesh", "props") from error
    with reading(path.name, f"a readable {path.suffix} mesh"):
        # a stream, not a path: nothing is looked up next to it
        stream, kind = io.BytesIO(path.read_bytes()), path.suffix.lower()[1:]
        loaded = trimesh.load(stream, file_type=kind, force="mesh", process=False)
        vertices, faces = np.array(loaded.vertices, np.float64), np.array(loaded.faces, np.int64)
        colors = np.tile(np.array([_CLAY], np.uint8), (len(vertices), 1))
        if loaded.visual.kind == "texture" and getattr(loaded.visual, "uv", None) is not None:
            colors = np.array(loaded.visual.to_color().vertex_colors, np.uint8)[:, :3]
        elif loaded.visual.kind in ("vertex", "face"):
            colors = np.array(loaded.visual.vertex_colors, np.uint8)[:, :3]
    return vertices, faces, colors


def _possible_ups(vertices: np.ndarray, suffix: str) -> list[str]:
    """Return the axes that may point up: a person is least deep from front to back, and x never points up."""
    if suffix in _GLTF:
        return ["y"]  # as its specification says
    return {0: ["z", "y"], 1: ["z"], 2: ["y"]}[int(np.ptp(vertices, axis=0).argmin())]


def in_metres(name: str, vertices: np.ndarray, height: float | None) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the vertices at a height, or in the first unit in which theirs is a person's."""
    tall = float(np.ptp(vertices[:, 2]))
    low, high = HEIGHTS
    if height is not None:
        if not low <= height <= high:
            raise ValueError(f"height={height:g} is outside [{low:g}, {high:g}] m")
        return vertices * (height / max(tall, 1e-12)), (f"scaled to a height of {height:g} m",)
    for unit, size in UNITS.items():
        if low <= tall * size <= high:
            return vertices * size, (f"taken as {unit}: {tall * size:.2f} m tall",)
    raise ValueError(f"{name} is {tall:.3g} units tall, a person's height in no unit; give its height in metres")


def _registered(name: str, vertices: np.ndarray, faces: np.ndarray) -> Registered:
    """Register the embedded body, or read the result of a former time."""
    from piavatar_envs.avatar.body import closed_skin, registration

    asset = embedded.build()

    def compute() -> dict[str, np.ndarray]:
        soup = read_soup(vertices, faces)
        turned, body = faces.copy(), np.zeros(len(faces), bool)
        turned[soup.flipped] = turned[soup.flipped, ::-1]
        for shell in soup.body:
            body[shell.rows] = True
        found = register(asset, vertices, turned, body if body.any() else ~body)
        return {name: np.asarray(value) for name, value in vars(found).items()}

    digest = digest_of([vertices, faces, asset.vertices], [registration, closed_skin])
    arrays = kept("registered", digest, compute, f"registering the body to {name}")
    return Registered(**{key: float(value) if value.ndim == 0 else value for key, value in arrays.items()})


def _facing(registered: Registered) -> np.ndarray:
    """Return the matrix that turns rows of points about the vertical so that the body faces -y."""
    x, y, _ = Rotation.from_rotvec(registered.turn).as_matrix()[:, 0]
    return Rotation.from_euler("z", float(np.arctan2(y, x))).as_matrix()
