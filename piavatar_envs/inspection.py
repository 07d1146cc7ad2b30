"""Reports on files of avatars and motions: what a file becomes here, what was guessed, and a picture."""

from __future__ import annotations

import importlib
import inspect
import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from piavatar_envs.avatar.body import sources
from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.character import Character
from piavatar_envs.avatar.body.closed_skin import read_soup
from piavatar_envs.avatar.body.groups import skin_shares
from piavatar_envs.avatar.body.rigs import read_mapping
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, PARENTS
from piavatar_envs.avatar.gltf import Gltf, read_gltf
from piavatar_envs.avatar.motion.library import load_motion
from piavatar_envs.config.schema import PhysicsConfig
from piavatar_envs.core.extras import missing
from piavatar_envs.core.reading import check_file
from piavatar_envs.core.writing import check_writable

#: Endings of files of glTF, which may hold a character, motions or both.
GLTF = (".glb", ".gltf", ".vrm")
#: Endings of files that hold motions only.
MOTIONS = (".bvh", ".txt")
_PICTURE_SIZE = 640  # [pixels] high
_BONE = 0.012  # [m] radius of a bone in the picture
_JOINT = 0.022  # [m]

Report = dict[str, Any]


def examine(path: Path, settings: Mapping[str, Any] | None = None, picture: Path | None = None) -> Report:
    """Return what a file becomes here: rows of a table by name, each a string, a number or a list of strings.

    Args:
        path: of a character or a motion.
        settings: of the source that reads it, such as ``height`` and ``mapping``; ``source`` names another one than the
            file's ending.
        picture: file to write the body and its skeleton to, from the front and the side.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not read, or a setting is not one of the source's.
        ImportError: the extra of pictures is not installed.
    """
    settings = dict(settings or {})
    check_file(path)
    if picture is not None:
        check_writable(picture)
    suffix = path.suffix.lower()
    report: Report = {"file": f"{path}, {path.stat().st_size / 2**20:.2f} MiB"}
    gltf = read_gltf(path) if suffix in GLTF else None
    moves = suffix in MOTIONS or _is_recording(path) or (gltf and gltf.animations and not _is_character(gltf))
    if moves and "source" not in settings:
        if picture is not None:
            raise ValueError(f"{path} is a motion, of which there is no picture; leave --picture out")
        motions = (
            [str(path)] if gltf is None else [f"{path}#{a.name}" if a.name else str(path) for a in gltf.animations]
        )
        return report | {"motions": [_motion(motion, settings) for motion in motions]}
    source = settings.pop("source", None) or sources.source_of(path)
    sources.check_source(source)
    module = importlib.import_module(f"{sources.__name__}.{source}")
    asset = sources.load_asset(source, path, **settings)
    report["source"] = source
    if hasattr(module, "joint_names"):
        report |= _joints(module, path, settings)
    report |= _body(asset)
    if hasattr(module, "read_character"):
        read = inspect.signature(module.read_character).parameters
        shared = {name: value for name, value in settings.items() if name in read}
        report |= _surfaces(module.read_character(str(path), **shared))
    if gltf is not None and gltf.animations:
        report["animations"] = [f"{a.name or 'nameless'}: {a.end - a.start:.2f} s" for a in gltf.animations]
    if picture is not None:
        draw(asset, picture)
        report["picture"] = str(picture)
    return report


def show(report: Report, *, as_json: bool = False) -> None:
    """Print a report, as a table for people or as JSON."""
    if as_json:
        print(json.dumps(report, indent=2))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, value in report.items():
        for row, line in enumerate(value if isinstance(value, list) else [str(value)]):
            table.add_row("" if row else name, line)
    Console(highlight=False, soft_wrap=True, markup=False).print(table)


def draw(asset: AvatarAsset, path: Path) -> None:
    """Write a picture of a body from the front and from the side, and of its skeleton from the front.

    Raises:
        ImportError: the extra of pictures is not installed.
    """
    from piavatar_envs.render.renderer import Renderer
    from piavatar_envs.render.scene import Body, Camera, Capsule, MovedSplats, Sphere

    try:
        from PIL import Image
    except ImportError as error:
        raise missing("a picture of a file", "PIL", "render") from error

    body = asset.mean_body()
    shift = body.vertices[0].astype(np.float64) - asset.vertices[0]
    look = asset.drawn
    splats = None if look.splats is None else MovedSplats.resting(look.splats.cloud, shift)
    own = {"colors": look.colors_of(0), "splats": splats, "textures": look.textures}
    surface = Body((look.vertices + shift).astype(np.float32), look.faces, **own)
    joints = body.joints.astype(np.float64)
    bones = [_bone(joints[PARENTS[joint]], joints[joint], Capsule) for joint in range(1, len(JOINT_NAMES))]
    skeleton = [*bones, *(Sphere(joint, _JOINT) for joint in joints)]
    tall = float(np.ptp(np.asarray(surface.vertices)[:, 2]))
    views = []
    for eye, bodies, markers in (
        ((0.0, -2.6), [surface], []),
        ((2.6, 0.0), [surface], []),
        ((0.0, -2.6), [], skeleton),
    ):
        position = (eye[0] * tall, eye[1] * tall, 0.55 * tall)
        camera = Camera(position=position, target=(0.0, 0.0, 0.5 * tall), field_of_view=26.0)
        with Renderer(int(0.8 * _PICTURE_SIZE), _PICTURE_SIZE, camera) as renderer:
            views.append(renderer.render(bodies, markers))
    Image.fromarray(np.concatenate(views, axis=1)).save(path)


def _bone(start: np.ndarray, end: np.ndarray, capsule: Any) -> Any:
    """Return a capsule from one joint to another."""
    along = end - start
    length = float(np.linalg.norm(along))
    axis = along / max(length, 1e-9)
    side = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    rotation = np.stack([side, np.cross(axis, side), axis], axis=1)
    return capsule(0.5 * (start + end), _BONE, 0.5 * length, rotation=rotation)


def _is_character(gltf: Gltf) -> bool:
    """Return whether a glTF file has a skinned mesh; one without it may hold motions only."""
    return any("mesh" in node and "skin" in node for node in gltf.items("nodes"))


def _is_recording(path: Path) -> bool:
    """Return whether a file is an archive of a recording, as of AMASS, and not of a body."""
    if path.suffix.lower() != ".npz":
        return False
    try:
        with np.load(path, allow_pickle=False) as archive:
            return "poses" in archive.files
    except Exception:  # its reader says what is wrong
        return False


def _joints(module: ModuleType, path: Path, settings: Mapping[str, Any]) -> Report:
    """Return the nodes that are our joints, and those that are made."""
    names = module.joint_names(path, settings.get("mapping"))
    made = [joint for joint in JOINT_NAMES if joint not in names]
    lines = [f"{joint} = {names[joint]}" for joint in JOINT_NAMES if joint in names]
    rows = [", ".join(lines[first : first + 2]) for first in range(0, len(lines), 2)]
    return {"joints": rows, "joints made": ", ".join(made) or "none"}


def _body(asset: AvatarAsset) -> Report:
    """Return size, volume and mass of a body."""
    mean = np.zeros(len(asset.shape_names))
    volume, density = asset.volume(mean), PhysicsConfig.model_fields["density"].default
    report = {
        "height": f"{asset.height(mean):.3f} m",
        "volume": f"{1e3 * volume:.2f} litres",
        "mass": f"{density * volume:.1f} kg at {density:g} kg/m^3",
        "skin": f"{len(asset.vertices)} vertices, {len(asset.faces)} triangles",
    }
    if asset.look is not None and asset.look.splats is not None:
        cloud = asset.look.splats.cloud
        report["splats"] = f"{len(cloud)}, with colours of degree {cloud.degree}"
    if asset.skeleton is not None:
        report["skeleton"] = f"{len(asset.skeleton.points)} points"
    if asset.groups:
        report["groups"] = [f"{name}: {share:.1%} of the skin" for name, share in skin_shares(asset).items()]
    if asset.shape_names:
        report["shape parameters"] = ", ".join(asset.shape_names)
    return report


def _surfaces(character: Character) -> Report:
    """Return which surfaces of a character are body, which are worn and which held, and what was guessed."""
    soup = read_soup(character.vertices, character.faces, character.held)
    is_body = np.zeros(len(character.faces), bool)
    for shell in soup.body:
        is_body[shell.rows] = True
    lists: dict[str, list[str]] = {"body": [], "worn": [], "held": []}
    for surface in character.surfaces:
        own = is_body[surface.first : surface.last]
        name = surface.name + (f" ({surface.material})" if surface.material not in ("", surface.name) else "")
        for kind, count in (("body", own.sum()), ("held" if surface.held else "worn", (~own).sum())):
            if count:
                lists[kind].append(f"{name}: {count} of {len(own)} triangles")
    notes = {"notes": list(character.notes)} if character.notes else {}
    return {kind: lines or "nothing" for kind, lines in lists.items()} | notes


def _motion(motion: str, settings: Mapping[str, Any]) -> str:
    """Return length, rate and fastest joint of a motion, what was found in it and what it was warned of."""
    unknown = [name for name in settings if name != "mapping"]
    if unknown:
        raise ValueError(f"a motion has no setting {unknown[0]}={settings[unknown[0]]!r}; it has mapping")
    mapping = read_mapping(settings["mapping"]) if "mapping" in settings else None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        clip = load_motion(motion, mapping=mapping)
    speeds = clip.joint_speeds()
    joint = JOINT_NAMES[int(speeds.max(axis=0).argmax())]
    length = (clip.num_frames - 1) / clip.fps
    said = "".join(f"; {line}" for line in (*clip.notes, *(str(warning.message) for warning in caught)))
    return (
        f"{clip.name}: {length:.2f} s, {clip.num_frames} frames at {clip.fps:.4g}/s, fastest joint {joint} at "
        f"{speeds.max():.3g} rad/s{said}"
    )
