"""A surface without a skeleton, in an A- or T-pose, to which the embedded body is registered."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.character import HEIGHTS, Character, Surface, body_of, with_skeleton
from piavatar_envs.avatar.body.closed_skin import read_soup
from piavatar_envs.avatar.body.registration import Registered, register
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.body.sources import embedded
from piavatar_envs.avatar.body.textures import Texture, Textures, joined, reduced
from piavatar_envs.avatar.gltf import read_gltf
from piavatar_envs.avatar.gltf_surfaces import read_surfaces
from piavatar_envs.core.extras import missing
from piavatar_envs.core.reading import check_file, reading
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
#: Our axes from those of a file by the axis that points up.
UPS = {
    "z": np.eye(3),
    "y": Y_UP,
    "x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "-z": np.diag([1.0, -1.0, -1.0]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "-x": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]]),
}
#: Colour of surfaces without one.
_CLAY = (219, 194, 176)
#: Size of a file that an OBJ file names.
_MOST_BYTES = 2**26
_Fit = TypeVar("_Fit", bound=tuple[Any, ...])


def build(path: str, height: float | None = None, up: str | None = None, skeleton: str | None = None) -> AvatarAsset:
    """Return the body of a surface.

    Args:
        path: of the file.
        height: of the body [m]; by default the file's own, in metres, centimetres or millimetres.
        up: axis that points up, of :data:`UPS`; found by the proportions of a person if not given.
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
    vertices, faces, colors, textures = load_surface(Path(path))
    check_up(up)

    def fit(axis: str) -> tuple[Registered, np.ndarray, np.ndarray, tuple[str, ...]]:
        upright = vertices @ UPS[axis].T
        scaled, note = in_metres(name, upright, height)
        matrix = UPS[axis] * (np.ptp(scaled[:, 2]) / np.ptp(upright[:, 2]))
        return _registered(name, scaled, faces), scaled, matrix, (f"{axis} points up", *note)

    size = np.ptp(vertices, axis=0)
    usual = usual_ups(("z", "y"), Path(path), size)
    registered, scaled, matrix, notes = fit(up) if up else nearest_fit(fit, usual, size, MOST_RESIDUAL)
    tall = float(np.ptp(scaled[:, 2]))
    if registered.residual > MOST_RESIDUAL:
        raise ValueError(
            f"{name}: the body does not fit to the surface, which is {100.0 * registered.residual * tall:.1f} cm away "
            f"from it on average, more than {100.0 * MOST_RESIDUAL * tall:.1f}; use a standing person in an A- or "
            f"T-pose, name the axis that points up ({', '.join(UPS)}), or give the file a skeleton and use the source "
            "glb"
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
        textures=textures,
    )


class _Loaded(NamedTuple):
    """Surface of a file in its own unit and axes, its sRGB colours at the vertices, and its textures if it has any."""

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    textures: Textures | None


def load_surface(path: Path) -> _Loaded:
    """Return the surface of a file."""
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"{path.name}: unknown mesh format {path.suffix!r}; use one of {', '.join(FORMATS)}")
    check_file(path)
    loaded = (_load_gltf if path.suffix.lower() in _GLTF else _load_other)(path)
    if not len(loaded.faces):
        raise ValueError(
            f"{path.name} has no triangles; export a surface, not points, curves or an empty scene, or use the source "
            "gaussian for splats"
        )
    if not np.isfinite(loaded.vertices).all():
        raise ValueError(f"{path.name} has vertices that are not finite; export it again")
    return loaded._replace(colors=loaded.colors.reshape(len(loaded.vertices), 3))


def _load_gltf(path: Path) -> _Loaded:
    """Return the surface of a glTF file; skins and held things are surfaces as any other."""
    surfaces = read_surfaces(read_gltf(path))
    pieces = zip(surfaces.places, surfaces.faces, surfaces.pieces, strict=True)
    return _joined([_Loaded(places, faces, piece.colors, piece.textures) for places, faces, piece in pieces])


def _load_other(path: Path) -> _Loaded:
    """Return the surface of a file that trimesh reads; of OBJ, with the materials of the file that it names."""
    try:
        import trimesh
    except ImportError as error:
        raise missing("an avatar from a mesh", "trimesh", "props") from error
    with reading(path.name, f"a readable {path.suffix} mesh"):
        kind = path.suffix.lower()[1:]
        # a stream, not a path, beside which nothing is looked up but by the resolver
        stream, resolver = io.BytesIO(path.read_bytes()), _Beside(path.parent)
        given = {"resolver": resolver} if kind == "obj" else {}
        loaded = trimesh.load(stream, file_type=kind, process=False, **given)
        meshes = loaded.geometry.values() if isinstance(loaded, trimesh.Scene) else [loaded]
        return _joined([_painted(mesh, resolver.has_read) for mesh in meshes if isinstance(mesh, trimesh.Trimesh)])


def _painted(mesh: Any, has_materials: bool) -> _Loaded:
    """Return a mesh of trimesh with its colours and its texture; without materials, trimesh has one that stands in."""
    vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
    colors = np.tile(np.array([_CLAY], np.uint8), (len(vertices), 1))
    visual, textures = mesh.visual, None
    if visual.kind in ("vertex", "face"):
        colors = np.array(visual.vertex_colors, np.uint8)[:, :3]
    elif visual.kind == "texture" and has_materials:
        uv, image = getattr(visual, "uv", None), getattr(visual.material, "image", None)
        if image is not None and np.shape(uv) == (len(vertices), 2) and np.isfinite(uv).all():
            # an OBJ file counts upwards from the lower border
            places = np.asarray(uv, np.float32) * [1.0, -1.0] + [0.0, 1.0]
            white = np.full((len(vertices), 3), 255, np.uint8)
            textures = Textures((Texture(reduced(image)),), np.zeros(len(faces), np.int32), places, white)
            colors = textures.colors(faces)
        else:
            colors[:] = np.asarray(visual.material.main_color)[:3]
    return _Loaded(vertices, faces, colors, textures)


def _joined(parts: Sequence[_Loaded]) -> _Loaded:
    """Return surfaces laid one after the other."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return _Loaded(
        np.concatenate([np.zeros((0, 3)), *(part.vertices for part in parts)]),
        np.concatenate([np.zeros((0, 3), np.int64), *(a + p.faces for a, p in zip(starts, parts, strict=False))]),
        np.concatenate([np.zeros((0, 3), np.uint8), *(part.colors for part in parts)]),
        joined([(part.textures, part.colors, len(part.faces)) for part in parts]),
    )


class _Beside:
    """Resolver of trimesh that reads files of limited size in a folder, and below it, only."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder.resolve()
        self.has_read = False

    def get(self, name: str) -> bytes:
        """Return the content of a file.

        Raises:
            FileNotFoundError: it is not there, outside of the folder, or too large.
        """
        file = (self._folder / name.strip().replace("\\", "/")).resolve()
        if not file.is_relative_to(self._folder) or not file.is_file() or file.stat().st_size > _MOST_BYTES:
            raise FileNotFoundError(f"no file {name!r} of at most {_MOST_BYTES} bytes in the folder of the mesh")
        self.has_read = True
        return file.read_bytes()

    __getitem__ = get


def check_up(up: str | None) -> None:
    """Refuse what is not an axis that points up.

    Raises:
        ValueError: it is not one of :data:`UPS`.
    """
    if up is not None and up not in UPS:
        raise ValueError(f"up={up!r} is not an axis that points up; use one of {', '.join(UPS)}")


def nearest_fit(fit: Callable[[str], _Fit], usual: Sequence[str], size: np.ndarray, most: float) -> _Fit:
    """Return the fit of the axis for which the body is nearest to the file.

    Where no usual axis is the right one, the others that are plausible are tried.

    Args:
        fit: gives the fit for an axis of :data:`UPS`, of which the first item has a ``residual``.
        usual: axes that point up in most files.
        size: of the file along x, y and z, shape ``(3,)``.
        most: residual of a body that fits.
    """
    fits = [fit(axis) for axis in usual]
    if min(one[0].residual for one in fits) > most:
        for axis in plausible_ups(UPS, size):
            if axis not in usual:
                with suppress(ValueError):  # along that axis it has no height of a person
                    fits.append(fit(axis))
    return min(fits, key=lambda one: one[0].residual)


def usual_ups(axes: Iterable[str], path: Path, size: np.ndarray) -> list[str]:
    """Return those of the axes that may point up in a file: y in glTF, as its specification says."""
    return ["y"] if path.suffix.lower() in _GLTF else plausible_ups(axes, size)


def plausible_ups(axes: Iterable[str], size: np.ndarray) -> list[str]:
    """Return those of the axes that may point up in a file of this size: a person is least deep from front to back."""
    return [axis for axis in axes if axis[-1] != "xyz"[int(np.argmin(size))]]


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
